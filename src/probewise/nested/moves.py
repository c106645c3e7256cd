"""Moves: ways to draw new points uniformly from the part of the prior above a likelihood bound."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.errors import require
from probewise.nested.clusters import Clusters, find_clusters
from probewise.nested.problem import Bound, Evaluator, Points, Space

FRAME, AXIS, DIFFERENCE, HOP = 0, 1, 2, 3
"""Kinds of steps: along random orthonormal directions, axes, differences of live points; and hops between clusters."""

# Candidates drawn ahead of their rejection, where few chains are left.
_MOST_AHEAD = 4
_NOTHING = 1e-13  # length of a bracket that has shrunk to a point


@dataclass(eq=False)
class _Candidates:
    """Candidates of one round, `n_ahead` for each of the chains `rows`, chain by chain: n in all."""

    rows: IntArray
    chain: IntArray  # of each candidate, (n,), as what follows
    n_ahead: int
    u: FloatArray  # its place, (n, n_params)
    level: FloatArray  # the log prior density that it must exceed
    cluster: IntArray  # in which it lies
    possible: BoolArray  # whether it may be accepted
    hop: BoolArray  # of each chain, (n_rows,): whether its step is a hop
    shrunk: BoolArray  # and whether its bracket has shrunk to nothing


class SliceChains:
    """Chains that start at points above a bound, one at each.

    `live`: all known points above the bound, those of `start` included, (n, n_params). `width`: of a bracket, in units
    of the live points' sd along the line.
    """

    def __init__(self, start: Points, live: FloatArray, space: Space, *, width: float) -> None:
        self._space, self._width, self._columns = space, width, list(space.periodic)
        # Lower and upper bounds of the coordinates, None without any; periodic ones are not bounded.
        low, high = space.bounds
        low[self._columns], high[self._columns] = -np.inf, np.inf
        self._walls = (low, high) if np.isfinite(low).any() or np.isfinite(high).any() else None
        # Each periodic coordinate is cut in the middle of the widest gap between live points, so that no peak is split
        # at the ends. A candidate is wrapped before it is evaluated, so that a step and its reverse use the same metric
        # and clusters.
        place = np.sort(live[:, self._columns] % 1.0, axis=0)
        gap = np.diff(place, axis=0, append=place[:1] + 1.0)
        widest = np.argmax(gap, axis=0), np.arange(len(self._columns))
        self._cut = (place[widest] + 0.5 * gap[widest]) % 1.0
        self._live, u = self._wrapped(live, self._cut), self._wrapped(start.u, self._cut)
        self._clusters = find_clusters(self._live)
        n_chains, n_params = u.shape
        self._now = replace(start, u=u).copy()
        self._home = self._clusters.assign(u)
        # The clusters, followed by the starting cluster of each chain without the starting point: a covariance that
        # includes the start stretches the lines through it and shrinks the others; with 150 live points in 20
        # dimensions that alone raised log Z by more than one.
        same = np.logical_and.reduce(
            [ours == of_start[:, None] for ours, of_start in zip(self._live.T, u.T, strict=True)]
        )
        self._own_row = np.argmax(same, axis=1)  # of each start among the live points
        self._own_home = np.where(same.any(axis=1), self._home, -1)  # a start that is not a live point is in no cluster
        self._each = Clusters.join(self._clusters, self._clusters.home_clusters_without_each_point(u, self._home))
        # For each of these rows and every axis the conditional sd, and the ratio of the marginal sd to it.
        self._conditional = 1.0 / np.sqrt((self._each.inverse_root**2).sum(axis=1))
        self._widening = np.sqrt((self._each.root**2).sum(axis=2)) / self._conditional
        self._line = np.empty((n_chains, n_params))
        self._low, self._high, self._level = np.empty(n_chains), np.empty(n_chains), np.empty(n_chains)
        self._step = np.zeros(n_chains, dtype=np.int64)
        self.moved = np.zeros(n_chains, dtype=bool)
        self.n_evaluated = self.n_tried = self.n_taken = 0

    @property
    def are_in_clusters(self) -> bool:
        """Whether the live points form more than one cluster, between which chains may hop."""
        return len(self._clusters) > 1

    def points(self) -> Points:
        """Return where the chains are."""
        return replace(self._now, u=self._wrapped(self._now.u, 0.0))

    def _wrapped(self, u: FloatArray, begin: FloatArray | float) -> FloatArray:
        if self._columns:
            u = u.copy()
            u[:, self._columns] = begin + (u[:, self._columns] - begin) % 1.0
        return u

    def _metric_rows(self, rows: IntArray, home: IntArray) -> IntArray:
        """Return the row of `_each` for cluster `home` of the chains `rows`, (n,): its own where it began in it."""
        return np.where(home == self._own_home[rows], len(self._clusters) + rows, home)

    def run(self, kinds: IntArray, bound: Bound, evaluate: Evaluator, rng: np.random.Generator) -> None:
        """Take the steps of the given kinds, (n_chains, n_steps), above `bound`.

        Afterwards `moved` (n_chains,) says which chains left their start; `n_evaluated` likelihoods were evaluated, and
        of `n_tried` candidates on lines `n_taken` were accepted.
        """
        (n_chains, n_steps), n_params = kinds.shape, self._line.shape[1]
        self._kinds = kinds
        self._frames = _random_orthonormal_directions(kinds == FRAME, n_params, rng)
        # Axes in random order, without repetition until all were used.
        turns = rng.random((n_chains, -(-n_steps // n_params), n_params))
        self._axes = np.argsort(turns, axis=2).reshape(n_chains, -1)[:, :n_steps]
        active = np.arange(n_chains)
        self._begin_step(active, rng)
        while active.size:
            candidates = self._draw_candidates(active, rng)
            done = active[self._advance(candidates, bound, evaluate, rng)]
            self._step[done] += 1
            more = done[self._step[done] < n_steps]
            if more.size < done.size:
                active = active[self._step[active] < n_steps]
            if more.size:
                self._begin_step(more, rng)

    def _begin_step(self, rows: IntArray, rng: np.random.Generator) -> None:
        at = self._step[rows]
        kinds, measure = self._kinds[rows, at], self._metric_rows(rows, self._home[rows])
        toward = np.zeros((rows.size, self._line.shape[1]))
        turned, along, follow = ((kinds == one).nonzero()[0] for one in (FRAME, AXIS, DIFFERENCE))
        if turned.size:
            frame = self._frames[rows[turned], at[turned]]
            root = self._each.root[measure[turned]]
            toward[turned] = self._width * np.matmul(root, frame[:, :, None])[:, :, 0]
        if along.size:
            which = self._axes[rows[along], at[along]]
            least, most = (sds[measure[along], which] for sds in (self._conditional, self._widening))
            toward[along, which] = self._width * least * most ** rng.random(along.size)
        if follow.size:
            n = len(self._live)
            first = rng.integers(n - 1, size=follow.size)
            second = (first + rng.integers(1, n - 1, size=follow.size)) % (n - 1)
            # Counted cyclically from the row after the chain's own start, so that neither is the start.
            behind = self._own_row[rows[follow]] + 1
            toward[follow] = 2.0 * (self._live[(behind + first) % n] - self._live[(behind + second) % n])
        self._line[rows] = toward
        self._low[rows], self._high[rows] = _random_bracket(self._now.u, rows, toward, self._walls, rng)
        self._level[rows] = self._now.log_density[rows] - rng.standard_exponential(rows.size)

    def _draw_candidates(self, rows: IntArray, rng: np.random.Generator) -> _Candidates:
        """Draw the next candidates of the chains `rows`, and shrink their brackets as if all were rejected."""
        # A rejection shrinks the bracket whatever the likelihood was, so candidates can be drawn ahead and evaluated
        # together: the chain is the same, at the cost of a few evaluations for full batches.
        n_ahead = min(_MOST_AHEAD, max(1, len(self._step) // (2 * rows.size)))
        below, above, t = self._low[rows], self._high[rows], np.empty((rows.size, n_ahead))
        for k in range(n_ahead):
            t[:, k] = here = below + (above - below) * rng.random(rows.size)
            ahead = here > 0
            below, above = np.where(ahead, below, here), np.where(ahead, here, above)
        self._low[rows], self._high[rows] = below, above
        chain = rows.repeat(n_ahead)
        u = self._now.u.take(rows, axis=0)[:, None, :] + t[:, :, None] * self._line.take(rows, axis=0)[:, None, :]
        u = self._wrapped(u.reshape(-1, self._line.shape[1]), self._cut)
        if self._walls is not None:
            np.clip(u, *self._walls, out=u)
        possible, hop = np.ones(chain.size, dtype=bool), np.zeros(rows.size, dtype=bool)
        level, cluster = self._level[chain], self._home[chain]
        found = _Candidates(rows, chain, n_ahead, u, level, cluster, possible, hop, above - below < _NOTHING)
        if self.are_in_clusters:
            self._keep_to_clusters(found, rng)
        return found

    def _keep_to_clusters(self, candidates: _Candidates, rng: np.random.Generator) -> None:
        """Replace candidates of hops by counterparts in another cluster, and rule out those that end elsewhere."""
        kinds = self._kinds[candidates.chain, self._step[candidates.chain]]
        hopping, goal = kinds == HOP, candidates.cluster.copy()
        candidates.hop = hopping[:: candidates.n_ahead]
        if candidates.hop.any():
            # A hop has a single candidate: the first; the others are void.
            candidates.possible[hopping] = np.arange(hopping.size)[hopping] % candidates.n_ahead == 0
            first = (hopping & candidates.possible).nonzero()[0]
            who = candidates.chain[first]
            goal[first] = (self._home[who] + rng.integers(1, len(self._clusters), size=who.size)) % len(self._clusters)
            home, there = (self._metric_rows(who, k) for k in (self._home[who], goal[first]))
            to, log_growth = self._each.map_with_log_volume_ratio(self._now.u[who], home, there)
            candidates.u[first] = to
            # Across the cut of a circle the reverse hop would differ.
            candidates.possible[first] &= (self._wrapped(to, self._cut) == to).all(axis=1)
            candidates.level[first] -= log_growth
            if self._walls is not None:
                candidates.possible[first] &= ((to >= self._walls[0]) & (to <= self._walls[1])).all(axis=1)
        candidates.cluster = self._clusters.assign(candidates.u)
        candidates.possible &= (kinds == DIFFERENCE) | (candidates.cluster == goal)

    def _advance(
        self, candidates: _Candidates, bound: Bound, evaluate: Evaluator, rng: np.random.Generator
    ) -> BoolArray:
        """Move each chain to the first of its candidates that is accepted; return whose step has ended, (n_rows,)."""
        accepted = np.zeros(len(candidates.u), dtype=bool)
        pending = candidates.possible.nonzero()[0]
        if pending.size:
            theta, log_density = self._space.leave(candidates.u.take(pending, axis=0))
            above_level = (log_density >= candidates.level[pending]).nonzero()[0]
            theta, log_density = theta.take(above_level, axis=0), log_density[above_level]
            pending = pending[above_level]
        if pending.size:
            tried = evaluate.evaluate_mapped(candidates.u.take(pending, axis=0), theta, log_density, rng)
            accepted[pending] = bound.mask_above(tried.log_likelihood, tried.label)
            self.n_evaluated += pending.size
        by_chain = accepted.reshape(-1, candidates.n_ahead)
        delivered = np.asarray(by_chain.any(axis=1))
        n_needed = np.where(delivered, np.argmax(by_chain, axis=1) + 1, candidates.n_ahead)
        won = delivered.nonzero()[0]
        if won.size:
            taken, which = candidates.rows[won], won * candidates.n_ahead + n_needed[won] - 1
            self._now.overwrite_rows(taken, tried, np.searchsorted(pending, which))
            self._home[taken] = candidates.cluster[which]
            self.moved[taken] = True
        self.n_tried += int(n_needed[~candidates.hop].sum())
        self.n_taken += int(np.count_nonzero(delivered & ~candidates.hop))
        # A bracket that has shrunk to nothing (a point alone on its line) ends the step at its start.
        return np.asarray(delivered | candidates.hop | candidates.shrunk)


def _random_orthonormal_directions(needed: BoolArray, n_params: int, rng: np.random.Generator) -> FloatArray:
    """Draw rows of random orthogonal matrices where `needed`, (n_chains, n_steps), is true.

    Return (n_chains, n_steps rounded up to whole matrices, n_params). A matrix of which no row is needed is left as
    drawn, not orthogonalised, which saves time.
    """
    n_chains, n_steps = needed.shape
    first = np.arange(0, n_steps, n_params)
    frames = rng.standard_normal((n_chains, first.size, n_params, n_params))
    used = np.logical_or.reduceat(needed, first, axis=1)
    frames[used] = np.linalg.qr(frames[used])[0]
    return frames.reshape(n_chains, first.size * n_params, n_params)


def _random_bracket(
    u: FloatArray,
    rows: IntArray,
    line: FloatArray,
    walls: tuple[FloatArray, FloatArray] | None,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Place a bracket of length one at random about each point `u[rows]`, truncated where the line leaves the space.

    Return its ends in units of `line`, (n,) each; the point is at zero.
    """
    low = -rng.random(rows.size)
    if walls is None:
        return low, low + 1.0
    u = u.take(rows, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_low, to_high = (walls[0] - u) / line, (walls[1] - u) / line
    still = line == 0
    entry = np.where(still, -np.inf, np.minimum(to_low, to_high)).max(axis=1)
    leave = np.where(still, np.inf, np.maximum(to_low, to_high)).min(axis=1)
    return np.maximum(low, entry), np.minimum(low + 1.0, leave)


# With three steps in three dimensions the chains stay correlated: ln Z scattered by 1.3 of its claimed errors.
_FEWEST_STEPS = 6
_HOPS = 3
_BLOCK = 4096  # proposals evaluated at a time: their predictions stay in the cache
_DENSITY_BLOCK = 1024
_MOST_KERNELS = 100


@dataclass(frozen=True)
class Tally:
    """Statistics of a move, by which it tunes itself."""

    n_evaluated: int  # likelihood evaluations
    n_accepted: int
    n_stuck: int = 0  # chains that never left their start
    n_tried: int = 0  # candidates


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
    evaluations. Where the prior is not uniform in the sampling space, a step first draws a level below the prior
    density at the point, which the density at candidates must exceed too (Neal's auxiliary height).

    Four kinds of steps, each reversible by itself: along the axes of the space, on a scale drawn between the
    conditional and the marginal sd of the live points; along random orthonormal directions in the metric of the live
    points, of their cluster where they form several; along the difference of two live points, within and between
    clusters; a hop, where there are clusters: the affine map between two of them takes the point to its counterpart,
    accepted with the ratio of their volumes, which keeps the share of live points in each mode from drifting.

    `modes`, clusters of the posterior in the sampling coordinates, are hopped between, too, before each chain: among
    the live points a mode shows only while it has enough for a covariance. Level sets of a mode keep about the same
    shape far below its top, so the maps serve from where modes separate.
    """

    steps_per_param: float = 1.0
    width: float = 5.0  # of the bracket, in units of the live points' sd along the line
    axes: float = 0.7  # share of steps along axes
    differences: float = 0.1  # and along differences; the rest are along random directions
    hops: int = _HOPS  # more, where there are clusters
    target: float = 2.5  # candidates of a step on average, to which the width is tuned
    fewest_steps: int = _FEWEST_STEPS
    modes: Clusters | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        require(self.steps_per_param > 0, "steps_per_param", self.steps_per_param, "greater than 0")
        shares = self.axes, self.differences
        require(min(shares) >= 0 and sum(shares) <= 1, "(axes, differences)", shares, "0 or more, together at most 1")
        require(self.hops >= 0, "hops", self.hops, "0 or more")
        require(self.fewest_steps >= 1, "fewest_steps", self.fewest_steps, "1 or more")

    def n_steps(self, n_params: int) -> int:
        """Return the number of steps of a chain, without hops."""
        return max(self.fewest_steps, math.ceil(self.steps_per_param * n_params))

    def draw(
        self, start: Points, bound: Bound, live: FloatArray, evaluate: Evaluator, rng: np.random.Generator
    ) -> tuple[Points, Tally]:
        """Return the ends of one chain from each start, and the tally; see `Move`."""
        n_before = evaluate.n_calls
        if self.modes is not None:
            start = start.copy()
            for _ in range(_HOPS):
                _hop_in_place(start, self.modes, bound, evaluate, rng)
        n_of_hops = evaluate.n_calls - n_before
        chains = SliceChains(start, live, evaluate.space, width=self.width)
        n_hops = self.hops if chains.are_in_clusters else 0
        n_steps = self.n_steps(start.u.shape[1]) + n_hops
        lot = rng.random((len(start), n_steps))
        kinds = np.where(lot < self.axes, AXIS, np.where(lot < self.axes + self.differences, DIFFERENCE, FRAME))
        kinds[:, np.linspace(0, n_steps - 1, n_hops).astype(int)] = HOP
        chains.run(kinds, bound, evaluate, rng)
        n_evaluated, n_stuck = chains.n_evaluated + n_of_hops, int((~chains.moved).sum())
        return chains.points(), Tally(n_evaluated, chains.n_taken, n_stuck, chains.n_tried)

    def adapted(self, tally: Tally) -> SliceMove:
        """Return the move with its bracket width adapted towards `target` candidates per step."""
        excess = math.log(max(tally.n_tried, 1) / max(tally.n_accepted, 1) / self.target)
        return replace(self, width=min(max(self.width * math.exp(-0.5 * excess), 0.05), 20.0))


def _hop_in_place(now: Points, modes: Clusters, bound: Bound, evaluate: Evaluator, rng: np.random.Generator) -> None:
    """Try one hop of each point to a mode chosen at random from the others; overwrite the points that succeed."""
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
    Hastings 1970; Tierney 1994), so the prior above the bound is left invariant. Proposals that do not depend on a
    chain's position are evaluated in one batch: for a robot that infers after every reading, the overhead per call
    exceeds the cost of the likelihood. Suited to few parameters, where many proposals lie above the bound. Where fewer
    than one in `patience` is accepted, the chains of `otherwise` go on from the ends.
    """

    moves: float = 10.0  # accepted per chain on average; about exp(-moves) of the chains stay at their start
    n_proposals: int = 16  # of a chain, tuned to that
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
        inside = np.flatnonzero(space.inside_mask(u))
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
    are (n_steps * n_chains,), steps first; `log_now` is that log at the starts, `log_odds` logs of uniform numbers,
    (n_steps, n_chains). Return the number of the proposal that each chain accepted last, -1 for none, and how many it
    was in all.
    """
    n_steps, n_chains = log_odds.shape
    log_target = np.where(possible, log_target, -np.inf).reshape(n_steps, n_chains)
    now, last, n_accepted = log_now, np.full(n_chains, -1), 0
    for k, target in enumerate(log_target):
        accept = log_odds[k] < target - now
        now, last = np.where(accept, target, now), np.where(accept, k, last)
        n_accepted += int(np.count_nonzero(accept))
    return np.where(last < 0, -1, last * n_chains + np.arange(n_chains)), n_accepted
