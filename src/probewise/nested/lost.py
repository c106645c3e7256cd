"""Look for a part of the posterior without live points: a mode that died out among them, or a top they never climbed.

Two modes shrink at the same rate until their tops are near, over tens of nats, and all that while the number of live
points in each drifts. A narrow mode that begins with a few of them may lose them all: neither the run nor anything that
starts from its posterior can know of it. But points in it are among those that died early. Where the likelihood has a
dip on the straight line from an early dead point to the nearest sample of the posterior, the point lies apart. Few
points of a problem with one mode do. Some of those that do climb, and the hills that they end on are weighed by
importance sampling, and held against the share of the run's posterior at the same place.

A run may also have ended beside the bulk of its posterior, with nothing between: on the arm of a heavy tail along which
its chains hardly moved. There the top to which the last live points climb lies far above all points of the run, and is
weighed in the same way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.nested.ascent import Top
from probewise.nested.clusters import Clusters
from probewise.nested.evaluate import Bound, Evaluator, Points
from probewise.nested.importance import HeldOut, Weighted, weigh_draws
from probewise.nested.mixture import single
from probewise.nested.moves import SliceMove
from probewise.nested.repartition import principal_root
from probewise.nested.result import NestedResult
from probewise.nested.space import Space, is_within, unbounded
from probewise.nested.weights import n_effective

__all__ = ["NOTHING_LOST", "Hill", "Lost", "look_for_lost"]

_SHARE = 1 / 20  # of the run's evaluations, for the first lines
_MOST_SHARE = 1 / 6  # up to which another hill is weighed
_FEWEST_STEPS = 6
_TRIES = 2  # candidates in a step of a climb
_WIDTH = 3.0  # of a step, in sds of the points that died next
_ON_LINE = np.array([0.2, 0.3, 0.4, 0.5])  # places where a line is looked at: the dip lies nearer to the narrow mode
_DIP = 1.0  # nats
_BLOCK = 600  # points that give the metric of a climb
_BULK = 0.1  # of the posterior's mass, up to which points count as early
_N_KNOWN = 200  # samples of the posterior: so few that a mode of which it has nearly nothing is not among them
_N_SAMPLES = 1000  # of a lost mode
_MOST_HILLS = 8
_SWEEPS = 12  # of a climb
_FROM_TOP = 3.0  # nats a parameter: a climb ends as near to the top
_NEAREST = 3
# Nats a parameter by which a top lies above all points of a run: of a normal posterior it is below half of that.
_ABOVE = 0.5
_ROUNDS = 6
_SETTLED = 0.5  # nats
_PER_PARAM, _DRAWS_PER_PARAM = 4, 40
_FITS, _ENOUGH = 6, 4.0  # effective samples a parameter
_POWERS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15, 0.1)
_WIDER = 1.2  # the sds of the Student t than those of the points it is fitted to
_INSIDE = 0.9  # of the weight of a hill, within the ellipsoid in which the run's own weight is counted
_MET = 0.5  # of the evidence of a hill: with more, the run has met it


@dataclass(frozen=True, eq=False)
class Hill:
    """A hill of the posterior and the log of its evidence.

    `theta`: samples of it, (n, n_params). The ellipsoid of `shape`, a single cluster in coordinates of `space`, holds
    most of it within `radius` sds.
    """

    log_z: float
    theta: FloatArray
    space: Space
    shape: Clusters
    radius: float

    @classmethod
    def of(cls, drawn: Weighted, space: Space, rng: np.random.Generator) -> Hill:
        """Take the shape of weighted draws."""
        theta = drawn.samples(_N_SAMPLES, rng=rng)
        x = space.enter(theta)
        shape = Clusters.of([x])
        return cls(drawn.log_z, theta, space, shape, float(np.quantile(_distance(x, shape), _INSIDE)))

    def is_met_by(self, run: NestedResult) -> bool:
        """Whether a run has at least half of this evidence at the same place."""
        inside = _distance(self.space.enter(run.theta), self.shape) <= self.radius
        near = float(run.weight[inside].sum())
        return near > 0 and run.log_z + math.log(near) > self.log_z + math.log(_MET * _INSIDE)


def _distance(x: FloatArray, shape: Clusters) -> FloatArray:
    """Distance of points (n, n_params) from the middle of a cluster, sds, (n,)."""
    return np.asarray(np.linalg.norm((x - shape.mean[0]) @ shape.inverse_root[0].T, axis=1))


@dataclass(frozen=True, eq=False)
class Lost:
    """Hills that a run has not met, and the evaluations used."""

    hills: tuple[Hill, ...]
    n_calls: int

    def not_in(self, run: NestedResult) -> float:
        """Log of the evidence of those hills that another run has not met either; -inf where it met all."""
        return float(logsumexp([-math.inf, *(hill.log_z for hill in self.hills if not hill.is_met_by(run))]))


NOTHING_LOST = Lost((), 0)
"""No lost mode, nothing evaluated."""


def look_for_lost(
    first: NestedResult, top: Top, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator
) -> Lost:
    """Look for lost parts of a run's posterior, and estimate their evidence.

    Parameters
    ----------
    first
        The run.
    top
        Top of the peak on which it ended.
    evaluate
        Its problem, whose prior has `to_unit_cube` or coordinates of its own.
    max_calls
        Limit of evaluations for the lines; hills that are found take some more, up to a sixth of the run's in all.
    rng
        Source of randomness.
    """
    n_before, n_params = evaluate.n_calls, len(evaluate.names)
    few = _apart_from_posterior(first, evaluate, max_calls=max_calls, rng=rng)
    if top.height > float(first.log_likelihood.max()) + _ABOVE * n_params and max_calls > _hill_calls(n_params):
        few = _Climbers(top.highest, top.root[None], np.ones(1)).joined(few)
    scale, space, hills = _scale(first, evaluate.space), unbounded(evaluate.problem.prior), list[Hill]()
    most = n_before + _MOST_SHARE * first.n_calls
    while len(few) and evaluate.n_calls + _hill_calls(n_params) < most:
        best = int(few.now.log_likelihood.argmax())
        settled = _settled(few.now.take(slice(best, best + 1)), few.root[best] * few.scale[best], evaluate, rng)
        few = few.take(np.delete(np.arange(len(few)), best))
        few = few.take(np.flatnonzero(_apart(few.now, settled, scale, 1, evaluate, rng)))
        drawn = _weighed(space.enter(settled.theta), space, evaluate, rng)
        if drawn is not None:
            hill = Hill.of(drawn, space, rng)
            hills += [] if hill.is_met_by(first) else [hill]
    return Lost(tuple(hills), evaluate.n_calls - n_before)


def _early(run: NestedResult) -> int:
    """Count the dead points before the posterior's bulk."""
    return int(np.searchsorted(np.cumsum(run.weight), _BULK))


def _scale(run: NestedResult, space: Space) -> FloatArray:
    """Sds of the points that died where the posterior's bulk begins, (n_params,)."""
    last = _early(run)
    return np.asarray(np.maximum(space.enter(run.theta[last : last + _BLOCK]).std(axis=0), 1e-300))


def _apart_from_posterior(
    first: NestedResult, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator
) -> _Climbers:
    """Let early dead points climb that lie apart from the posterior; return those that end high, and still apart."""
    n_params = len(evaluate.names)
    n_starts = int(min(max_calls, _SHARE * first.n_calls) / len(_ON_LINE))
    last = _early(first)
    nothing = _Climbers(Points.empty(n_params), np.empty((0, n_params, n_params)), np.empty(0))
    if n_starts < 2 or last < first.n_live:
        return nothing
    # Denser in the beginning: a mode that dies out late has points there, too.
    rows = np.unique((last * np.linspace(0.0, 1.0, n_starts) ** 3).astype(np.int64))
    start = evaluate.known(first.theta[rows], first.log_likelihood[rows], first.label[rows])
    samples = np.unique(first.rows(_N_KNOWN, rng=rng))
    known = evaluate.known(first.theta[samples], first.log_likelihood[samples], first.label[samples])
    u = evaluate.space.enter(first.theta[: last + _BLOCK])
    scale = _scale(first, evaluate.space)
    apart = np.flatnonzero(_apart(start, known, scale, 1, evaluate, rng))
    if not apart.size:
        return nothing
    chosen = apart[_far_from_each_other(start.u[apart] / scale, start.log_likelihood[apart])]
    roots = np.stack([principal_root(u[row : row + _BLOCK]) for row in rows[chosen]])
    few = _Climbers(start.take(chosen), roots, np.ones(len(chosen))).climbed(evaluate, rng)
    # Of the evidence below a level a lost mode holds no more than its share of live points there.
    enough = first.log_likelihood[last] - _FROM_TOP * n_params
    few = few.take(np.flatnonzero(few.now.log_likelihood > enough))
    return few.take(np.flatnonzero(_apart(few.now, known, scale, _NEAREST, evaluate, rng)))


@dataclass(frozen=True, eq=False)
class _Climbers:
    """Points that climb: each with a root of a covariance, (n, n_params, n_params), and a scale of its steps, (n,)."""

    now: Points
    root: FloatArray
    scale: FloatArray

    def __len__(self) -> int:
        return len(self.now)

    def take(self, rows: IntArray) -> _Climbers:
        return _Climbers(self.now.take(rows), self.root[rows], self.scale[rows])

    def joined(self, others: _Climbers) -> _Climbers:
        now = Points.join(self.now, others.now)
        return _Climbers(now, np.concatenate([self.root, others.root]), np.concatenate([self.scale, others.scale]))

    def climbed(self, evaluate: Evaluator, rng: np.random.Generator) -> _Climbers:
        """Move to higher places on random lines; steps grow where they succeed and shrink where they fail."""
        space, now, scale = evaluate.space, self.now.copy(), self.scale.copy()
        for _ in range(_SWEEPS * max(now.u.shape[1], _FEWEST_STEPS)):
            toward = rng.standard_normal(now.u.shape)
            toward *= (_WIDTH * scale / np.linalg.norm(toward, axis=1))[:, None]
            line = np.einsum("nij,nj->ni", self.root, toward)
            low = -rng.random(len(now))
            high = low + 1.0
            climbing = np.arange(len(now))
            for _ in range(_TRIES):
                t = low[climbing] + (high - low)[climbing] * rng.random(climbing.size)
                u = now.u[climbing] + t[:, None] * line[climbing]
                inside = is_within(space, u).nonzero()[0]
                tried = evaluate(u[inside], rng)
                higher = (tried.log_likelihood > now.log_likelihood[climbing[inside]]).nonzero()[0]
                now.put(climbing[inside[higher]], tried, higher)
                ahead = t > 0
                high[climbing[ahead]], low[climbing[~ahead]] = t[ahead], t[~ahead]
                climbing = np.delete(climbing, inside[higher])
            scale *= 1.3
            scale[climbing] *= 0.5
        return _Climbers(now, self.root, scale)


def _apart(
    points: Points, known: Points, scale: FloatArray, n_nearest: int, evaluate: Evaluator, rng: np.random.Generator
) -> BoolArray:
    """Mark the points from which the likelihood dips on the way to each of the nearest known points, (n,)."""
    from scipy.spatial import cKDTree  # slow to import, and needed by runs only

    n, n_params = points.u.shape
    if not n:
        return np.zeros(0, dtype=bool)
    near = cKDTree(known.u / scale).query(points.u / scale, k=min(n_nearest, len(known)))[1].reshape(n, -1)
    goal = known.take(near.ravel())
    begin, begin_height = points.u.repeat(near.shape[1], axis=0), points.log_likelihood.repeat(near.shape[1])
    between = begin[:, None] + _ON_LINE[None, :, None] * (goal.u - begin)[:, None]
    height = evaluate(between.reshape(-1, n_params), rng).log_likelihood.reshape(len(goal), -1)
    height = np.column_stack([begin_height, height, goal.log_likelihood])
    before, after = np.maximum.accumulate(height, axis=1), np.maximum.accumulate(height[:, ::-1], axis=1)[:, ::-1]
    dip = (height < np.minimum(before, after) - _DIP).any(axis=1)
    return np.asarray(dip.reshape(n, -1).all(axis=1))


def _far_from_each_other(x: FloatArray, height: FloatArray) -> IntArray:
    """Choose among points (n, n_params) the highest one, then each time the one furthest from those chosen."""
    chosen = [int(height.argmax())]
    square = ((x - x[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < _MOST_HILLS and square.max() > 0:
        chosen.append(int(square.argmax()))
        square = np.minimum(square, ((x - x[chosen[-1]]) ** 2).sum(axis=1))
    return np.array(chosen)


def _points_on_hill(n_params: int) -> int:
    return max(_PER_PARAM * n_params, 20)


def _hill_calls(n_params: int) -> float:
    """About as many evaluations as it takes to weigh a hill: two or three rounds of chains."""
    return 2.5 * _points_on_hill(n_params) * max(n_params, _FEWEST_STEPS) * SliceMove().target


def _settled(top: Points, root: FloatArray, evaluate: Evaluator, rng: np.random.Generator) -> Points:
    """Draw points uniformly from the top of a hill, down to where they have the covariance of a normal posterior."""
    n_params = root.shape[0]
    n = _points_on_hill(n_params)
    below = (n_params + 2) / 2
    move = SliceMove(hops=0)
    live, starts = top.u + rng.standard_normal((n, n_params)) @ root.T, top.take(np.zeros(n, dtype=np.int64))
    highest, log_volume = float(top.log_likelihood[0]), -math.inf
    for _ in range(_ROUNDS):
        drawn, _ = move.draw(starts, Bound(highest - below, 1.0), live, evaluate, rng)
        last, log_volume = log_volume, float(np.linalg.slogdet(principal_root(drawn.u))[1])
        rise = max(float(drawn.log_likelihood.max()) - highest, 0.0)
        if rise < _SETTLED and abs(log_volume - last) < _SETTLED * math.sqrt(n_params):
            break
        highest += rise
        live = drawn.u
        starts = drawn.take((drawn.log_likelihood > highest - below).nonzero()[0])
        starts = starts.take(rng.integers(len(starts), size=n))
    return drawn


def _weighed(x: FloatArray, space: Space, evaluate: Evaluator, rng: np.random.Generator) -> Weighted | None:
    """Weigh a hill by draws from a Student t about points on it, (n, n_params), fitted anew if need be."""
    n_params = x.shape[1]
    mean, covariance = x.mean(axis=0), np.atleast_2d(np.cov(x, rowvar=False))
    n_draws, enough = max(_DRAWS_PER_PARAM * n_params, 200), _ENOUGH * n_params
    for _ in range(_FITS):
        proposal = single(mean, _WIDER**2 * covariance)
        drawn = weigh_draws(proposal, 0.0, HeldOut.nothing(), space, evaluate, n_draws=n_draws, rng=rng)
        if drawn.n_eff > enough:
            return drawn
        if not drawn.n_eff > 1:
            return None
        # A power of the weights that leaves enough of them for a covariance.
        power = next((p for p in _POWERS if n_effective(p * drawn.log_weight) > enough), None)
        if power is None:
            return None
        weight, x = np.exp(power * drawn.log_weight), space.enter(drawn.theta)
        weight /= weight.sum()
        mean = weight @ x
        covariance = (x - mean).T @ ((x - mean) * weight[:, None])
    return None
