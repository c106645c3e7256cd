"""The quick way to evidence and posterior of each order: from the peaks of its likelihood instead of the prior.

Where the readings need all Gaussians, importance sampling about the peaks suffices. Where a Gaussian more gains little,
most of the posterior is far from the peaks: there it is faint. Then a search of the whole prior with few live points
finds the posterior, and nested sampling from a prior near it (`probewise.nested.repartition`) its evidence.

Orders are fitted upwards until the evidence has clearly fallen. A search of the whole prior with few live points
vouches for the order that is chosen.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from probewise._arrays import FloatArray
from probewise.calibration.about_peaks import MOST_RELABELLED, weigh_draws_about_peaks
from probewise.calibration.peaks import climb, starts_of_climbs
from probewise.calibration.priors import SSFPrior
from probewise.calibration.search import OrderPosterior, ProblemsByOrder, Progress, Search
from probewise.errors import DoubtfulResultWarning
from probewise.inference import SensorProblem
from probewise.nested import NestedResult, Samplable, Weighted, least_live, run
from probewise.nested.repartition import repartitioned
from probewise.priors import Uniform

# With fewer the posterior may lie along the bounds of the prior, far from any peak; and a search costs little.
_LEAST_READINGS = 80
_LOWER = 12.0  # ln L below the highest peak, up to which draws are made about peaks
_LEAST_EFFECTIVE, _GAINED = 200, 3.0  # draws about peaks, and nats over the orders below, from which they suffice
_N_LIVE, _N_SAMPLES = 150, 1000  # live points from near the posterior, and samples that say where that is
# The evidence has clearly fallen by so many errors and nats, unless the next order's peak is higher by much.
_N_ERRORS, _FALLEN, _MUCH_HIGHER = 3.0, 2.0, 10.0
# The search of the prior: live points; it disagrees beyond so many errors, one false alarm in 30,000, or where many of
# its samples have weights above all others.
_SEARCHING_LIVE, _SEARCHING_PER_PARAM, _DISAGREE = 50, 4, 4.0
_N_VOUCHING, _MISSED, _HIGHER = 300, 0.2, 2.0

_LogWeight = Callable[[FloatArray], FloatArray]


def has_uniform_light(prior: SSFPrior) -> bool:
    """Return whether a Gaussian's light is uniform from 0, as draws about peaks require."""
    return prior.unit_mass_mm2 is not None and prior.amplitude == Uniform(0.0, 1.0)


def fit_orders_quickly(
    problems: ProblemsByOrder,
    orders: Sequence[int],
    *,
    search: Search,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> tuple[dict[int, OrderPosterior], str]:
    """Fit the orders upwards until the evidence has clearly fallen; `search` fits what is doubtful.

    Return the posteriors by order, and a note: which orders were left out, or why none is here and all must be searched
    in full.
    """
    n_usable = int(problems.recording.usable.sum())
    if n_usable < _LEAST_READINGS:
        return {}, f"searched in full: {n_usable} usable readings, fewer than {_LEAST_READINGS}"
    if not all(has_uniform_light(problems.prior_of(n)) for n in range(1, max(orders) + 1)):
        return {}, "searched in full: the prior of a Gaussian's light is not uniform from 0"
    alone, seen = problems.problem(1), dict[int, NestedResult]()
    found, log_weight_at = dict[int, Weighted](), dict[int, _LogWeight]()
    peaks, last, fallen, note = np.empty((0, 8)), -math.inf, False, ""
    for n in range(1, max(orders) + 1):
        problem = problems.problem(n)
        ends, high = climb(problem, alone, starts_of_climbs(problem, peaks, rng))
        peaks, gain, last = ends[high > high[0] - _LOWER], float(high[0]) - last, float(high[0])
        if fallen and gain < _MUCH_HIGHER:
            left = [str(m) for m in sorted(orders) if m >= n]
            which = f"order{'s' if len(left) > 1 else ''} {' and '.join(left)}"
            note = f"{which} not tried: the evidence has clearly fallen before" if left else ""
            break
        if n not in orders:
            continue
        best = max((made.log_z for made in found.values()), default=-math.inf)
        if n <= MOST_RELABELLED:
            found[n], log_weight_at[n] = weigh_draws_about_peaks(problem, peaks, rng=rng)
        made = found.get(n)
        if made is None or not (made.sound and made.n_eff > _LEAST_EFFECTIVE and made.log_z > best + _GAINED):
            seen[n] = _search_with_few_live_points(problem, rng, progress)
            found[n], log_weight_at[n] = _sample_near(problem, seen[n], rng, progress)
        fallen = best - found[n].log_z > max(_FALLEN, _N_ERRORS * found[n].log_z_error)
    posteriors = {n: OrderPosterior(made, None) for n, made in found.items()}
    vouched: set[int] = set()
    while (chosen := max(posteriors, key=lambda n: posteriors[n].evidence_result.log_z)) in found.keys() - vouched:
        vouched.add(chosen)
        if chosen not in seen:
            seen[chosen] = _search_with_few_live_points(problems.problem(chosen), rng, progress)
        why = _missed_part_in_words(seen[chosen], found[chosen], log_weight_at[chosen], rng)
        for n in [n for n in posteriors if why and n >= chosen]:
            found.pop(n, None)
            full = search(n, rng)
            words = f"order {n} was searched in full, since the quick way missed a peak of order {chosen}: {why}"
            posteriors[n] = replace(full, notes=(*full.notes, words))
    return posteriors, note


def _sample_near(
    problem: SensorProblem, seen: NestedResult, rng: np.random.Generator, progress: Progress | None
) -> tuple[Weighted, _LogWeight]:
    """Estimate evidence and posterior by nested sampling from a prior near the samples of a search, `seen`.

    Also return the log weight as a function of parameters: of prior times likelihood over the density of that prior.
    """
    nearby = repartitioned(problem, seen.samples(_N_SAMPLES, rng=rng))
    found = _run_silently(nearby, max(_N_LIVE, least_live(len(problem.prior.names))), rng, progress)
    rows = np.flatnonzero(found.log_weight > -math.inf)
    theta = found.theta[rows]
    made = Weighted(
        found.names,
        theta,
        log_likelihood=found.log_likelihood[rows] - nearby.prior.log_prior_ratio(theta),
        log_weight=found.log_weight[rows],
        log_z=found.log_z,
        log_z_error=found.log_z_error,
        n_eff=found.n_eff,
        n_calls=found.n_calls,
        pareto_k=-math.inf,
        warnings=found.warnings,
    )
    return made, nearby.log_likelihood


def _search_with_few_live_points(
    problem: SensorProblem, rng: np.random.Generator, progress: Progress | None
) -> NestedResult:
    return _run_silently(problem, max(_SEARCHING_LIVE, _SEARCHING_PER_PARAM * len(problem.prior.names)), rng, progress)


def _run_silently(problem: Samplable, n_live: int, rng: np.random.Generator, progress: Progress | None) -> NestedResult:
    report = None if progress is None else partial(progress, len(problem.prior.names) // 6)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)  # they are in the result
        return run(problem, rng=rng, n_live=n_live, progress=report, max_cost=1.0, return_interrupted=False)


def _missed_part_in_words(
    seen: NestedResult, made: Weighted, log_weight_at: _LogWeight, rng: np.random.Generator
) -> str:
    """Describe in words what `made` missed of what a search of the whole prior has `seen`; "" if nothing.

    Where the density that `made` was drawn from has left out a part, that part's samples outweigh all others.
    """
    if seen.log_z - made.log_z > _DISAGREE * math.hypot(seen.log_z_error, made.log_z_error):
        return (
            f"ln Z is {seen.log_z:.2f} ± {seen.log_z_error:.2f} by a search of the whole prior, "
            f"{made.log_z:.2f} ± {made.log_z_error:.2f} by the quick way"
        )
    highest = log_weight_at(made.theta).max()
    share = float((log_weight_at(seen.samples(_N_VOUCHING, rng=rng)) > highest + _HIGHER).mean())
    if share > _MISSED:
        return f"{share:.0%} of the samples of a search of the whole prior lie apart from those of the quick way"
    return ""
