"""Chains of slice-sampling steps, all advancing together: the engine of `SliceMove`, which describes the steps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
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
        low, high = space.low, space.high
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
        self._axes = _axis_numbers_in_random_order(n_chains, n_steps, n_params, rng)
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
        n_ahead = min(_MOST_AHEAD, max(1, len(self._step) // (2 * rows.size)))
        t, below, above = _draw_candidates_ahead(self._low[rows], self._high[rows], n_ahead, rng)
        self._low[rows], self._high[rows] = below, above
        chain = rows.repeat(n_ahead)
        ahead = self._now.u.take(rows, axis=0)[:, None, :] + t[:, :, None] * self._line.take(rows, axis=0)[:, None, :]
        u = self._wrapped(ahead.reshape(-1, self._line.shape[1]), self._cut)
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


def _draw_candidates_ahead(
    low: FloatArray, high: FloatArray, n_ahead: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Draw the next candidates on each line as if all before were rejected, in units of the line, (n, n_ahead).

    Also return the ends of the bracket if all are rejected, (n,) each. A rejection shrinks the bracket whatever the
    likelihood was, so candidates can be drawn ahead and evaluated together: the chain is the same, at the cost of a few
    evaluations for full batches.
    """
    t = np.empty((len(low), n_ahead))
    for k in range(n_ahead):
        t[:, k] = here = low + (high - low) * rng.random(len(low))
        ahead = here > 0
        low, high = np.where(ahead, low, here), np.where(ahead, here, high)
    return t, low, high


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


def _axis_numbers_in_random_order(n_chains: int, n_steps: int, n_params: int, rng: np.random.Generator) -> IntArray:
    """Draw axis numbers, (n_chains, n_steps), in random order without repetition until all were used."""
    n_turns = -(-n_steps // n_params)
    return np.argsort(rng.random((n_chains, n_turns, n_params)), axis=2).reshape(n_chains, -1)[:, :n_steps]


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
