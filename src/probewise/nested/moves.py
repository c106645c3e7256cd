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

__all__ = ["Move", "PriorRejection", "SliceMove", "Tally"]

# Candidates drawn ahead of refusals, where few chains are left.
_MOST_AHEAD = 4
# Three steps in three dimensions left enough of the start for ln Z to scatter by 1.3 of its claimed errors.
_FEWEST_STEPS = 6
_FRAME, _AXIS, _DIFFERENCE, _HOP = 0, 1, 2, 3


@dataclass(frozen=True)
class Tally:
    """Count what a move did.

    `n_evaluated`: likelihood evaluations. `n_tried`, `n_accepted`: candidates and accepted ones of the
    kind that the move tunes itself by. `n_stuck`: chains that could not leave their start.
    """

    n_evaluated: int
    n_accepted: int
    n_stuck: int = 0
    n_tried: int = 0


class Move(Protocol):
    """Diversify inside the bound."""

    def draw(
        self, start: Points, bound: Bound, live: FloatArray, evaluate: Evaluator, rng: np.random.Generator
    ) -> tuple[Points, Tally]:
        """Return as many new points as `start` has, each distributed uniformly above `bound`.

        Parameters
        ----------
        start
            Points that satisfy the bound, where chains may begin.
        bound
            The level and label that new points must exceed.
        live
            All points known to satisfy the bound, in the evaluator's space, those of `start` included, (n, n_params).
        evaluate
            The problem.
        rng
            Source of randomness.
        """
        ...

    def adapted(self, tally: Tally) -> Move:
        """Return the move to use next, tuned by what this one did."""
        ...


@dataclass(frozen=True)
class PriorRejection:
    """Draw from the whole prior until enough points lie above the bound: exact, and dear once the volume is small.

    `volume` is the share of the prior above the bound as far as known; it only sets the size of batches.
    """

    volume: float

    def draw(
        self, start: Points, bound: Bound, live: FloatArray, evaluate: Evaluator, rng: np.random.Generator
    ) -> tuple[Points, Tally]:
        """Return `len(start)` points; see `Move`."""
        wanted, found, parts, n_evaluated = len(start), 0, [], 0
        while found < wanted:
            batch = int(1.1 * (wanted - found) / self.volume) + 1
            tried = evaluate.from_prior(batch, rng)
            kept = tried.take(bound.admits(tried.log_likelihood, tried.label))
            parts.append(kept)
            found += len(kept)
            n_evaluated += batch
        return Points.join(*parts).take(slice(wanted)), Tally(n_evaluated, wanted)

    def adapted(self, tally: Tally) -> PriorRejection:
        """Return itself: nothing to tune."""
        return self


@dataclass(frozen=True)
class SliceMove:
    """Walk chains of slice-sampling steps (Neal 2003), all chains advancing together.

    A step draws a line through the chain's point, a bracket of fixed width placed at random about
    the point, and candidates within it; a refused candidate becomes the bracket's new end. The
    bracket is not stepped out: with a width that does not depend on the point the step is
    reversible without it (Neal's limit m = 1), and evaluations are saved. Each chain goes to its
    next step when its own bracket has delivered, so the batches stay full.

    Where the prior is not even over the space that chains step in, a step first draws a level
    below its density at the point, and candidates must lie above that too (Neal's auxiliary
    height): refusing one for that reason costs no likelihood.

    Four kinds of steps, every one reversible by itself:

    - along the axes of the space, each on a scale drawn between the conditional and the marginal
      sd of the live points: a parameter that the others do not confine goes far at once;
    - along random orthogonal frames in the metric of the live points, so that n_params successive
      steps cover every direction. Where the live points fall into clusters, each has its own
      metric and such a step stays within its cluster's part of space;
    - along the difference of two live points, from anywhere to anywhere;
    - a hop, where there are clusters: the point is carried to its counterpart in another cluster
      by the affine map between the two, accepted with the ratio of their volumes. It keeps the
      share of live points in each mode from drifting.

    Parameters
    ----------
    steps_per_param
        Steps of a chain for each parameter, hops besides.
    width
        Bracket width in units of the live points' sd along the line.
    axes
        Share of the steps that follow axes.
    differences
        Share of the steps that follow differences of live points.
    hops
        Hops of each chain, where there are clusters.
    target
        Candidates a step should need on average; the width is tuned to it.
    fewest_steps
        Steps of a chain at least, however few the parameters.
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
        """Return the ends of one chain from each start; see `Move`."""
        n_chains, n_params = start.u.shape
        space = evaluate.space
        walls = _walls(space)
        around = _Circles.cut_where_empty(space.periodic, live)
        if around is not None:
            live = around.wrapped(live)
            start = replace(start, u=around.wrapped(start.u))
        clusters = find_clusters(live)
        n_lines = max(self.fewest_steps, math.ceil(self.steps_per_param * n_params))
        n_hops = self.hops if len(clusters) > 1 else 0
        n_steps = n_lines + n_hops
        kind = self._kinds(n_chains, n_steps, n_hops, rng)
        frames = _frames(kind == _FRAME, n_params, rng)
        axis = _axes(n_chains, n_steps, n_params, rng)
        now = start.copy()
        home = clusters.assign(now.u)
        view = _View.of(clusters, start.u, home, live)
        line = np.empty((n_chains, n_params))
        low, high, level = np.empty(n_chains), np.empty(n_chains), np.empty(n_chains)
        step = np.zeros(n_chains, dtype=np.int64)
        moved = np.zeros(n_chains, dtype=bool)
        n_evaluated = n_tried = n_taken = 0

        def begin(rows: IntArray) -> None:
            """Lay the next step's line, bracket and level."""
            at = step[rows]
            kinds, measure = kind[rows, at], view.measure(rows, home[rows])
            toward = np.zeros((rows.size, n_params))
            turned, along, follow = ((kinds == one).nonzero()[0] for one in (_FRAME, _AXIS, _DIFFERENCE))
            if turned.size:
                frame = frames[rows[turned], at[turned]]
                toward[turned] = self.width * np.matmul(view.root[measure[turned]], frame[:, :, None])[:, :, 0]
            if along.size:
                which = axis[rows[along], at[along]]
                least, widening = view.conditional[measure[along], which], view.widening[measure[along], which]
                toward[along, which] = self.width * least * widening ** rng.random(along.size)
            if follow.size:
                n = len(live)
                first = rng.integers(n - 1, size=follow.size)
                second = (first + rng.integers(1, n - 1, size=follow.size)) % (n - 1)
                # Counted from behind the chain's own start, so that neither is it.
                behind = view.own_row[rows[follow]] + 1
                toward[follow] = 2.0 * (live[(behind + first) % n] - live[(behind + second) % n])
            line[rows] = toward
            low[rows], high[rows] = _bracket(now.u, rows, toward, walls, rng)
            level[rows] = now.log_density[rows] - rng.standard_exponential(rows.size)

        active = np.arange(n_chains)
        begin(active)
        while active.size:
            rows, n_ahead = active, min(_MOST_AHEAD, max(1, n_chains // (2 * active.size)))
            t, below, above = _candidates(low[rows], high[rows], n_ahead, rng)
            low[rows], high[rows] = below, above
            chain = rows.repeat(n_ahead)
            ahead = now.u.take(rows, axis=0)[:, None, :] + t[:, :, None] * line.take(rows, axis=0)[:, None, :]
            candidate = ahead.reshape(-1, n_params)
            if around is not None:
                candidate = around.wrapped(candidate)
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
                    # A hop has one place to go to: the first candidate takes it, the others are void.
                    ok[hopping] = np.arange(chain.size)[hopping] % n_ahead == 0
                    first = (hopping & ok).nonzero()[0]
                    who = chain[first]
                    goal[first] = (home[who] + rng.integers(1, len(clusters), size=who.size)) % len(clusters)
                    candidate[first], log_growth = view.hop(who, now.u[who], home[who], goal[first])
                    if around is not None:
                        # Beyond the cut the way back would begin elsewhere.
                        ok[first] &= (around.wrapped(candidate[first]) == candidate[first]).all(axis=1)
                    least[first] -= log_growth
                    if walls is not None:
                        ok[first] &= ((candidate[first] >= walls[0]) & (candidate[first] <= walls[1])).all(axis=1)
                place = clusters.assign(candidate)
                ok &= (kinds == _DIFFERENCE) | (place == goal)
            asked = ok.nonzero()[0]
            if asked.size:
                theta, log_density = space.leave(candidate.take(asked, axis=0))
                above_level = (log_density >= least[asked]).nonzero()[0]
                theta, log_density = theta.take(above_level, axis=0), log_density[above_level]
                asked = asked[above_level]
                ok[:] = False
            if asked.size:
                tried = evaluate.weigh(candidate.take(asked, axis=0), theta, log_density, rng)
                ok[asked] = bound.admits(tried.log_likelihood, tried.label)
                n_evaluated += asked.size
            n_needed, delivered = _needed(ok.reshape(-1, n_ahead))
            won = delivered.nonzero()[0]
            if won.size:
                # Of a chain's candidates the first that is admitted counts.
                taken, which = rows[won], won * n_ahead + n_needed[won] - 1
                now.put(taken, tried, np.searchsorted(asked, which))
                home[taken] = place[which]
                moved[taken] = True
            n_tried += int(n_needed[~hop].sum())
            n_taken += int(np.count_nonzero(delivered & ~hop))
            # A bracket that has shrunk to nothing (a point alone on its line) ends the step where it began.
            done = rows[delivered | hop | (above - below < 1e-13)]
            step[done] += 1
            more = done[step[done] < n_steps]
            if more.size < done.size:
                active = active[step[active] < n_steps]
            if more.size:
                begin(more)
        if around is not None:
            now = replace(now, u=around.home(now.u))
        return now, Tally(n_evaluated, n_taken, int((~moved).sum()), n_tried)

    def _kinds(self, n_chains: int, n_steps: int, n_hops: int, rng: np.random.Generator) -> IntArray:
        """Say of every step of every chain which kind it is, (n_chains, n_steps)."""
        lot = rng.random((n_chains, n_steps))
        kind = np.where(lot < self.axes, _AXIS, np.where(lot < self.axes + self.differences, _DIFFERENCE, _FRAME))
        kind[:, np.linspace(0, n_steps - 1, n_hops).astype(int)] = _HOP
        return kind

    def longer(self) -> SliceMove:
        """Return the move with twice as many steps a chain."""
        return replace(self, steps_per_param=2.0 * self.steps_per_param, fewest_steps=2 * self.fewest_steps)

    def adapted(self, tally: Tally) -> SliceMove:
        """Widen or narrow the bracket towards `target` candidates a step."""
        excess = math.log(max(tally.n_tried, 1) / max(tally.n_accepted, 1) / self.target)
        return replace(self, width=min(max(self.width * math.exp(-0.5 * excess), 0.05), 20.0))


def _candidates(
    low: FloatArray, high: FloatArray, n_ahead: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Draw the next candidates on each line as if all before were refused, (n, n_ahead); also the bracket if all are.

    A refusal shrinks the bracket whatever the likelihood was, so candidates can be drawn ahead and
    evaluated together: the chain is the same, a few evaluations are spent for batches that stay full.
    """
    t = np.empty((len(low), n_ahead))
    for k in range(n_ahead):
        t[:, k] = here = low + (high - low) * rng.random(len(low))
        ahead = here > 0
        low, high = np.where(ahead, low, here), np.where(ahead, here, high)
    return t, low, high


def _needed(ok: BoolArray) -> tuple[IntArray, BoolArray]:
    """Say how many of the candidates, (n, n_ahead), a step needed, and whether it delivered, both (n,)."""
    delivered = np.asarray(ok.any(axis=1))
    return np.where(delivered, np.argmax(ok, axis=1) + 1, ok.shape[1]), delivered


def _frames(needed: BoolArray, n_params: int, rng: np.random.Generator) -> FloatArray:
    """Draw rows of random orthogonal matrices where `needed`, (n_chains, n_steps), is true.

    Returns (n_chains, n_steps rounded up to whole matrices, n_params). Matrices of which no row is needed are left as
    drawn: making one orthogonal is what costs.
    """
    n_chains, n_steps = needed.shape
    first = np.arange(0, n_steps, n_params)
    frames = rng.standard_normal((n_chains, first.size, n_params, n_params))
    used = np.logical_or.reduceat(needed, first, axis=1)
    frames[used] = np.linalg.qr(frames[used])[0]
    return frames.reshape(n_chains, first.size * n_params, n_params)


def _axes(n_chains: int, n_steps: int, n_params: int, rng: np.random.Generator) -> IntArray:
    """Draw axes, (n_chains, n_steps), every one once before any comes again."""
    n_turns = -(-n_steps // n_params)
    return np.argsort(rng.random((n_chains, n_turns, n_params)), axis=2).reshape(n_chains, -1)[:, :n_steps]


@dataclass(frozen=True, eq=False)
class _View:
    """The clusters as each chain sees them: measured without the point where that chain began.

    A metric that knows the start stretches the lines through it and shrinks those past it; with
    150 live points in 20 dimensions that alone raised log Z by more than one.

    The measures of the clusters stand first, then each chain's own of the cluster that it began in: mean, root,
    inverse root and log determinant, and of every axis the conditional sd and how much greater the marginal one is.
    """

    mean: FloatArray
    root: FloatArray
    inverse_root: FloatArray
    log_det: FloatArray
    conditional: FloatArray
    widening: FloatArray
    n_clusters: int
    own_home: IntArray
    own_row: IntArray  # where the start stands among the live points

    @classmethod
    def of(cls, clusters: Clusters, u: FloatArray, home: IntArray, live: FloatArray) -> _View:
        same = np.logical_and.reduce(
            [of_live == of_start[:, None] for of_live, of_start in zip(live.T, u.T, strict=True)]
        )
        # A start that is no live point is in no cluster's measure either.
        own_home = np.where(same.any(axis=1), home, -1)
        own = clusters.without(u, home)
        root, inverse = (
            np.concatenate([clusters.root, own.root]),
            np.concatenate([clusters.inverse_root, own.inverse_root]),
        )
        conditional = 1.0 / np.sqrt((inverse**2).sum(axis=1))
        return cls(
            np.concatenate([clusters.mean, own.mean]),
            root,
            inverse,
            np.concatenate([clusters.log_det, own.log_det]),
            conditional,
            np.sqrt((root**2).sum(axis=2)) / conditional,
            len(clusters),
            own_home,
            np.argmax(same, axis=1),
        )

    def measure(self, rows: IntArray, home: IntArray) -> IntArray:
        """Find the measure by which chains `rows` see cluster `home`."""
        return np.where(home == self.own_home[rows], self.n_clusters + rows, home)

    def hop(self, rows: IntArray, u: FloatArray, home: IntArray, goal: IntArray) -> tuple[FloatArray, FloatArray]:
        """Map points to their counterparts in other clusters; also the log of the volume they grow by."""
        here, there = self.measure(rows, home), self.measure(rows, goal)
        z = np.matmul(self.inverse_root[here], (u - self.mean[here])[:, :, None])
        moved = self.mean[there] + np.matmul(self.root[there], z)[:, :, 0]
        return moved, self.log_det[there] - self.log_det[here]


@dataclass(frozen=True, eq=False)
class _Circles:
    """Coordinates that go round, each written down from a cut of its own on, so that no peak lies across the end.

    Chains stay on the circle: a candidate is wrapped before anything is asked of it, so that metric and clusters of
    the way back are those of the way there.
    """

    columns: IntArray
    cut: FloatArray

    @classmethod
    def cut_where_empty(cls, periodic: tuple[int, ...], live: FloatArray) -> _Circles | None:
        """Cut each circle in the middle of the widest gap between live points, (n_live, n_params)."""
        if not periodic:
            return None
        columns = np.array(periodic)
        place = np.sort(live[:, columns] % 1.0, axis=0)
        gap = np.diff(place, axis=0, append=place[:1] + 1.0)
        widest = np.argmax(gap, axis=0)
        each = np.arange(len(columns))
        return cls(columns, (place[widest, each] + 0.5 * gap[widest, each]) % 1.0)

    def wrapped(self, u: FloatArray) -> FloatArray:
        """Write places down from the cut on."""
        u = u.copy()
        u[:, self.columns] = self.cut + (u[:, self.columns] - self.cut) % 1.0
        return u

    def home(self, u: FloatArray) -> FloatArray:
        """Write places down from 0 on."""
        u = u.copy()
        u[:, self.columns] %= 1.0
        return u


Walls: TypeAlias = tuple[FloatArray, FloatArray]


def _walls(space: Space) -> Walls | None:
    """Least and greatest value of each coordinate; None where nothing bounds any. A circle has no walls."""
    low, high = space.low.copy(), space.high.copy()
    low[list(space.periodic)], high[list(space.periodic)] = -np.inf, np.inf
    return (low, high) if np.isfinite(low).any() or np.isfinite(high).any() else None


def _bracket(
    u: FloatArray, rows: IntArray, line: FloatArray, walls: Walls | None, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Place a bracket of length one at random about each point `u[rows]`, cut where the line leaves the space."""
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
