"""Draw new points uniformly from the part of the prior above a likelihood bound."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import ParameterError
from probewise.nested.evaluate import Bound, Evaluator, Points
from probewise.nested.slice_chains import AXIS, DIFFERENCE, FRAME, HOP, SliceChains

# With three steps in three dimensions the chains stay correlated: ln Z scattered by 1.3 of its claimed errors.
_FEWEST_STEPS = 6


@dataclass(frozen=True)
class Tally:
    """Statistics of a move.

    `n_evaluated`: likelihood evaluations. `n_tried`, `n_accepted`: candidates and acceptances by which
    the move tunes itself. `n_stuck`: chains that never left their start.
    """

    n_evaluated: int
    n_accepted: int
    n_stuck: int = 0
    n_tried: int = 0


class Move(Protocol):
    """A way to draw new points above a likelihood bound."""

    def draw(
        self, start: Points, bound: Bound, live: FloatArray, evaluate: Evaluator, rng: np.random.Generator
    ) -> tuple[Points, Tally]:
        """Draw as many new points as `start` has, each distributed as the prior above `bound`.

        Parameters
        ----------
        start
            Points above the bound, at which chains may begin.
        bound
            The level and label that new points must exceed.
        live
            All known points above the bound, in the evaluator's space, those of `start` included, (n, n_params).
        evaluate
            The problem.
        rng
            Source of randomness.

        Returns
        -------
        The new points, and the move's tally.
        """
        ...

    def adapted(self, tally: Tally) -> Move:
        """Return the move to use next, tuned by the statistics of this one."""
        ...


@dataclass(frozen=True)
class PriorRejection:
    """A move that draws from the whole prior until enough points lie above the bound: exact; costly in a small volume.

    `volume` estimates the share of the prior above the bound; it only sets the batch size.
    """

    volume: float

    def draw(
        self, start: Points, bound: Bound, live: FloatArray, evaluate: Evaluator, rng: np.random.Generator
    ) -> tuple[Points, Tally]:
        """Return `len(start)` points and the tally; see `Move`."""
        wanted, found, parts, n_evaluated = len(start), 0, [], 0
        while found < wanted:
            batch = int(1.1 * (wanted - found) / self.volume) + 1
            tried = evaluate.draw_from_prior(batch, rng)
            kept = tried.take_rows(bound.mask_above(tried.log_likelihood, tried.label))
            parts.append(kept)
            found += len(kept)
            n_evaluated += batch
        return Points.join(*parts).take_rows(slice(wanted)), Tally(n_evaluated, wanted)

    def adapted(self, tally: Tally) -> PriorRejection:
        """Return itself: there is nothing to tune."""
        return self


@dataclass(frozen=True)
class SliceMove:
    """A move by chains of slice-sampling steps (Neal 2003), all chains advancing together.

    A step draws a line through the chain's point, a bracket of fixed width placed at random about the point, and
    candidates within the bracket; a rejected candidate becomes the bracket's new end. There is no stepping out: with a
    width that does not depend on the point the step is reversible without (Neal's limit m = 1), which saves
    evaluations. Each chain goes on to its next step once a candidate is accepted, so the batches stay full.

    Where the prior is not uniform in the sampling space, a step first draws a level below the prior density at the
    point; the density at candidates must exceed that level too (Neal's auxiliary height). A rejection for that reason
    costs no likelihood.

    Four kinds of steps, each reversible by itself:

    - along the axes of the space, each on a scale drawn between the conditional and the marginal
      sd of the live points: a parameter uncorrelated with the others moves far in one step;
    - along random orthonormal directions in the metric of the live points, so that n_params
      successive steps cover every direction. Where the live points form clusters, each has its own metric and such a
      step stays within its cluster's part of space;
    - along the difference of two live points, within and between clusters;
    - a hop, where there are clusters: the affine map between two clusters takes the point to its
      counterpart in the other, accepted with the ratio of their volumes. Hops keep the share of live points in each
      mode from drifting.

    Parameters
    ----------
    steps_per_param
        Steps of a chain per parameter, not counting hops.
    width
        Bracket width in units of the live points' sd along the line.
    axes
        Share of the steps along axes.
    differences
        Share of the steps along differences of live points; the rest are along random directions.
    hops
        Number of hops per chain, where there are clusters.
    target
        Target number of candidates per step, on average; the width is tuned to it.
    fewest_steps
        Least number of steps of a chain.
    """

    steps_per_param: float = 1.0
    width: float = 5.0
    axes: float = 0.7
    differences: float = 0.1
    hops: int = 3
    target: float = 2.5
    fewest_steps: int = _FEWEST_STEPS

    def __post_init__(self) -> None:
        if not self.steps_per_param > 0:
            raise ParameterError("steps_per_param", self.steps_per_param, "greater than 0")
        if not (self.axes >= 0 and self.differences >= 0 and self.axes + self.differences <= 1):
            raise ParameterError("(axes, differences)", (self.axes, self.differences), "0 or more, together at most 1")
        if self.hops < 0:
            raise ParameterError("hops", self.hops, "0 or more")
        if self.fewest_steps < 1:
            raise ParameterError("fewest_steps", self.fewest_steps, "1 or more")

    def draw(
        self, start: Points, bound: Bound, live: FloatArray, evaluate: Evaluator, rng: np.random.Generator
    ) -> tuple[Points, Tally]:
        """Return the ends of one chain from each start, and the tally; see `Move`."""
        n_chains, n_params = start.u.shape
        chains = SliceChains(start, live, evaluate.space, width=self.width)
        n_lines = max(self.fewest_steps, math.ceil(self.steps_per_param * n_params))
        n_hops = self.hops if chains.are_in_clusters else 0
        chains.run(self._draw_kinds_of_steps(n_chains, n_lines + n_hops, n_hops, rng), bound, evaluate, rng)
        n_stuck = int((~chains.moved).sum())
        return chains.points(), Tally(chains.n_evaluated, chains.n_taken, n_stuck, chains.n_tried)

    def _draw_kinds_of_steps(self, n_chains: int, n_steps: int, n_hops: int, rng: np.random.Generator) -> IntArray:
        """Draw the kind of every step (`FRAME`, `AXIS`, `DIFFERENCE` or `HOP`), (n_chains, n_steps)."""
        lot = rng.random((n_chains, n_steps))
        kind = np.where(lot < self.axes, AXIS, np.where(lot < self.axes + self.differences, DIFFERENCE, FRAME))
        kind[:, np.linspace(0, n_steps - 1, n_hops).astype(int)] = HOP
        return kind

    def with_twice_the_steps(self) -> SliceMove:
        """Return the move with twice as many steps per chain."""
        return replace(self, steps_per_param=2.0 * self.steps_per_param, fewest_steps=2 * self.fewest_steps)

    def adapted(self, tally: Tally) -> SliceMove:
        """Return the move with its bracket width adapted towards `target` candidates per step."""
        excess = math.log(max(tally.n_tried, 1) / max(tally.n_accepted, 1) / self.target)
        return replace(self, width=min(max(self.width * math.exp(-0.5 * excess), 0.05), 20.0))
