"""Look for peaks of the posterior that a run has missed, from its dead points and its last live ones.

- Early dead points climb. Two modes shrink at the same rate until their tops are near, and over these tens of nats the
  number of live points in each drifts. A narrow mode that begins with a few points may lose them all: neither the run
  nor anything that starts from its posterior can know of the mode. But some of the points that died early lie in it.
  Where the likelihood has a dip on the straight line from an early dead point to the nearest posterior sample, the
  point lies apart; in a problem with one mode few points do. Some of the points apart are climbed from.
- Draws about the last live points climb to the top of their peak: a top far above all points of the run means that it
  ended on the arm of a heavy tail, along which its chains hardly moved, beside the bulk of its posterior.
- Draws about that top meet narrow peaks above the run's end. A run ends where its live points can no longer raise log
  Z, if the likelihood goes on as before. A narrow peak on a broad one (a phase transition, Skilling 2006) can hold most
  of the posterior and rise above the broad peak only tens of nats further up. Draws need no chains and can meet its
  flank.

Whether a peak matters is for `probewise.nested.check` to say.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.nested.problem import Evaluator, Points, Samplable
from probewise.nested.repartition import covariance_root_of_points, root_of_covariance
from probewise.nested.result import NestedResult

# Of peaks that are returned:
_SAMPLES_PER_PARAM, _FEWEST_SAMPLES = 20, 200
_INSIDE = 0.9  # of the evidence of a peak, within the ellipsoid in which that of the run is counted
_MET = 0.5  # of the evidence of a peak: with more, the run has met it
_MATTERS = 0.1  # of its errors by which a peak raises the run's log Z: with less, it does not matter
# Of a climb:
_PER_PARAM, _LEAST_DRAWS = 10, 60  # draws of a generation
_BEST, _FEWEST_BEST = 0.25, 2  # of them
_LEARNT = 0.3  # share of the covariance that a generation replaces
_MOST_GENERATIONS = 80
_LEVEL = 0.02  # nats between the best draws at the top: a gentle slope is followed, too
_AS_DRAWN = 0.2  # nats between the best draws of the distribution that is returned
# Of early dead points:
_BULK = 0.1  # of the posterior's mass, up to which points count as early
_LINES_SHARE = 1 / 20  # of the run's evaluations, for the lines from them
_CLIMBS_SHARE = 1 / 6  # of the run's evaluations, up to which another climb begins
_NEXT_DEAD = 600  # points that give the scale of lines, and the metric of a climb
_BEGIN = 0.3  # of their sds, in which a climb begins
_N_KNOWN = 200  # samples of the posterior: so few that a mode of which it has nearly nothing is not among them
_ON_LINE = np.array([0.2, 0.3, 0.4, 0.5])  # places where a line is looked at: the dip lies nearer to the narrow mode
_DIP = 1.0  # nats
_NEAREST = 3  # samples from which a top lies apart
_MOST_CLIMBS = 8
_FROM_TOP = 3.0  # nats a parameter below the early points' end, down to which a top matters
# Of the top of the last live points' peak, and draws about it:
_ASCENT_SHARE = 1 / 20  # of the run's evaluations, at most
# Nats a parameter by which a top lies above all points of a run: of a normal posterior it is below half of that.
_FAR_ABOVE = 0.5
_HIGHER = 0.2  # nats by which a draw lies above the known top, so that it belongs to another peak
_SCALES = (1.5, 1.2, 0.95)  # of the draws, in sds at the top
_PER_LIVE = 0.1  # draws of a scale, for each live point and each parameter squared: a cone is the rarer, the more
_DRAWS_SHARE = 1 / 8  # of the run's evaluations, for these draws
_MOST_PEAKS = 5


@dataclass(frozen=True, eq=False)
class MissedPeaks:
    """Samples about each peak that a run may have missed, (n, n_params) in parameters, as wide as the peak.

    `lost`: peaks that its live points have lost; `above`: narrow peaks above its end. `n_calls`: evaluations used.
    """

    lost: tuple[FloatArray, ...] = ()
    above: tuple[FloatArray, ...] = ()
    n_calls: int = 0


@dataclass(frozen=True, eq=False)
class GaussianAtPeak:
    """A normal distribution at a peak of the likelihood: start or end of a climb.

    `centre` is its mean, (n_params,), and `root` @ `root`.T its covariance, (n_params, n_params), in the sampling
    coordinates; `climb_to_top` widens it until the best quarter of draws spans 0.2 nats. `highest`: best point of the
    last generation, or live point; `met`: best point of the whole climb, maybe on another peak; None before a climb.
    """

    highest: Points
    centre: FloatArray
    root: FloatArray
    met: Points | None = None

    @property
    def height(self) -> float:
        """Log likelihood of the highest point."""
        return float(self.highest.log_likelihood[0])


def find_missed_peaks(
    run: NestedResult,
    problem: Samplable,
    *,
    max_calls: float,
    rng: np.random.Generator,
    executor: Executor | None = None,
    n_workers: int | None = None,
) -> MissedPeaks:
    """Look for peaks of the posterior that a run has missed; none are found for a prior without an inverse.

    `max_calls`: limit of evaluations; at most about a third of the run's are used. `executor`, `n_workers`: see `run`.
    """
    if not run.names or not (hasattr(problem.prior, "to_unit_cube") or hasattr(problem.prior, "coordinates")):
        return MissedPeaks()
    evaluate = Evaluator(problem, executor=executor, n_parts=n_workers)

    def calls_left(share: float = math.inf) -> int:
        return int(min(max_calls - evaluate.n_calls, share * run.n_calls))

    def samples(tops: Iterable[GaussianAtPeak]) -> tuple[FloatArray, ...]:
        n_draws = max(_SAMPLES_PER_PARAM * len(run.names), _FEWEST_SAMPLES)
        drawn = (_samples_if_unmet(top, run, evaluate, n_draws, rng) for top in tops if n_draws <= calls_left())
        return tuple(each for each in drawn if each is not None)

    top = climb_to_top(
        gaussian_of_last_live_points(run, evaluate), evaluate, max_calls=calls_left(_ASCENT_SHARE), rng=rng
    )
    lost = _tops_apart(run, evaluate, max_calls=calls_left(), rng=rng)
    if top.height > float(run.log_likelihood.max()) + _FAR_ABOVE * len(run.names):
        lost.append(top)
    above = _higher_tops(run, top, evaluate, max_calls=calls_left(), rng=rng)
    return MissedPeaks(samples(lost), samples(above), evaluate.n_calls)


def _samples_if_unmet(
    top: GaussianAtPeak, run: NestedResult, evaluate: Evaluator, n_draws: int, rng: np.random.Generator
) -> FloatArray | None:
    """Draw points about a top, (n, n_params) in parameters, as wide as the peak; None if the run has met it.

    On a normal peak of the draws' covariance the log likelihood is n_params / 2 below the top, on average; Laplace's
    approximation then gives the peak's evidence. The run has met the peak if it has half of that within the ellipsoid
    of nine tenths of the peak, or if the evidence is too small to matter.
    """
    n_params, space = len(top.centre), evaluate.space
    off = rng.standard_normal((n_draws, n_params)) @ top.root.T
    off = off[space.inside_mask(top.centre + off)]
    fall = top.height - evaluate(top.centre + off, rng).log_likelihood
    fall = fall[np.isfinite(fall)]
    scale = math.sqrt(n_params / 2 / max(float(fall.mean()), 1e-3)) if fall.size else 1.0
    root = scale * top.root
    log_volume = 0.5 * n_params * math.log(2 * math.pi) + float(np.linalg.slogdet(root)[1])
    log_z = top.height + float(top.highest.log_density[0]) + log_volume
    distance = np.linalg.norm(np.linalg.solve(root, (space.enter(run.theta) - top.centre).T), axis=0)
    has = float(run.weight[distance**2 < chdtri(n_params, 1 - _INSIDE)].sum())
    met = has > 0 and run.log_z + math.log(has) > log_z + math.log(_MET * _INSIDE)
    u = top.centre + scale * off
    u = u[space.inside_mask(u)]
    if met or np.logaddexp(run.log_z, log_z) - run.log_z < _MATTERS * run.log_z_error or len(u) <= 2 * n_params:
        return None
    return space.leave(u)[0]


def climb_to_top(
    start: GaussianAtPeak, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator, known: float = -math.inf
) -> GaussianAtPeak:
    """Climb from a normal distribution to the top of a peak; return the distribution about the top.

    As in CMA-ES (Hansen & Ostermeier 2001), every generation is drawn from a normal distribution. The mean of its best
    quarter becomes the next mean, and their scatter about the old mean updates the covariance. The distribution so
    stretches along a direction in which the likelihood keeps rising: the arm of a heavy tail, a hundred times as long
    as wide, is climbed in some thousand evaluations. The climb ends when the best draws differ by less than 0.02 nats,
    after 80 generations, or before `max_calls` evaluations would be exceeded. Draws below the log likelihood `known`
    are ignored: they may belong to another peak.
    """
    highest, centre, covariance = start.highest, start.centre, start.root @ start.root.T
    met = highest
    n_params = len(centre)
    n_draws, spread = max(_PER_PARAM * n_params, _LEAST_DRAWS), math.inf
    n_best, most = int(_BEST * n_draws), evaluate.n_calls + max_calls
    for _ in range(_MOST_GENERATIONS):
        if spread < _LEVEL or evaluate.n_calls + n_draws > most:
            break
        tried = centre + rng.standard_normal((n_draws, n_params)) @ root_of_covariance(covariance).T
        drawn = evaluate(tried[evaluate.space.inside_mask(tried)], rng)
        best = drawn.take_rows(drawn.rows_by_rising_likelihood()[::-1][:n_best])
        best = best.take_rows(best.log_likelihood > known)
        if len(best) < _FEWEST_BEST:
            covariance = _BEST * covariance
            continue
        off = best.u - centre
        covariance = (1 - _LEARNT) * covariance + _LEARNT * off.T @ off / len(best)
        centre = best.u.mean(axis=0)
        spread = float(np.ptp(best.log_likelihood))
        highest = best.take_rows(slice(1))
        met = max(met, highest, key=lambda one: float(one.log_likelihood[0]))
    # About a rounded top heights spread as the covariance.
    wider = _AS_DRAWN / spread if 0 < spread < _AS_DRAWN else 1.0
    return GaussianAtPeak(highest, centre, root_of_covariance(wider * covariance), met)


def gaussian_of_last_live_points(run: NestedResult, evaluate: Evaluator) -> GaussianAtPeak:
    """Return mean and covariance of a run's last live points, with the highest of them, to start a climb."""
    last = slice(-run.n_live, None)
    live = evaluate.points_from_known_values(run.theta[last], run.log_likelihood[last], run.label[last])
    highest = live.take_rows(live.rows_by_rising_likelihood()[-1:])
    return GaussianAtPeak(highest, live.u.mean(axis=0), covariance_root_of_points(live.u))


def _tops_apart(
    run: NestedResult, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator
) -> list[GaussianAtPeak]:
    """Climb from early dead points that a dip separates from the posterior; return the tops that are high and apart.

    Early dead points are those that hold the first tenth of the posterior's mass. At most `max_calls` evaluations,
    counted by `evaluate`, are used for lines to the posterior; those of climbs come on top.
    """
    n_starts = int(min(max_calls, _LINES_SHARE * run.n_calls) / len(_ON_LINE))
    last = int(np.searchsorted(np.cumsum(run.weight), _BULK))
    if n_starts < 2 or last < run.n_live:
        return []

    def points(rows: IntArray) -> Points:
        return evaluate.points_from_known_values(run.theta[rows], run.log_likelihood[rows], run.label[rows])

    u = evaluate.space.enter(run.theta[: last + _NEXT_DEAD])
    # No sd below the spacing of floating-point numbers, nor so small that squared distances in sds overflow.
    scale = np.maximum(u[last:].std(axis=0), np.maximum(np.spacing(np.abs(u[last:]).max(axis=0)), 1e-150))
    # Denser in the beginning: a mode that dies out late has points there, too.
    rows = np.unique((last * np.linspace(0.0, 1.0, n_starts) ** 3).astype(np.int64))
    known = points(np.unique(run.draw_rows(_N_KNOWN, rng=rng)))
    rows = rows[separated_by_dip_mask(points(rows), known, scale, 1, evaluate, rng)]
    if not rows.size:
        return []
    start = points(rows)
    chosen = _rows_far_apart(start.u / scale, start.log_likelihood)
    rows, start = rows[chosen], start.take_rows(chosen)
    # Of the evidence below a level a lost mode holds no more than its share of live points there.
    enough = run.log_likelihood[last] - _FROM_TOP * len(run.names)
    most = evaluate.n_calls + min(max_calls, int(_CLIMBS_SHARE * run.n_calls))
    tops, rest = list[GaussianAtPeak](), np.arange(len(rows))
    while rest.size and evaluate.n_calls < most:
        k = rest[np.argmax(start.log_likelihood[rest])]
        root = _BEGIN * covariance_root_of_points(u[rows[k] : rows[k] + _NEXT_DEAD])
        begin = GaussianAtPeak(start.take_rows(slice(k, k + 1)), start.u[k], root)
        top = climb_to_top(begin, evaluate, max_calls=most - evaluate.n_calls, rng=rng)
        if top.height > enough and separated_by_dip_mask(top.highest, known, scale, _NEAREST, evaluate, rng)[0]:
            tops.append(top)
        rest = rest[rest != k]
        rest = rest[separated_by_dip_mask(start.take_rows(rest), top.highest, scale, 1, evaluate, rng)]
    return tops


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
    while len(chosen) < _MOST_CLIMBS and square.max() > 0:
        chosen.append(int(square.argmax()))
        square = np.minimum(square, ((x - x[chosen[-1]]) ** 2).sum(axis=1))
    return np.array(chosen)


def _higher_tops(
    run: NestedResult, top: GaussianAtPeak, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator
) -> list[GaussianAtPeak]:
    """Look for peaks higher than `top`, that of the peak on which a run ended; return their tops, the highest last.

    `evaluate` counts the evaluations, at most `max_calls`. Without a higher peak at most an eighth of the run's are
    used.
    """
    n_params, most = len(evaluate.names), evaluate.n_calls + max_calls
    wanted = run.n_live * max(_PER_LIVE * n_params**2, 1.0)
    n_draws = int(min(wanted, min(max_calls, _DRAWS_SHARE * run.n_calls) / len(_SCALES)))
    if n_draws < run.n_live:
        return []
    tops = list[GaussianAtPeak]()
    # Of several peaks of about one height the climb took one, and the run knows the others.
    known = max(top.height, float(run.log_likelihood.max()))
    scale = np.repeat(_SCALES, n_draws)[:, None]
    tried = top.centre + scale * rng.standard_normal((scale.size, n_params)) @ top.root.T
    drawn = evaluate(tried[evaluate.space.inside_mask(tried)], rng)
    if top.met is not None:
        drawn = Points.join(drawn, top.met)
    for _ in range(_MOST_PEAKS):
        best = drawn.take_rows(drawn.rows_by_rising_likelihood()[-1:])
        if not len(best) or not best.log_likelihood[0] > known + _HIGHER:
            break
        begin, calls_left = GaussianAtPeak(best, best.u[0], top.root), most - evaluate.n_calls
        tops.append(climb_to_top(begin, evaluate, max_calls=calls_left, rng=rng, known=known + _HIGHER))
        known = max(known, tops[-1].height)
    return tops
