"""Look for a mode of the posterior that died out among the live points before its evidence counted.

Two modes shrink at the same rate until their tops are near, and over these tens of nats the number of live points in
each drifts. A narrow mode that begins with a few points may lose them all: neither the run nor anything that starts
from its posterior can know of the mode. But some of the points that died early lie in it. Where the likelihood has a
dip on the straight line from an early dead point to the nearest posterior sample, the point lies apart; in a problem
with one mode few points do. Some of the points apart are climbed from; the peaks reached are candidates.
"""

from __future__ import annotations

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.nested.ascent import GaussianAtPeak
from probewise.nested.evaluate import Evaluator, Points
from probewise.nested.repartition import covariance_root_of_points
from probewise.nested.result import NestedResult
from probewise.nested.space import Space, within_bounds_mask

_SHARE = 1 / 20  # of the run's evaluations, for the first lines
_FEWEST_STEPS = 6
_TRIES = 2  # candidates in a step of a climb
_WIDTH = 3.0  # of a step, in sds of the points that died next
_ON_LINE = np.array([0.2, 0.3, 0.4, 0.5])  # places where a line is looked at: the dip lies nearer to the narrow mode
_DIP = 1.0  # nats
_BLOCK = 600  # points that give the metric of a climb
_BULK = 0.1  # of the posterior's mass, up to which points count as early
_N_KNOWN = 200  # samples of the posterior: so few that a mode of which it has nearly nothing is not among them
_MOST_HILLS = 8
_SWEEPS = 12  # of a climb
_FROM_TOP = 3.0  # nats a parameter: a climb ends as near to the top
_NEAREST = 3


def _n_early_dead_points(run: NestedResult) -> int:
    """Count the early dead points: those that hold the first tenth of the posterior's mass."""
    return int(np.searchsorted(np.cumsum(run.weight), _BULK))


def sds_after_early_dead_points(run: NestedResult, space: Space) -> FloatArray:
    """Compute the sds of the 600 points that die next after the early ones, in coordinates of the space, (n_params,).

    Early dead points are those that hold the first tenth of the posterior's mass. No sd is below the spacing of
    floating-point numbers there, nor so small that squared distances in sds overflow.
    """
    last = _n_early_dead_points(run)
    u = space.enter(run.theta[last : last + _BLOCK])
    return np.asarray(np.maximum(u.std(axis=0), np.maximum(np.spacing(np.abs(u).max(axis=0)), 1e-150)))


def peaks_climbed_from_early_points(
    first: NestedResult, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator
) -> list[GaussianAtPeak]:
    """Climb from early dead points that a dip separates from the posterior; return the peaks that are high and apart.

    At most `max_calls` evaluations, counted by `evaluate`, are used for lines to the posterior; the climbs come on top.
    """
    n_params = len(evaluate.names)
    n_starts = int(min(max_calls, _SHARE * first.n_calls) / len(_ON_LINE))
    last = _n_early_dead_points(first)
    if n_starts < 2 or last < first.n_live:
        return []
    # Denser in the beginning: a mode that dies out late has points there, too.
    rows = np.unique((last * np.linspace(0.0, 1.0, n_starts) ** 3).astype(np.int64))
    start = evaluate.points_from_known_values(first.theta[rows], first.log_likelihood[rows], first.label[rows])
    samples = np.unique(first.draw_rows(_N_KNOWN, rng=rng))
    known = evaluate.points_from_known_values(first.theta[samples], first.log_likelihood[samples], first.label[samples])
    u = evaluate.space.enter(first.theta[: last + _BLOCK])
    scale = sds_after_early_dead_points(first, evaluate.space)
    apart = np.flatnonzero(separated_by_dip_mask(start, known, scale, 1, evaluate, rng))
    if not apart.size:
        return []
    chosen = apart[_rows_far_apart(start.u[apart] / scale, start.log_likelihood[apart])]
    roots = np.stack([covariance_root_of_points(u[row : row + _BLOCK]) for row in rows[chosen]])
    now, scales = _climb_along_random_lines(start.take_rows(chosen), roots, evaluate, rng)
    # Of the evidence below a level a lost mode holds no more than its share of live points there.
    enough = first.log_likelihood[last] - _FROM_TOP * n_params
    high = np.flatnonzero(now.log_likelihood > enough)
    high = high[separated_by_dip_mask(now.take_rows(high), known, scale, _NEAREST, evaluate, rng)]
    return [GaussianAtPeak(now.take_rows(slice(k, k + 1)), now.u[k], scales[k] * roots[k]) for k in high]


def _climb_along_random_lines(
    start: Points, root: FloatArray, evaluate: Evaluator, rng: np.random.Generator
) -> tuple[Points, FloatArray]:
    """Move points to higher places on random lines; steps grow where they succeed and shrink where they fail.

    `root`: a root of each point's covariance, (n, n_params, n_params). Return the points and the last step scales,
    (n,).
    """
    space, now, scale = evaluate.space, start.copy(), np.ones(len(start))
    for _ in range(_SWEEPS * max(now.u.shape[1], _FEWEST_STEPS)):
        toward = rng.standard_normal(now.u.shape)
        toward *= (_WIDTH * scale / np.linalg.norm(toward, axis=1))[:, None]
        line = np.einsum("nij,nj->ni", root, toward)
        low = -rng.random(len(now))
        high = low + 1.0
        climbing = np.arange(len(now))
        for _ in range(_TRIES):
            t = low[climbing] + (high - low)[climbing] * rng.random(climbing.size)
            u = now.u[climbing] + t[:, None] * line[climbing]
            inside = within_bounds_mask(space, u).nonzero()[0]
            tried = evaluate(u[inside], rng)
            higher = (tried.log_likelihood > now.log_likelihood[climbing[inside]]).nonzero()[0]
            now.overwrite_rows(climbing[inside[higher]], tried, higher)
            ahead = t > 0
            high[climbing[ahead]], low[climbing[~ahead]] = t[ahead], t[~ahead]
            climbing = np.delete(climbing, inside[higher])
        scale *= 1.3
        scale[climbing] *= 0.5
    return now, scale


def separated_by_dip_mask(
    points: Points, known: Points, scale: FloatArray, n_nearest: int, evaluate: Evaluator, rng: np.random.Generator
) -> BoolArray:
    """Return a mask, (n,), of points with a dip of the likelihood on the line to each of their nearest `known` points.

    A dip is 1 nat or more. `scale`, (n_params,), is the unit of distance along each coordinate. `evaluate` counts the
    evaluations on the lines.
    """
    from scipy.spatial import cKDTree  # slow to import, and needed by runs only

    n, n_params = points.u.shape
    if not n:
        return np.zeros(0, dtype=bool)
    near = cKDTree(known.u / scale).query(points.u / scale, k=min(n_nearest, len(known)))[1].reshape(n, -1)
    goal = known.take_rows(near.ravel())
    begin, begin_height = points.u.repeat(near.shape[1], axis=0), points.log_likelihood.repeat(near.shape[1])
    between = begin[:, None] + _ON_LINE[None, :, None] * (goal.u - begin)[:, None]
    height = evaluate(between.reshape(-1, n_params), rng).log_likelihood.reshape(len(goal), -1)
    height = np.column_stack([begin_height, height, goal.log_likelihood])
    before, after = np.maximum.accumulate(height, axis=1), np.maximum.accumulate(height[:, ::-1], axis=1)[:, ::-1]
    dip = (height < np.minimum(before, after) - _DIP).any(axis=1)
    return np.asarray(dip.reshape(n, -1).all(axis=1))


def _rows_far_apart(x: FloatArray, height: FloatArray) -> IntArray:
    """Return rows of at most 8 points (n, n_params) far apart: the highest, then the furthest from those before it."""
    chosen = [int(height.argmax())]
    square = ((x - x[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < _MOST_HILLS and square.max() > 0:
        chosen.append(int(square.argmax()))
        square = np.minimum(square, ((x - x[chosen[-1]]) ** 2).sum(axis=1))
    return np.array(chosen)
