"""Look for parts of the posterior that a run has missed, from its last live points and its dead ones.

Candidates come from three searches.

- Early dead points climb. Two modes shrink at the same rate until their tops are near, and over these tens of nats the
  number of live points in each drifts. A narrow mode that begins with a few points may lose them all: neither the run
  nor anything that starts from its posterior can know of the mode. But some of the points that died early lie in it.
  Where the likelihood has a dip on the straight line from an early dead point to the nearest posterior sample, the
  point lies apart; in a problem with one mode few points do. Some of the points apart are climbed from.
- Draws about the last live points climb to the top of their peak, as in CMA-ES (Hansen & Ostermeier 2001): a top far
  above all points of the run means that it ended on the arm of a heavy tail, along which its chains hardly moved,
  beside the bulk of its posterior. The distribution of the draws stretches along a direction in which the likelihood
  keeps rising: an arm a hundred times as long as wide is climbed in some thousand evaluations.
- Draws about that top meet narrow peaks above the run's end. A run ends where its live points can no longer raise log
  Z, if the likelihood goes on as before. A narrow peak on a broad one (a phase transition, Skilling 2006) can hold most
  of the posterior and rise above the broad peak only tens of nats further up. Draws need no chains and can meet its
  flank.

The evidence of each hill is estimated by importance sampling and compared with that of the run in the same region.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.nested.clusters import Clusters
from probewise.nested.importance import Weighted, draw_and_weigh, single_student_t
from probewise.nested.moves import SliceMove
from probewise.nested.problem import Bound, Evaluator, Points, Samplable, Space, unbounded_space_of
from probewise.nested.repartition import covariance_root_of_points, root_of_covariance
from probewise.nested.result import NestedResult, Samples
from probewise.nested.weights import n_effective

DISAGREE = 2.5
"""Difference of two estimates of log Z, in combined standard errors, above which they disagree."""

_ASCENT_SHARE = 1 / 20  # of a run's evaluations, at most
_WEIGHING_SHARE = 1 / 6  # up to which another hill is weighed
# Nats a parameter by which a top lies above all points of a run: of a normal posterior it is below half of that.
_FAR_ABOVE = 0.5
_MISSING = 1.0  # errors by which a part that has no live points raises log Z, above which it is a doubt
_FEWEST_STEPS = 6
# Of a climb by generations of draws:
_PER_PARAM, _LEAST_DRAWS = 10, 60  # draws of a generation
_BEST, _FEWEST_BEST = 0.25, 2  # of them
_LEARNT = 0.3  # share of the covariance that a generation replaces
_MOST_GENERATIONS = 80
_LEVEL = 0.02  # nats between the best draws at the top: a gentle slope is followed, too
_AS_DRAWN = 0.2  # nats between the best draws of the distribution that is returned
# Of early dead points:
_SHARE = 1 / 20  # of the run's evaluations, for the first lines
_TRIES = 2  # candidates in a step of a climb
_WIDTH = 3.0  # of a step, in sds of the points that died next
_ON_LINE = np.array([0.2, 0.3, 0.4, 0.5])  # places where a line is looked at: the dip lies nearer to the narrow mode
_DIP = 1.0  # nats
_NEXT_DEAD = 600  # points that give the metric of a climb
_BULK = 0.1  # of the posterior's mass, up to which points count as early
_N_KNOWN = 200  # samples of the posterior: so few that a mode of which it has nearly nothing is not among them
_MOST_HILLS = 8
_SWEEPS = 12  # of a climb
_FROM_TOP = 3.0  # nats a parameter: a climb ends as near to the top
_NEAREST = 3
# Of draws above the end:
_HIGHER = 0.2  # nats by which a draw lies above the known top, so that it belongs to another peak
_SCALES = (1.5, 1.2, 0.95)  # of the draws, in sds at the top
_PER_LIVE = 0.1  # draws of a scale, for each live point and each parameter squared: a cone is the rarer, the more
_MOST_SHARE = 1 / 8  # of the run's evaluations, for these draws
_MOST_PEAKS = 5
# Of the evidence of a hill:
_N_SAMPLES = 1000  # of a hill
_ROUNDS = 6
_SETTLED = 0.5  # nats
_POINTS_PER_PARAM, _DRAWS_PER_PARAM = 4, 40
_FITS, _ENOUGH = 6, 4.0  # effective samples a parameter
_POWERS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15, 0.1)
_WIDER = 1.2  # the sds of the Student t than those of the points it is fitted to
_INSIDE = 0.9  # of the weight of a hill, within the ellipsoid in which the run's own weight is counted
_MET = 0.5  # of the evidence of a hill: with more, the run has met it


@dataclass(frozen=True, eq=False)
class MissedHills:
    """Hills that a run has missed: hills `lost` by its live points, and narrow peaks `above` its end.

    `n_calls`: evaluations that were used to look for the hills.
    """

    lost: tuple[HillEstimate, ...] = ()
    above: tuple[HillEstimate, ...] = ()
    n_calls: int = 0

    def doubts(self, run: Samples) -> tuple[str, ...]:
        """Return doubts in words, at most one per kind of hill, about hills that `run` has not met.

        Lost hills count if together they would raise log Z by more than 1 of its errors, higher peaks by more than 2.5.
        """
        lost, above = (log_evidence_of_unmet_hills(hills, run) for hills in (self.lost, self.above))
        mine, notes = f"this run's {run.log_z:.2f} ± {run.log_z_error:.2f}", list[str]()
        if log_z_rise_in_errors(run, lost) > _MISSING:
            notes.append(
                f"a part of the posterior that the live points have lost has a log Z of about {lost:.2f}, {mine}; "
                "use more n_live or a greater max_cost"
            )
        if log_z_rise_in_errors(run, above) > DISAGREE:
            notes.append(
                f"a narrow peak that no live point met lies above the run's end: its log Z is about {above:.1f}, "
                f"{mine}; use more n_live or a prior about the peak"
            )
        return tuple(notes)


def log_z_rise_in_errors(run: Samples, log_z: float) -> float:
    """Return by how many of its errors a run's log Z would rise if a part of log evidence `log_z` were added."""
    return (float(np.logaddexp(run.log_z, log_z)) - run.log_z) / max(run.log_z_error, 1e-12)


def find_missed_hills(
    run: NestedResult,
    problem: Samplable,
    *,
    max_calls: float,
    rng: np.random.Generator,
    lost: tuple[HillEstimate, ...] | None = None,
    executor: Executor | None = None,
    n_workers: int | None = None,
) -> MissedHills:
    """Look for parts of the posterior that a run has missed; nothing is found for a prior without an inverse.

    `max_calls`: limit of evaluations; at most about a quarter of the run's are used. `lost`: parts that are known
    already, from the run that this one repeats; no others are then looked for. `executor` evaluates batches of the
    likelihood in `n_workers` parts, as for `run`. NotConvergedError if the likelihood fails.
    """
    if not run.names or not (hasattr(problem.prior, "to_unit_cube") or hasattr(problem.prior, "coordinates")):
        return MissedHills()
    evaluate = Evaluator(problem, executor=executor, n_parts=n_workers)

    def calls_left(share: float = math.inf) -> int:
        return int(min(max_calls - evaluate.n_calls, share * run.n_calls))

    top = climb_to_top(
        gaussian_of_last_live_points(run, evaluate), evaluate, max_calls=calls_left(_ASCENT_SHARE), rng=rng
    )
    if lost is None:
        tops = peaks_climbed_from_early_points(run, evaluate, max_calls=calls_left(), rng=rng)
        if top.highest_log_likelihood > float(run.log_likelihood.max()) + _FAR_ABOVE * len(run.names):
            tops.append(top)
        lost = _weigh_hills_and_keep_unmet(tops, run, evaluate, max_calls=calls_left(_WEIGHING_SHARE), rng=rng)
    peaks = find_higher_peaks(run, top, evaluate, max_calls=calls_left(), rng=rng)
    above = _weigh_hills_and_keep_unmet(peaks, run, evaluate, max_calls=calls_left(), rng=rng)
    return MissedHills(lost, above, evaluate.n_calls)


def _weigh_hills_and_keep_unmet(
    tops: Iterable[GaussianAtPeak], run: NestedResult, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator
) -> tuple[HillEstimate, ...]:
    """Estimate the evidence of the hill under each top, the highest first; return the hills that a run has not met.

    Tops that no dip separates from a hill already estimated are skipped.
    """
    hills, most = list[HillEstimate](), evaluate.n_calls + max_calls
    rest = sorted(tops, key=lambda top: top.highest_log_likelihood)
    scale = sds_after_early_dead_points(run, evaluate.space)
    while rest and evaluate.n_calls + calls_for_hill_evidence(len(run.names)) < most:
        settled = draw_uniformly_near_hilltop(rest.pop(), evaluate, rng)
        if rest:
            points = Points.join(*(top.highest for top in rest))
            apart = separated_by_dip_mask(points, settled, scale, 1, evaluate, rng)
            rest = [top for top, is_apart in zip(rest, apart, strict=True) if is_apart]
        hill = estimate_hill(settled, evaluate, rng)
        hills += [] if hill is None or hill.is_met_by(run) else [hill]
    return tuple(hills)


def _n_early_dead_points(run: NestedResult) -> int:
    """Count the early dead points: those that hold the first tenth of the posterior's mass."""
    return int(np.searchsorted(np.cumsum(run.weight), _BULK))


def sds_after_early_dead_points(run: NestedResult, space: Space) -> FloatArray:
    """Compute the sds of the 600 points that die next after the early ones, in coordinates of the space, (n_params,).

    Early dead points are those that hold the first tenth of the posterior's mass. No sd is below the spacing of
    floating-point numbers there, nor so small that squared distances in sds overflow.
    """
    last = _n_early_dead_points(run)
    u = space.enter(run.theta[last : last + _NEXT_DEAD])
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
    u = evaluate.space.enter(first.theta[: last + _NEXT_DEAD])
    scale = sds_after_early_dead_points(first, evaluate.space)
    apart = np.flatnonzero(separated_by_dip_mask(start, known, scale, 1, evaluate, rng))
    if not apart.size:
        return []
    chosen = apart[_rows_far_apart(start.u[apart] / scale, start.log_likelihood[apart])]
    roots = np.stack([covariance_root_of_points(u[row : row + _NEXT_DEAD]) for row in rows[chosen]])
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
            inside = space.inside_mask(u).nonzero()[0]
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
    def highest_log_likelihood(self) -> float:
        """Log likelihood of the highest point."""
        return float(self.highest.log_likelihood[0])


def climb_to_top(
    start: GaussianAtPeak, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator, known: float = -math.inf
) -> GaussianAtPeak:
    """Climb from a normal distribution to the top of a peak; return the distribution about the top.

    The climb ends when the best draws differ by less than 0.02 nats, after 80 generations, or before `max_calls`
    evaluations would be exceeded. Draws below the log likelihood `known` are ignored: they may belong to another peak.
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
    """Return the mean and covariance of a run's last live points, with the highest of them, to start a climb."""
    last = slice(-run.n_live, None)
    live = evaluate.points_from_known_values(run.theta[last], run.log_likelihood[last], run.label[last])
    return GaussianAtPeak(
        live.take_rows(live.rows_by_rising_likelihood()[-1:]), live.u.mean(axis=0), covariance_root_of_points(live.u)
    )


def find_higher_peaks(
    run: NestedResult, top: GaussianAtPeak, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator
) -> list[GaussianAtPeak]:
    """Look for peaks higher than `top`, the peak on which a run ended; return the top of each, the highest last.

    `evaluate`: the run's problem, whose prior has `to_unit_cube` or coordinates of its own; it counts the evaluations,
    at most `max_calls`. Without a higher peak at most an eighth of the run's are used.
    """
    n_params, most = len(evaluate.names), evaluate.n_calls + max_calls
    wanted = run.n_live * max(_PER_LIVE * n_params**2, 1.0)
    n_draws = int(min(wanted, min(max_calls, _MOST_SHARE * run.n_calls) / len(_SCALES)))
    if n_draws < run.n_live:
        return []
    peaks = list[GaussianAtPeak]()
    # Of several peaks of about one height the climb took one, and the run knows the others.
    known = max(top.highest_log_likelihood, float(run.log_likelihood.max()))
    scale = np.repeat(_SCALES, n_draws)[:, None]
    tried = top.centre + scale * rng.standard_normal((scale.size, n_params)) @ top.root.T
    drawn = evaluate(tried[evaluate.space.inside_mask(tried)], rng)
    if top.met is not None:
        drawn = Points.join(drawn, top.met)
    for _ in range(_MOST_PEAKS):
        best = drawn.take_rows(drawn.rows_by_rising_likelihood()[-1:])
        if not len(best) or not best.log_likelihood[0] > known + _HIGHER:
            break
        peak = climb_to_top(
            GaussianAtPeak(best, best.u[0], top.root),
            evaluate,
            max_calls=most - evaluate.n_calls,
            rng=rng,
            known=known + _HIGHER,
        )
        peaks.append(peak)
        known = max(known, peak.highest_log_likelihood)
    return peaks


@dataclass(frozen=True, eq=False)
class HillEstimate:
    """A hill of the posterior, that is a mode and its surroundings, with samples and the log of its evidence.

    `theta`: samples of the hill, (n, n_params). Within `radius` sds of the single cluster `shape`, in coordinates of
    `space`, lies 90 % of the hill's evidence.
    """

    log_z: float
    theta: FloatArray
    space: Space
    shape: Clusters
    radius: float

    @classmethod
    def from_draws(cls, drawn: Weighted, space: Space, rng: np.random.Generator) -> HillEstimate:
        """Make the estimate from weighted draws on a hill; `space` holds the coordinates of its ellipsoid."""
        theta = drawn.samples(_N_SAMPLES, rng=rng)
        x = space.enter(theta)
        shape = Clusters.from_groups([x])
        return cls(drawn.log_z, theta, space, shape, float(np.quantile(_distance_in_sds(x, shape), _INSIDE)))

    def is_met_by(self, run: Samples) -> bool:
        """Return whether a run's posterior has, within this hill's ellipsoid, more than half of the hill's evidence."""
        inside = _distance_in_sds(self.space.enter(run.theta), self.shape) <= self.radius
        near = float(run.weight[inside].sum())
        return near > 0 and run.log_z + math.log(near) > self.log_z + math.log(_MET * _INSIDE)


def _distance_in_sds(x: FloatArray, shape: Clusters) -> FloatArray:
    """Distance of points (n, n_params) from the mean of a single cluster, in sds of the cluster, (n,)."""
    return np.asarray(np.linalg.norm((x - shape.mean[0]) @ shape.inverse_root[0].T, axis=1))


def log_evidence_of_unmet_hills(hills: Iterable[HillEstimate], run: Samples) -> float:
    """Return the log of the sum of the evidences of the hills that a run has not met; -inf where it met all."""
    return float(logsumexp([-math.inf, *(hill.log_z for hill in hills if not hill.is_met_by(run))]))


def _n_points_on_hill(n_params: int) -> int:
    return max(_POINTS_PER_PARAM * n_params, 20)


def calls_for_hill_evidence(n_params: int) -> float:
    """Return about how many evaluations the evidence of a hill takes: two or three rounds of chains."""
    return 2.5 * _n_points_on_hill(n_params) * max(n_params, _FEWEST_STEPS) * SliceMove().target


def draw_uniformly_near_hilltop(top: GaussianAtPeak, evaluate: Evaluator, rng: np.random.Generator) -> Points:
    """Draw points uniformly where the log likelihood is within (n_params + 2) / 2 of a hill's highest (slice sampling).

    On a normal hill these points have the covariance of the whole hill.
    """
    n_params = top.root.shape[0]
    n = _n_points_on_hill(n_params)
    below = (n_params + 2) / 2
    move = SliceMove(hops=0)
    live = top.highest.u + rng.standard_normal((n, n_params)) @ top.root.T
    starts = top.highest.take_rows(np.zeros(n, dtype=np.int64))
    highest, log_volume = top.highest_log_likelihood, -math.inf
    for _ in range(_ROUNDS):
        drawn, _ = move.draw(starts, Bound(highest - below, 1.0), live, evaluate, rng)
        last, log_volume = log_volume, float(np.linalg.slogdet(covariance_root_of_points(drawn.u))[1])
        rise = max(float(drawn.log_likelihood.max()) - highest, 0.0)
        if rise < _SETTLED and abs(log_volume - last) < _SETTLED * math.sqrt(n_params):
            break
        highest += rise
        live = drawn.u
        starts = drawn.take_rows((drawn.log_likelihood > highest - below).nonzero()[0])
        starts = starts.take_rows(rng.integers(len(starts), size=n))
    return drawn


def estimate_hill(settled: Points, evaluate: Evaluator, rng: np.random.Generator) -> HillEstimate | None:
    """Estimate a hill's evidence by draws from a Student t about points on the hill; None where no Student t fits.

    Where there are too few effective samples, the Student t is fitted anew to the weighted draws, up to five times.
    """
    space = unbounded_space_of(evaluate.problem.prior)
    x, n_params = space.enter(settled.theta), settled.theta.shape[1]
    mean, covariance = x.mean(axis=0), np.atleast_2d(np.cov(x, rowvar=False))
    n_draws, enough = max(_DRAWS_PER_PARAM * n_params, 200), _ENOUGH * n_params
    for _ in range(_FITS):
        proposal = single_student_t(mean, _WIDER**2 * covariance)
        drawn = draw_and_weigh(proposal, 0.0, None, space, evaluate, n_draws=n_draws, rng=rng)
        if drawn.n_eff > enough:
            return HillEstimate.from_draws(drawn, space, rng)
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
