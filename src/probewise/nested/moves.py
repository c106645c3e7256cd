"""Moves: ways to draw new points uniformly from the part of the prior above a likelihood bound."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.errors import ParameterError, require
from probewise.nested.clusters import Clusters
from probewise.nested.problem import Bound, Evaluator, Points
from probewise.nested.slice import AXIS, DIFFERENCE, FRAME, HOP, SliceChains

# With three steps in three dimensions the chains stay correlated: ln Z scattered by 1.3 of its claimed errors.
_FEWEST_STEPS = 6
_HOPS = 3
_BLOCK = 4096  # proposals evaluated at a time: their predictions stay in the cache
_DENSITY_BLOCK = 1024
_MOST_KERNELS = 100


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
        """Draw as many new points as `start` has, each distributed as the prior above `bound`; also return the tally.

        Chains may begin at the points `start`, above the bound. `live` are all known points above it in the evaluator's
        space, those of `start` included, (n, n_params).
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
            tried = evaluate(evaluate.space.draw(batch, rng=rng), rng)
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

    A chain has `steps_per_param` steps per parameter, at least `fewest_steps`, and `hops` hops more where there are
    clusters. Of the steps a share `axes` is along axes and a share `differences` along differences of live points; the
    rest are along random directions. `width` is the bracket's, in units of the live points' sd along the line; it is
    tuned so that a step takes `target` candidates on average.
    """

    steps_per_param: float = 1.0
    width: float = 5.0
    axes: float = 0.7
    differences: float = 0.1
    hops: int = _HOPS
    target: float = 2.5
    fewest_steps: int = _FEWEST_STEPS

    def __post_init__(self) -> None:
        require(self.steps_per_param > 0, "steps_per_param", self.steps_per_param, "greater than 0")
        if not (self.axes >= 0 and self.differences >= 0 and self.axes + self.differences <= 1):
            raise ParameterError("(axes, differences)", (self.axes, self.differences), "0 or more, together at most 1")
        if self.hops < 0:
            raise ParameterError("hops", self.hops, "0 or more")
        if self.fewest_steps < 1:
            raise ParameterError("fewest_steps", self.fewest_steps, "1 or more")

    def n_steps(self, n_params: int) -> int:
        """Return the number of steps of a chain, without hops."""
        return max(self.fewest_steps, math.ceil(self.steps_per_param * n_params))

    def draw(
        self, start: Points, bound: Bound, live: FloatArray, evaluate: Evaluator, rng: np.random.Generator
    ) -> tuple[Points, Tally]:
        """Return the ends of one chain from each start, and the tally; see `Move`."""
        chains = SliceChains(start, live, evaluate.space, width=self.width)
        n_hops = self.hops if chains.are_in_clusters else 0
        n_steps = self.n_steps(start.u.shape[1]) + n_hops
        lot = rng.random((len(start), n_steps))
        kinds = np.where(lot < self.axes, AXIS, np.where(lot < self.axes + self.differences, DIFFERENCE, FRAME))
        kinds[:, np.linspace(0, n_steps - 1, n_hops).astype(int)] = HOP
        chains.run(kinds, bound, evaluate, rng)
        return chains.points(), Tally(chains.n_evaluated, chains.n_taken, int((~chains.moved).sum()), chains.n_tried)

    def adapted(self, tally: Tally) -> SliceMove:
        """Return the move with its bracket width adapted towards `target` candidates per step."""
        excess = math.log(max(tally.n_tried, 1) / max(tally.n_accepted, 1) / self.target)
        return replace(self, width=min(max(self.width * math.exp(-0.5 * excess), 0.05), 20.0))


@dataclass(frozen=True, eq=False)
class HoppingMove:
    """A move that hops between modes, then runs the chains of `chains`, so that no mode dies out among the live points.

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
        return new, replace(tally, n_evaluated=tally.n_evaluated + n_hops)

    def _hop_in_place(self, now: Points, bound: Bound, evaluate: Evaluator, rng: np.random.Generator) -> None:
        """Try one hop of each point to a mode chosen at random from the others; overwrite the points that succeed."""
        modes = self.modes
        home = modes.assign(now.u)
        goal = (home + rng.integers(1, len(modes), size=len(home))) % len(modes)
        u, log_growth = modes.map_with_log_volume_ratio(now.u, home, goal)
        # The way back must be the same map.
        able = evaluate.space.inside_mask(u) & (modes.assign(u) == goal)
        level = now.log_density - log_growth - rng.standard_exponential(len(home))
        rows = able.nonzero()[0]
        theta, log_density = evaluate.space.leave(u[rows])
        dense = (log_density >= level[rows]).nonzero()[0]
        rows = rows[dense]
        tried = evaluate.evaluate_mapped(u[rows], theta[dense], log_density[dense], rng)
        won = bound.mask_above(tried.log_likelihood, tried.label).nonzero()[0]
        now.overwrite_rows(rows[won], tried, won)

    def adapted(self, tally: Tally) -> HoppingMove:
        """Return the move with its chains adapted; see `SliceMove`."""
        return HoppingMove(self.chains.adapted(tally), self.modes)


class Kernels:
    """A kernel density of Gaussians about points: half of the mass with sd `width`, half with a third of it.

    They are at up to a hundred of the points, (n_points, n_params), whitened by mean and covariance of all. The wide
    kernels lead to other modes and into corners without points, the narrow ones follow a thin or curved region.
    """

    def __init__(self, points: FloatArray, *, rng: np.random.Generator) -> None:
        n_points, n_params = points.shape
        self.mean = points.mean(axis=0)
        covariance = np.atleast_2d(np.cov(points, rowvar=False))
        scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        correlation = covariance / np.outer(scale, scale)
        self.root = scale[:, None] * np.linalg.cholesky(correlation + 1e-9 * np.eye(n_params))
        rows = rng.permutation(n_points)[:_MOST_KERNELS]
        self.centre_rows = np.linalg.solve(self.root, (points[rows] - self.mean).T).T
        # Silverman's rule: the optimal width for Gaussian points.
        self.width = (4 / (n_params + 2) / len(rows)) ** (1 / (n_params + 4))

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw points, (n, n_params)."""
        rows = rng.integers(len(self.centre_rows), size=n)
        width = np.where(rng.random(n) < 0.5, self.width, self.width / 3)
        white = self.centre_rows[rows] + width[:, None] * rng.standard_normal((n, self.root.shape[0]))
        return np.asarray(self.mean + white @ self.root.T)

    def log_density(self, points: FloatArray) -> FloatArray:
        """Natural log of the density up to a constant, (n, n_params) -> (n,)."""
        white = np.linalg.solve(self.root, (points - self.mean).T).T / (math.sqrt(2) * self.width)
        blocks = np.array_split(white, max(1, -(-len(white) // _DENSITY_BLOCK)))
        return np.concatenate([self._log_density_of_block(block) for block in blocks])

    def _log_density_of_block(self, white: FloatArray) -> FloatArray:
        # Single precision (1e-5, enough for a proposal) halves the time of the exponentials.
        centres = (self.centre_rows / (math.sqrt(2) * self.width)).astype(np.float32)
        rows = white.astype(np.float32)
        square = (rows * rows).sum(axis=1)[:, None] + (centres * centres).sum(axis=1) - 2.0 * rows @ centres.T
        nearest = np.maximum(square.min(axis=1), 0.0)
        # Relative to the nearest kernel, so that far points do not underflow.
        wide = np.exp(nearest[:, None] - square)
        power = np.square(np.square(np.square(wide)))  # the ninth power is a kernel a third as wide
        power *= wide
        fall = nearest.astype(np.float64)
        narrow = power.sum(axis=1).astype(np.float64) * 3.0 ** len(self.mean)
        return np.asarray(np.log(wide.sum(axis=1).astype(np.float64) + narrow * np.exp(-8.0 * fall)) - fall)


@dataclass(frozen=True)
class KernelMove:
    """A move that draws above a bound by independent proposals from kernels about the live points.

    Every chain starts at a live point and accepts or rejects its proposals in turn (independence Metropolis-Hastings;
    Hastings 1970; Tierney 1994), so the prior above the bound is left invariant; with `moves` accepted on average it
    forgets its start. Proposals that do not depend on a chain's position are evaluated in one batch: for a robot that
    infers after every reading, the overhead per call exceeds the cost of the likelihood. Suited to few parameters,
    where many proposals lie above the bound. Where fewer than one in `patience` is accepted, the chains of `otherwise`
    go on from the ends.

    `moves` is the target number of accepted proposals per chain, on average; a chain with none stays at its start,
    which is valid, and about exp(-moves) of the chains do. `n_proposals`, of a chain, is tuned to that target.
    """

    moves: float = 10.0
    n_proposals: int = 16
    patience: float = 60.0
    otherwise: SliceMove = field(default_factory=SliceMove)

    def __post_init__(self) -> None:
        require(self.moves > 0, "moves", self.moves, "greater than 0")
        require(self.n_proposals >= 1, "n_proposals", self.n_proposals, "1 or more")
        require(self.patience >= 1, "patience", self.patience, "1 or more")

    def draw(
        self, start: Points, bound: Bound, live: FloatArray, evaluate: Evaluator, rng: np.random.Generator
    ) -> tuple[Points, Tally]:
        """Return the ends of one chain from each start, and the tally; see `Move`."""
        n_chains, space = len(start), evaluate.space
        kernels = Kernels(live, rng=rng)
        n_tries = n_chains * self.n_proposals
        u = kernels.draw(n_tries, rng=rng)
        log_target = -kernels.log_density(u)
        inside = np.flatnonzero(((u >= space.low) & (u <= space.high)).all(axis=1))
        parts = [evaluate(u[rows], rng) for rows in np.array_split(inside, max(1, -(-inside.size // _BLOCK)))]
        tried = Points.join(*parts)
        log_target[inside] += tried.log_density
        admitted = np.zeros(n_tries, dtype=bool)
        admitted[inside] = bound.mask_above(tried.log_likelihood, tried.label)
        log_odds = np.log(rng.random((self.n_proposals, n_chains)))
        log_now = start.log_density - kernels.log_density(start.u)
        last, n_accepted = _accept_in_turn(admitted, log_target, log_now, log_odds)
        where = np.empty(n_tries, dtype=np.int64)
        where[inside] = np.arange(inside.size)
        moved = last >= 0
        ends = start.copy()
        ends.overwrite_rows(moved, tried, where[last[moved]])
        tally = Tally(inside.size, n_accepted)
        if n_accepted * self.patience < n_tries:
            ends, more = self.otherwise.draw(ends, bound, live, evaluate, rng)
            tally = Tally(inside.size + more.n_evaluated, n_accepted, more.n_stuck)
        return ends, tally

    def adapted(self, tally: Tally) -> KernelMove:
        """Return the move with its number of proposals adapted towards `moves` accepted ones."""
        share = max(tally.n_accepted, 1) / max(tally.n_evaluated, 1)
        wanted = min(self.moves / share, 2.0 * self.n_proposals, 2.0 * self.patience)
        return replace(self, n_proposals=max(8, math.ceil(wanted)))


def _accept_in_turn(
    possible: BoolArray, log_target: FloatArray, log_now: FloatArray, log_odds: FloatArray
) -> tuple[np.ndarray, int]:
    """Let every chain accept or reject its proposals in turn (Metropolis-Hastings with independent proposals).

    `possible`, whether each proposal lies above the bound, and `log_target`, the log of target over proposal density,
    are (n_steps * n_chains,), steps first; `log_now` is that log at the starts, (n_chains,). `log_odds`: logs of
    uniform numbers, (n_steps, n_chains). Return the index of the proposal that each chain accepted last, -1 for none,
    (n_chains,), and the number of acceptances.
    """
    n_steps, n_chains = log_odds.shape
    log_target = np.where(possible, log_target, -np.inf).reshape(n_steps, n_chains)
    now, last, n_accepted = log_now, np.full(n_chains, -1), 0
    for k, target in enumerate(log_target):
        accept = log_odds[k] < target - now
        now, last = np.where(accept, target, now), np.where(accept, k, last)
        n_accepted += int(np.count_nonzero(accept))
    return np.where(last < 0, -1, last * n_chains + np.arange(n_chains)), n_accepted
