"""Check a run's evidence by a second, independent estimate, and repeat the run where the two disagree.

Chains that are too short bias every shell a little in the same direction, which neither insertion ranks nor the scatter
between seeds show. The second estimate uses chains twice as long and compresses by few nats: it runs from a prior near
the posterior of the first run (`repartitioned`), or, where that saves nothing, is a small run of the same problem.

Parts of the posterior without live points escape both. So missed peaks are looked for first, from the run's dead points
and its last live ones, and the prior of the second estimate gets a part about each: its posterior tells which of them
matter. The repetition hops between all parts.

- Two modes shrink at the same rate until their tops are near, and over these tens of nats the number of live points in
  each drifts: a narrow mode that begins with a few may lose them all. But some points that died early lie in it. Where
  the likelihood has a dip on the line from such a point to the nearest posterior sample, the point is climbed from.
- Draws about the last live points climb to the top of their peak: a top far above all points of the run means that it
  ended on the arm of a heavy tail, along which its chains hardly moved, beside the bulk of its posterior.
- A narrow peak on a broad one (a phase transition, Skilling 2006) can hold most of the posterior and rise above the
  broad peak only tens of nats above the run's end. Draws about the top need no chains and can meet its flank.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from probewise._arrays import BoolArray, FloatArray
from probewise.errors import NotConvergedError, ParameterError, message_of
from probewise.nested.clusters import Clusters, find_clusters
from probewise.nested.evidence import MOST_MEMORY, warning_of_few_lineages, warning_of_few_possible_draws
from probewise.nested.importance import covariance_root_of_points, repartitioned, root_of_covariance
from probewise.nested.moves import Move, SliceMove
from probewise.nested.problem import Evaluator, Points, Samplable
from probewise.nested.result import Check, NestedResult

_SAMPLES_PER_PARAM, _FEWEST_SAMPLES = 20, 200  # of peaks that are returned
# Share of a peak's evidence within the ellipsoid in which that of the run is counted; share of it with which the run
# has met the peak; and errors by which a peak raises the run's log Z, below which it does not matter.
_INSIDE, _MET, _MATTERS = 0.9, 0.5, 0.1
# Of a climb: draws of a generation, the best of them, the share of the covariance that a generation replaces.
_PER_PARAM, _LEAST_DRAWS, _BEST, _FEWEST_BEST, _LEARNT, _MOST_GENERATIONS = 10, 60, 0.25, 2, 0.3, 80
# Nats between the best draws: at the top, since a gentle slope is followed, too; and of the distribution returned.
_LEVEL, _AS_DRAWN = 0.02, 0.2
# Of early dead points:
_BULK = 0.1  # of the posterior's mass, up to which points count as early
_LINES_SHARE, _CLIMBS_SHARE = 1 / 20, 1 / 6  # of the run's evaluations, for lines, and for climbs from them
_NEXT_DEAD, _BEGIN = 600, 0.3  # points that give the scale of lines and of a climb, which begins in so many sds
_N_KNOWN = 200  # samples of the posterior: so few that a mode of which it has nearly nothing is not among them
_ON_LINE = np.array([0.2, 0.3, 0.4, 0.5])  # places where a line is looked at: the dip lies nearer to the narrow mode
_DIP, _NEAREST = 1.0, 3  # nats of a dip, and samples from which a top lies apart
_MOST_CLIMBS = 8
_FROM_TOP = 3.0  # nats a parameter below the early points' end, down to which a top matters
# Of the top of the last live points' peak, and draws about it:
_ASCENT_SHARE, _DRAWS_SHARE = 1 / 20, 1 / 8  # of the run's evaluations, at most
# Nats a parameter by which a top lies above all points of a run: of a normal posterior it is below half of that.
_FAR_ABOVE = 0.5
_HIGHER = 0.2  # nats by which a draw lies above the known top, so that it belongs to another peak
_SCALES = (1.5, 1.2, 0.95)  # of the draws, in sds at the top
_PER_LIVE = 0.1  # draws of a scale, for each live point and each parameter squared: a cone is the rarer, the more
_MOST_PEAKS = 5


@dataclass(frozen=True, eq=False)
class Peak:
    """A normal distribution at a peak of the likelihood, start or end of a climb, in the sampling coordinates.

    `highest` is one point; `centre` the mean, (n_params,), and `root` @ `root`.T the covariance, (n_params, n_params).
    """

    highest: Points
    centre: FloatArray
    root: FloatArray

    @property
    def log_likelihood(self) -> float:
        """Log likelihood of the highest point."""
        return float(self.highest.log_likelihood[0])

    def draw(self, scale: FloatArray | float, n: int, evaluate: Evaluator, rng: np.random.Generator) -> Points:
        """Evaluate those of `n` draws, `scale` times as wide, (n, 1) or a number, that lie in the space."""
        u = self.centre + scale * rng.standard_normal((n, len(self.centre))) @ self.root.T
        return evaluate(u[evaluate.space.inside_mask(u)], rng)


def find_missed_peaks(
    run: NestedResult, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator
) -> list[FloatArray]:
    """Look for peaks that a run has missed; return samples about each, as wide as it, (n, n_params) in parameters.

    `evaluate` counts the evaluations, at most `max_calls` and about a third of the run's.
    """
    n_params, end = len(run.names), evaluate.n_calls + max_calls

    def left(share: float = math.inf) -> int:
        return int(min(end - evaluate.n_calls, share * run.n_calls))

    top = climb_to_top(peak_of_last_live_points(run, evaluate), evaluate, max_calls=left(_ASCENT_SHARE), rng=rng)
    tops = _tops_apart(run, evaluate, max_calls=left(), rng=rng)
    if top.log_likelihood > float(run.log_likelihood.max()) + _FAR_ABOVE * n_params:
        tops.append(top)
    tops += _higher_tops(run, top, evaluate, max_calls=left(), rng=rng)
    n_draws = max(_SAMPLES_PER_PARAM * n_params, _FEWEST_SAMPLES)
    drawn = (_samples_if_unmet(top, run, evaluate, n_draws, rng) for top in tops if n_draws <= left())
    return [each for each in drawn if each is not None]


def _samples_if_unmet(
    top: Peak, run: NestedResult, evaluate: Evaluator, n_draws: int, rng: np.random.Generator
) -> FloatArray | None:
    """Draw points about a top, (n, n_params) in parameters, as wide as the peak; None if the run has met it.

    On a normal peak of the draws' covariance the log likelihood is n_params / 2 below the top, on average; Laplace's
    approximation then gives the peak's evidence.
    """
    n_params, space, drawn = len(top.centre), evaluate.space, top.draw(1.0, n_draws, evaluate, rng)
    fall = top.log_likelihood - drawn.log_likelihood[np.isfinite(drawn.log_likelihood)]
    scale = math.sqrt(n_params / 2 / max(float(fall.mean()), 1e-3)) if fall.size else 1.0
    root = scale * top.root
    log_volume = 0.5 * n_params * math.log(2 * math.pi) + float(np.linalg.slogdet(root)[1])
    log_z = top.log_likelihood + float(top.highest.log_density[0]) + log_volume
    distance = np.linalg.norm(np.linalg.solve(root, (space.enter(run.theta) - top.centre).T), axis=0)
    has = float(run.weight[distance**2 < chdtri(n_params, 1 - _INSIDE)].sum())
    met = has > 0 and run.log_z + math.log(has) > log_z + math.log(_MET * _INSIDE)
    u = top.centre + scale * (drawn.u - top.centre)
    u = u[space.inside_mask(u)]
    if met or np.logaddexp(run.log_z, log_z) - run.log_z < _MATTERS * run.log_z_error or len(u) <= 2 * n_params:
        return None
    return space.leave(u)[0]


def climb_to_top(
    start: Peak, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator, known: float = -math.inf
) -> Peak:
    """Climb from a normal distribution to the top of a peak; return the distribution about the top.

    As in CMA-ES (Hansen & Ostermeier 2001), the mean of the best quarter of each generation becomes the next mean, and
    their scatter about the old mean updates the covariance, which so stretches along a direction in which the
    likelihood keeps rising. The climb ends when the best draws differ by less than 0.02 nats, after 80 generations, or
    before `max_calls` evaluations would be exceeded. Draws below the log likelihood `known` are ignored: they may
    belong to another peak. At the end the distribution is widened until the best quarter spans 0.2 nats.
    """
    now, n_draws, spread = start, max(_PER_PARAM * len(start.centre), _LEAST_DRAWS), math.inf
    covariance, most = start.root @ start.root.T, evaluate.n_calls + max_calls
    for _ in range(_MOST_GENERATIONS):
        if spread < _LEVEL or evaluate.n_calls + n_draws > most:
            break
        drawn = Peak(now.highest, now.centre, root_of_covariance(covariance)).draw(1.0, n_draws, evaluate, rng)
        best = drawn.take_rows(drawn.rows_by_rising_likelihood()[::-1][: int(_BEST * n_draws)])
        best = best.take_rows(best.log_likelihood > known)
        if len(best) < _FEWEST_BEST:
            covariance = _BEST * covariance
            continue
        off = best.u - now.centre
        covariance = (1 - _LEARNT) * covariance + _LEARNT * off.T @ off / len(best)
        now, spread = Peak(best.take_rows(slice(1)), best.u.mean(axis=0), now.root), float(np.ptp(best.log_likelihood))
    # About a rounded top heights spread as the covariance.
    wider = _AS_DRAWN / spread if 0 < spread < _AS_DRAWN else 1.0
    return Peak(now.highest, now.centre, root_of_covariance(wider * covariance))


def peak_of_last_live_points(run: NestedResult, evaluate: Evaluator) -> Peak:
    """Return mean and covariance of a run's last live points, with the highest of them, to start a climb."""
    last = slice(-run.n_live, None)
    live = evaluate.points_from_known_values(run.theta[last], run.log_likelihood[last], run.label[last])
    highest = live.take_rows(live.rows_by_rising_likelihood()[-1:])
    return Peak(highest, live.u.mean(axis=0), covariance_root_of_points(live.u))


def _tops_apart(run: NestedResult, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator) -> list[Peak]:
    """Climb from early dead points that a dip separates from the posterior; return the tops that are high and apart.

    Early dead points are those that hold the first tenth of the posterior's mass. At most `max_calls` evaluations are
    used for lines to the posterior; those of climbs come on top.
    """
    n_starts = int(min(max_calls, _LINES_SHARE * run.n_calls) / len(_ON_LINE))
    last = int(np.searchsorted(np.cumsum(run.weight), _BULK))
    if n_starts < 2 or last < run.n_live:
        return []
    u = evaluate.space.enter(run.theta[: last + _NEXT_DEAD])
    # No sd below the spacing of floating-point numbers, nor so small that squared distances in sds overflow.
    scale = np.maximum(u[last:].std(axis=0), np.maximum(np.spacing(np.abs(u[last:]).max(axis=0)), 1e-150))
    # Denser in the beginning: a mode that dies out late has points there, too.
    rows = np.unique((last * np.linspace(0.0, 1.0, n_starts) ** 3).astype(np.int64))
    known, start = (
        evaluate.points_from_known_values(run.theta[at], run.log_likelihood[at], run.label[at])
        for at in (np.unique(run.draw_rows(_N_KNOWN, rng=rng)), rows)
    )
    apart = separated_by_dip_mask(start, known, scale, 1, evaluate, rng)
    rows, start = rows[apart], start.take_rows(apart)
    if not rows.size:
        return []
    # At most eight, far apart: the highest, then the furthest from those before it.
    chosen, square = [int(start.log_likelihood.argmax())], np.full(len(rows), np.inf)
    while len(chosen) < _MOST_CLIMBS:
        square = np.minimum(square, (((start.u - start.u[chosen[-1]]) / scale) ** 2).sum(axis=1))
        if not square.max() > 0:
            break
        chosen.append(int(square.argmax()))
    rest = sorted(chosen, key=lambda k: -start.log_likelihood[k])
    # Of the evidence below a level a lost mode holds no more than its share of live points there.
    enough = run.log_likelihood[last] - _FROM_TOP * len(run.names)
    most, tops = evaluate.n_calls + min(max_calls, int(_CLIMBS_SHARE * run.n_calls)), list[Peak]()
    while rest and evaluate.n_calls < most:
        k = rest.pop(0)
        root = _BEGIN * covariance_root_of_points(u[rows[k] : rows[k] + _NEXT_DEAD])
        begin = Peak(start.take_rows(slice(k, k + 1)), start.u[k], root)
        top = climb_to_top(begin, evaluate, max_calls=most - evaluate.n_calls, rng=rng)
        if top.log_likelihood > enough and separated_by_dip_mask(top.highest, known, scale, _NEAREST, evaluate, rng)[0]:
            tops.append(top)
        left = np.array(rest, dtype=np.int64)
        rest = left[separated_by_dip_mask(start.take_rows(left), top.highest, scale, 1, evaluate, rng)].tolist()
    return tops


def separated_by_dip_mask(
    points: Points, known: Points, scale: FloatArray, n_nearest: int, evaluate: Evaluator, rng: np.random.Generator
) -> BoolArray:
    """Return a mask, (n,), of points with a dip of the likelihood on the line to each of their nearest `known` points.

    A dip is 1 nat or more. `scale`, (n_params,), is the unit of distance along each coordinate.
    """
    from scipy.spatial import cKDTree  # slow to import, and needed by runs only

    n, n_params = points.u.shape
    if not n:
        return np.zeros(0, dtype=bool)
    near = cKDTree(known.u / scale).query(points.u / scale, k=min(n_nearest, len(known)))[1].reshape(n, -1)
    goal, begin = known.take_rows(near.ravel()), points.take_rows(np.repeat(np.arange(n), near.shape[1]))
    between = begin.u[:, None] + _ON_LINE[None, :, None] * (goal.u - begin.u)[:, None]
    on_line = evaluate(between.reshape(-1, n_params), rng).log_likelihood.reshape(len(goal), -1)
    height = np.column_stack([begin.log_likelihood, on_line, goal.log_likelihood])
    before, after = np.maximum.accumulate(height, axis=1), np.maximum.accumulate(height[:, ::-1], axis=1)[:, ::-1]
    dip = (height < np.minimum(before, after) - _DIP).any(axis=1)
    return np.asarray(dip.reshape(n, -1).all(axis=1))


def _higher_tops(
    run: NestedResult, top: Peak, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator
) -> list[Peak]:
    """Look for peaks higher than `top`, that of the peak on which a run ended; return their tops, the highest last.

    Without a higher peak at most an eighth of the run's evaluations are used, else at most `max_calls`.
    """
    most = evaluate.n_calls + max_calls
    wanted = run.n_live * max(_PER_LIVE * len(top.centre) ** 2, 1.0)
    n_draws = int(min(wanted, min(max_calls, _DRAWS_SHARE * run.n_calls) / len(_SCALES)))
    if n_draws < run.n_live:
        return []
    # Of several peaks of about one height the climb took one, and the run knows the others.
    known, tops = max(top.log_likelihood, float(run.log_likelihood.max())), list[Peak]()
    drawn = top.draw(np.repeat(_SCALES, n_draws)[:, None], n_draws * len(_SCALES), evaluate, rng)
    best = drawn.take_rows(drawn.rows_by_rising_likelihood()[-1:])
    while len(tops) < _MOST_PEAKS and len(best) and best.log_likelihood[0] > known + _HIGHER:
        begin, calls_left = Peak(best, best.u[0], top.root), most - evaluate.n_calls
        tops.append(climb_to_top(begin, evaluate, max_calls=calls_left, rng=rng, known=known + _HIGHER))
        known = max(known, tops[-1].log_likelihood)
    return tops


DISAGREE = 2.5
"""Difference of two estimates of log Z, in combined standard errors, above which they disagree."""

_N_SAMPLES = 2000
_GAIN = 0.8  # share of the first run's nats, below which the second estimate is one from near the posterior
_SHARE = 0.1  # of the first run's live points times nats, spent on the second estimate
_LEAST_LIVE = 40
_SAMPLES_IN_CLUSTER = 20  # per parameter: with fewer, repeated samples look like a cluster
_AGAIN = 2.2  # times the first run's evaluations: what it costs to repeat it with chains twice as long
_MISSING = 1.0  # errors by which a missed peak raises log Z, above which it is a doubt

Search = Callable[..., NestedResult]  # runs nested sampling once, without a check, as `run_once` does


@dataclass
class _Budget:
    """The likelihood evaluations of a check, the first run's included: at most `limit` in all, `spent` so far."""

    search: Search
    limit: float
    spent: int
    rng: np.random.Generator

    @property
    def left(self) -> int:
        return int(self.limit - self.spent)

    def run(
        self, problem: Samplable, n_live: int, chain: SliceMove, modes: Clusters | None = None
    ) -> NestedResult | None:
        """Run nested sampling, with hops between `modes`; None if too few evaluations are left for a complete run."""
        # A run is worth a start with its first live points, and twice the evaluations of one round.
        if self.left < n_live * (1 + chain.n_steps(len(problem.prior.names)) * chain.target):
            return None
        found = self.search(problem, n_live=n_live, move=replace(chain, modes=modes), max_calls=self.left, rng=self.rng)
        self.spent += found.n_calls
        return found if found.complete else None


@dataclass(frozen=True, eq=False)
class _SecondEstimate:
    """A `run` by the method `name`, whose posterior says how much each missed peak holds."""

    name: str
    run: NestedResult
    # `n_met` clusters of the first run's samples and then the missed peaks, in the coordinates into which `enter` maps
    # parameters; None if no peak was missed.
    parts: Clusters | None
    n_met: int
    enter: Callable[[FloatArray], FloatArray]

    def distance(self, run: NestedResult) -> float:
        return (run.log_z - self.run.log_z) / max(math.hypot(_error_to_trust(run), self.run.log_z_error), 1e-12)

    def doubts(self, run: NestedResult) -> list[str]:
        return [*self.missing_part_in_words(run), *self.disagreement_in_words(run)]

    def missing_part_in_words(self, run: NestedResult) -> list[str]:
        """Describe the missed peaks that matter and of which a run has less than half; empty without any."""
        share = 0.0
        if self.parts is not None:
            has, wanted = (
                np.bincount(self.parts.assign(self.enter(each.theta)), each.weight, len(self.parts))[self.n_met :]
                for each in (run, self.run)
            )
            share = float(wanted[has < _MET * wanted].sum())
        if -math.log1p(-min(share, 1 - 1e-15)) <= _MISSING * _error_to_trust(run):
            return []
        return [
            "a part of the posterior that the live points have lost or never met has a log Z of about "
            f"{self.run.log_z + math.log(share):.2f}, this run's is {run.log_z:.2f} ± {run.log_z_error:.2f}; use more "
            "n_live, or a prior about it"
        ]

    def disagreement_in_words(self, run: NestedResult) -> list[str]:
        """Describe that the evidences disagree, or that this one is itself doubtful; empty if neither."""
        if abs(self.distance(run)) > DISAGREE:
            return [
                f"{self.name} gives log Z = {self.run.log_z:.2f} ± {self.run.log_z_error:.2f}, this run "
                f"{run.log_z:.2f} ± {run.log_z_error:.2f}: {abs(self.distance(run)):.1f} errors apart; chains are too "
                "short or a part of the posterior was lost; use move=nested.SliceMove(steps_per_param=4), more n_live, "
                "or a greater max_cost"
            ]
        return [f"{self.name}, which checks the evidence, is itself doubtful: {w}" for w in self.run.warnings[:1]]


def _error_to_trust(run: NestedResult) -> float:
    """Return a run's error, but no more than few lineages can tell: a greater one would excuse any disagreement."""
    return run.log_z_error * math.sqrt(min(MOST_MEMORY / run.memory, 1.0))


def check_and_repeat(
    first: NestedResult,
    evaluate: Evaluator,
    move: Move,
    search: Search,
    *,
    max_cost: float,
    max_calls: int | None,
    least_live: int,
    rng: np.random.Generator,
) -> NestedResult:
    """Check a run that its stopping rule ended; repeat it with longer chains where there are doubts.

    Limits on all evaluations, those of `first` included: `max_cost` times those of `first`, and `max_calls`, if not
    None. `least_live`: fewest live points allowed for the problem. `evaluate`: of the problem, for the search of missed
    peaks; `search` brings its own.

    Return the first run, or a repetition if only that has no doubts. `check` holds the second estimate; None if it
    failed or did not end, which adds a warning. `n_calls` counts all evaluations.
    """
    limit = min(max_cost * first.n_calls, math.inf if max_calls is None else max_calls)
    budget, now, check = _Budget(search, limit, first.n_calls, rng), first, None
    try:
        least = SliceMove()  # whose chains, or the run's if longer, are doubled
        chain = move if isinstance(move, SliceMove) else least
        steps, fewest = max(chain.steps_per_param, least.steps_per_param), max(chain.fewest_steps, least.fewest_steps)
        chain = replace(chain, steps_per_param=2.0 * steps, fewest_steps=2 * fewest)
        second = _second_estimate(first, evaluate, budget, chain, least_live)
        if second is None:
            # An estimate that should cost a fifth of the run and does not end is itself a sign of trouble.
            notes = [
                "a second estimate, which checks the evidence, did not end within max_cost and max_calls "
                f"({int(limit)} evaluations in all); use a greater limit, or max_cost=1 for no check"
            ]
        else:
            n_check, notes = budget.spent - first.n_calls, second.doubts(first)
            if notes and not second.run.warnings:
                again = budget.run(evaluate.problem, first.n_live, chain, second.parts)
                if again is not None and not again.warnings and not second.doubts(again):
                    now, notes = again, []
            log_z, error = second.run.log_z, second.run.log_z_error
            check = Check(second.name, log_z, error, second.distance(now), n_check)
            if not notes:
                # A poorly known share of possible hypotheses, or error, no longer matters once both agree.
                settled = [warning_of_few_possible_draws(now.log_start, now.log_start_error, now.n_live)]
                settled += [warning_of_few_lineages(now.memory)] if error < now.log_z_error else []
                now = replace(now, warnings=tuple(note for note in now.warnings if note not in settled))
    except Exception as error:
        # A second estimate may evaluate hypotheses that the first run never met. Whatever a check meets, a posterior
        # narrower than floats among it, the run that ended is kept.
        why = str(error) if isinstance(error, NotConvergedError) else message_of(error)
        notes = [f"a second estimate, which checks the evidence, failed: {why}"]
    return replace(now, n_calls=budget.spent, check=check, warnings=(*now.warnings, *notes))


def _second_estimate(
    first: NestedResult, evaluate: Evaluator, budget: _Budget, chain: SliceMove, least_live: int
) -> _SecondEstimate | None:
    """Run from near the posterior and the missed peaks, or a small run; None if it did not end.

    Where the two estimates disagree it is repeated with more live points.
    """
    problem, enter, n_before = evaluate.problem, evaluate.space.enter, evaluate.n_calls
    invertible = hasattr(problem.prior, "to_unit_cube") or hasattr(problem.prior, "coordinates")
    peaks = find_missed_peaks(first, evaluate, max_calls=budget.left, rng=budget.rng) if invertible else []
    budget.spent += evaluate.n_calls - n_before
    theta = first.samples(_N_SAMPLES, rng=budget.rng)
    least = max(least_live, min(_LEAST_LIVE, first.n_live))
    name, posed, n_live = "a second run with longer chains", problem, max(first.n_live // 8, least)
    if first.information > 0 and hasattr(problem.prior, "log_prob"):
        with contextlib.suppress(ParameterError, np.linalg.LinAlgError):  # too few samples, or they hardly vary
            near = repartitioned(problem, theta, peaks=peaks)
            possible = first.log_weight > -math.inf
            gained = first.log_likelihood[possible] + near.prior.log_prior_ratio(first.theta[possible])
            # With a log Z that is far too large the nats come out too few, or negative.
            nats = float(first.weight[possible] @ gained) - first.log_z
            finite = np.isfinite([near.prior.root, near.prior.inverse_root]).all()  # not where samples hardly vary
            if finite and (peaks or nats < _GAIN * first.information):
                wanted = _SHARE * first.n_live * first.information / max(nats, 1.0)
                enough = 2.0 * first.n_live * nats / first.information  # for an error below the first run's
                name, posed = "a second pass from near the posterior", near
                n_live = int(max(min(wanted, enough, first.n_live / 2), least))
    found = budget.run(posed, n_live, chain)
    if found is None:
        return None
    parts, n_met = None, 1
    if peaks:
        whole, fewest = enter(theta), _SAMPLES_IN_CLUSTER * theta.shape[1]
        clusters, met = find_clusters(whole, least=fewest), [whole]
        home = clusters.assign(whole)
        if np.bincount(home, minlength=len(clusters)).min() >= fewest:  # the last division of space may leave fewer
            met = [whole[home == k] for k in range(len(clusters))]
        parts, n_met = Clusters.from_groups([*met, *map(enter, peaks)]), len(met)
    second, again = _SecondEstimate(name, found, parts, n_met, enter), _AGAIN * first.n_calls
    room = budget.left - again if budget.left > again else budget.left
    n_more = int(min(first.n_live, n_live * room / found.n_calls))
    if second.disagreement_in_words(first) and not second.missing_part_in_words(first) and n_more > n_live:
        second = replace(second, run=budget.run(posed, n_more, chain) or found)
    return second
