"""Draw new points uniformly from the part of the prior above a likelihood bound."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.errors import ParameterError
from probewise.nested.clusters import Clusters, find_clusters
from probewise.nested.evaluate import Bound, Evaluator, Points
from probewise.nested.space import Space

# Candidates drawn ahead of their rejection, where few chains are left.
_MOST_AHEAD = 4
# With three steps in three dimensions the chains stay correlated: ln Z scattered by 1.3 of its claimed errors.
_FEWEST_STEPS = 6
_FRAME, _AXIS, _DIFFERENCE, _HOP = 0, 1, 2, 3


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
        space = evaluate.space
        walls = _bounds_of_coordinates(space)
        periodic = _PeriodicAxes.cut_where_empty(space.periodic, live)
        if periodic is not None:
            live = periodic.wrapped_at_cut(live)
            start = replace(start, u=periodic.wrapped_at_cut(start.u))
        clusters = find_clusters(live)
        n_lines = max(self.fewest_steps, math.ceil(self.steps_per_param * n_params))
        n_hops = self.hops if len(clusters) > 1 else 0
        n_steps = n_lines + n_hops
        kind = self._draw_kinds_of_steps(n_chains, n_steps, n_hops, rng)
        frames = _random_orthonormal_directions(kind == _FRAME, n_params, rng)
        axis = _axis_numbers_in_random_order(n_chains, n_steps, n_params, rng)
        now = start.copy()
        home = clusters.assign(now.u)
        metrics = _ClusterCovariancesByChain.from_clusters(clusters, start.u, home, live)
        line = np.empty((n_chains, n_params))
        low, high, level = np.empty(n_chains), np.empty(n_chains), np.empty(n_chains)
        step = np.zeros(n_chains, dtype=np.int64)
        moved = np.zeros(n_chains, dtype=bool)
        n_evaluated = n_tried = n_taken = 0

        def begin_step(rows: IntArray) -> None:
            """Set up the line, the bracket and the level of the next step of the chains `rows`."""
            at = step[rows]
            kinds, measure = kind[rows, at], metrics.covariance_row_of_each_chain(rows, home[rows])
            toward = np.zeros((rows.size, n_params))
            turned, along, follow = ((kinds == one).nonzero()[0] for one in (_FRAME, _AXIS, _DIFFERENCE))
            if turned.size:
                frame = frames[rows[turned], at[turned]]
                toward[turned] = self.width * np.matmul(metrics.each.root[measure[turned]], frame[:, :, None])[:, :, 0]
            if along.size:
                which = axis[rows[along], at[along]]
                least, widening = metrics.conditional[measure[along], which], metrics.widening[measure[along], which]
                toward[along, which] = self.width * least * widening ** rng.random(along.size)
            if follow.size:
                n = len(live)
                first = rng.integers(n - 1, size=follow.size)
                second = (first + rng.integers(1, n - 1, size=follow.size)) % (n - 1)
                # Counted cyclically from the row after the chain's own start, so that neither is the start.
                behind = metrics.own_row[rows[follow]] + 1
                toward[follow] = 2.0 * (live[(behind + first) % n] - live[(behind + second) % n])
            line[rows] = toward
            low[rows], high[rows] = _random_bracket(now.u, rows, toward, walls, rng)
            level[rows] = now.log_density[rows] - rng.standard_exponential(rows.size)

        active = np.arange(n_chains)
        begin_step(active)
        while active.size:
            rows, n_ahead = active, min(_MOST_AHEAD, max(1, n_chains // (2 * active.size)))
            t, below, above = _draw_candidates_ahead(low[rows], high[rows], n_ahead, rng)
            low[rows], high[rows] = below, above
            chain = rows.repeat(n_ahead)
            ahead = now.u.take(rows, axis=0)[:, None, :] + t[:, :, None] * line.take(rows, axis=0)[:, None, :]
            candidate = ahead.reshape(-1, n_params)
            if periodic is not None:
                candidate = periodic.wrapped_at_cut(candidate)
            if walls is not None:
                np.clip(candidate, *walls, out=candidate)
            least = level[chain]
            ok = np.ones(chain.size, dtype=bool)
            place = home[chain]
            hop = np.zeros(rows.size, dtype=bool)
            if len(clusters) > 1:
                kinds = kind[chain, step[chain]]
                hopping = kinds == _HOP
                hop = hopping[::n_ahead]
                goal = place.copy()
                if hop.any():
                    # A hop has a single candidate: the first; the others are void.
                    ok[hopping] = np.arange(chain.size)[hopping] % n_ahead == 0
                    first = (hopping & ok).nonzero()[0]
                    who = chain[first]
                    goal[first] = (home[who] + rng.integers(1, len(clusters), size=who.size)) % len(clusters)
                    candidate[first], log_growth = metrics.map_with_log_volume_ratio(
                        who, now.u[who], home[who], goal[first]
                    )
                    if periodic is not None:
                        # Across the cut of a circle the reverse hop would differ.
                        ok[first] &= (periodic.wrapped_at_cut(candidate[first]) == candidate[first]).all(axis=1)
                    least[first] -= log_growth
                    if walls is not None:
                        ok[first] &= ((candidate[first] >= walls[0]) & (candidate[first] <= walls[1])).all(axis=1)
                place = clusters.assign(candidate)
                ok &= (kinds == _DIFFERENCE) | (place == goal)
            pending = ok.nonzero()[0]
            if pending.size:
                theta, log_density = space.leave(candidate.take(pending, axis=0))
                above_level = (log_density >= least[pending]).nonzero()[0]
                theta, log_density = theta.take(above_level, axis=0), log_density[above_level]
                pending = pending[above_level]
                ok[:] = False
            if pending.size:
                tried = evaluate.evaluate_mapped(candidate.take(pending, axis=0), theta, log_density, rng)
                ok[pending] = bound.mask_above(tried.log_likelihood, tried.label)
                n_evaluated += pending.size
            n_needed, delivered = _count_candidates_used(ok.reshape(-1, n_ahead))
            won = delivered.nonzero()[0]
            if won.size:
                # A chain takes the first of its candidates above the bound.
                taken, which = rows[won], won * n_ahead + n_needed[won] - 1
                now.overwrite_rows(taken, tried, np.searchsorted(pending, which))
                home[taken] = place[which]
                moved[taken] = True
            n_tried += int(n_needed[~hop].sum())
            n_taken += int(np.count_nonzero(delivered & ~hop))
            # A bracket that has shrunk to zero (a point alone on its line) ends the step at its start.
            done = rows[delivered | hop | (above - below < 1e-13)]
            step[done] += 1
            more = done[step[done] < n_steps]
            if more.size < done.size:
                active = active[step[active] < n_steps]
            if more.size:
                begin_step(more)
        if periodic is not None:
            now = replace(now, u=periodic.wrapped_to_unit(now.u))
        return now, Tally(n_evaluated, n_taken, int((~moved).sum()), n_tried)

    def _draw_kinds_of_steps(self, n_chains: int, n_steps: int, n_hops: int, rng: np.random.Generator) -> IntArray:
        """Draw the kind of every step (`_FRAME`, `_AXIS`, `_DIFFERENCE` or `_HOP`), (n_chains, n_steps)."""
        lot = rng.random((n_chains, n_steps))
        kind = np.where(lot < self.axes, _AXIS, np.where(lot < self.axes + self.differences, _DIFFERENCE, _FRAME))
        kind[:, np.linspace(0, n_steps - 1, n_hops).astype(int)] = _HOP
        return kind

    def with_twice_the_steps(self) -> SliceMove:
        """Return the move with twice as many steps per chain."""
        return replace(self, steps_per_param=2.0 * self.steps_per_param, fewest_steps=2 * self.fewest_steps)

    longer = with_twice_the_steps  # its earlier name

    def adapted(self, tally: Tally) -> SliceMove:
        """Return the move with its bracket width adapted towards `target` candidates per step."""
        excess = math.log(max(tally.n_tried, 1) / max(tally.n_accepted, 1) / self.target)
        return replace(self, width=min(max(self.width * math.exp(-0.5 * excess), 0.05), 20.0))


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


def _count_candidates_used(ok: BoolArray) -> tuple[IntArray, BoolArray]:
    """Count the candidates each step used, given which are accepted, (n, n_ahead); also whether any is, (n,) each."""
    delivered = np.asarray(ok.any(axis=1))
    return np.where(delivered, np.argmax(ok, axis=1) + 1, ok.shape[1]), delivered


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


@dataclass(frozen=True, eq=False)
class _ClusterCovariancesByChain:
    """The clusters' covariances for each chain: its own cluster is computed without the chain's starting point.

    A covariance that includes the start stretches the lines through it and shrinks the others; with 150 live points in
    20 dimensions that alone raised log Z by more than one.

    `each`: the clusters, followed by each chain's version of its starting cluster. `conditional` and `widening`: for
    each of these rows and every axis the conditional sd, and the ratio of the marginal sd to it.
    """

    each: Clusters
    conditional: FloatArray
    widening: FloatArray
    n_clusters: int
    own_home: IntArray
    own_row: IntArray  # row of the start among the live points

    @classmethod
    def from_clusters(
        cls, clusters: Clusters, u: FloatArray, home: IntArray, live: FloatArray
    ) -> _ClusterCovariancesByChain:
        """Compute the covariances for chains that start at `u`, (n_chains, n_params), in clusters `home`."""
        same = np.logical_and.reduce(
            [of_live == of_start[:, None] for of_live, of_start in zip(live.T, u.T, strict=True)]
        )
        # A start that is not a live point is in no cluster.
        own_home = np.where(same.any(axis=1), home, -1)
        each = clusters.followed_by(clusters.home_clusters_without_each_point(u, home))
        conditional = 1.0 / np.sqrt((each.inverse_root**2).sum(axis=1))
        return cls(
            each,
            conditional,
            np.sqrt((each.root**2).sum(axis=2)) / conditional,
            len(clusters),
            own_home,
            np.argmax(same, axis=1),
        )

    def covariance_row_of_each_chain(self, rows: IntArray, home: IntArray) -> IntArray:
        """Return the row of `each` for cluster `home` of the chains `rows`, (n,).

        For the cluster in which a chain began it is the version without the chain's start.
        """
        return np.where(home == self.own_home[rows], self.n_clusters + rows, home)

    def map_with_log_volume_ratio(
        self, rows: IntArray, u: FloatArray, home: IntArray, goal: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Map points of chains `rows` from clusters `home` to `goal`; also return the log of the volume ratio, (n,)."""
        return self.each.map_with_log_volume_ratio(
            u, self.covariance_row_of_each_chain(rows, home), self.covariance_row_of_each_chain(rows, goal)
        )


@dataclass(frozen=True, eq=False)
class _PeriodicAxes:
    """Periodic coordinates, each cut in the widest gap between live points, so that no peak is split at the ends.

    A candidate is wrapped before it is evaluated, so that a step and its reverse use the same metric and clusters.
    """

    columns: IntArray
    cut: FloatArray

    @classmethod
    def cut_where_empty(cls, periodic: tuple[int, ...], live: FloatArray) -> _PeriodicAxes | None:
        """Cut each circle in the middle of the widest gap between live points, (n_live, n_params); None without any."""
        if not periodic:
            return None
        columns = np.array(periodic)
        place = np.sort(live[:, columns] % 1.0, axis=0)
        gap = np.diff(place, axis=0, append=place[:1] + 1.0)
        widest = np.argmax(gap, axis=0)
        each = np.arange(len(columns))
        return cls(columns, (place[widest, each] + 0.5 * gap[widest, each]) % 1.0)

    def wrapped_at_cut(self, u: FloatArray) -> FloatArray:
        """Wrap coordinates into the period that begins at the cut."""
        u = u.copy()
        u[:, self.columns] = self.cut + (u[:, self.columns] - self.cut) % 1.0
        return u

    def wrapped_to_unit(self, u: FloatArray) -> FloatArray:
        """Wrap coordinates into 0 to 1."""
        u = u.copy()
        u[:, self.columns] %= 1.0
        return u


Walls: TypeAlias = tuple[FloatArray, FloatArray]


def _bounds_of_coordinates(space: Space) -> Walls | None:
    """Return the lower and upper bounds, (n_params,), infinite for periodic coordinates; None if none is bounded."""
    low, high = space.low.copy(), space.high.copy()
    low[list(space.periodic)], high[list(space.periodic)] = -np.inf, np.inf
    return (low, high) if np.isfinite(low).any() or np.isfinite(high).any() else None


def _random_bracket(
    u: FloatArray, rows: IntArray, line: FloatArray, walls: Walls | None, rng: np.random.Generator
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
