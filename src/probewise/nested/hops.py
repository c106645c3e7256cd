"""A move that hops between known modes before each chain, so that none of them dies out among the live points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.nested.clusters import Clusters
from probewise.nested.evaluate import Bound, Evaluator, Points
from probewise.nested.moves import SliceMove, Tally
from probewise.nested.space import within_bounds_mask

_HOPS = 3


@dataclass(frozen=True, eq=False)
class HoppingMove:
    """A move that hops between modes, then runs the chains of `chains`.

    A hop takes a point to its counterpart in another mode, by the affine map between their covariances, and is accepted
    with the ratio of their volumes (see `SliceMove`). `SliceMove` knows only the modes with enough live points for a
    covariance; here `modes` are clusters of the posterior, in the sampling coordinates. Level sets of a mode keep about
    the same shape far below its top, so the maps serve from where modes separate.
    """

    chains: SliceMove
    modes: Clusters

    def draw(
        self, start: Points, bound: Bound, live: FloatArray, evaluate: Evaluator, rng: np.random.Generator
    ) -> tuple[Points, Tally]:
        """Return the ends of one chain from each start, and the tally; see `Move`."""
        n_before, now = evaluate.n_calls, start.copy()
        for _ in range(_HOPS):
            self._hop_in_place(now, bound, evaluate, rng)
        n_hops = evaluate.n_calls - n_before
        new, tally = self.chains.draw(now, bound, live, evaluate, rng)
        return new, Tally(tally.n_evaluated + n_hops, tally.n_accepted, tally.n_stuck, tally.n_tried)

    def _hop_in_place(self, now: Points, bound: Bound, evaluate: Evaluator, rng: np.random.Generator) -> None:
        """Try one hop of each point to a mode chosen at random from the others; overwrite the points that succeed."""
        modes, space = self.modes, evaluate.space
        home = modes.assign(now.u)
        goal = (home + rng.integers(1, len(modes), size=len(home))) % len(modes)
        u, log_growth = modes.map_with_log_volume_ratio(now.u, home, goal)
        # The way back must be the same map.
        able = within_bounds_mask(space, u) & (modes.assign(u) == goal)
        level = now.log_density - log_growth - rng.standard_exponential(len(home))
        rows = able.nonzero()[0]
        theta, log_density = space.leave(u[rows])
        dense = (log_density >= level[rows]).nonzero()[0]
        rows = rows[dense]
        tried = evaluate.evaluate_mapped(u[rows], theta[dense], log_density[dense], rng)
        won = bound.mask_above(tried.log_likelihood, tried.label).nonzero()[0]
        now.overwrite_rows(rows[won], tried, won)

    def adapted(self, tally: Tally) -> HoppingMove:
        """Return the move with its chains adapted; see `SliceMove`."""
        return HoppingMove(self.chains.adapted(tally), self.modes)
