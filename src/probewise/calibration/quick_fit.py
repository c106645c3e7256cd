"""Fit one order after another by SMC: from the peak of its likelihood, or from the posterior of the order below.

If an added Gaussian raises the likelihood much, the posterior lies about the highest peak, and particles start from a
density fitted there. If not, each part of the posterior, by its number of bright Gaussians, is sampled by itself. In
parts with faint Gaussians, particles start from the same part of the order below with a faint Gaussian added, and a
bridge gives the ratio of the two evidences (`light_integral`). In the part where all are bright, particles start from a
wide density. At every order ascents from all over the prior look for a peak that the particles missed. A search of the
whole prior by nested sampling checks the order that is chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from probewise._arrays import FloatArray
from probewise.calibration.all_bright_density import AllGaussiansBrightDensity
from probewise.calibration.check_by_search import search_for_missed_part
from probewise.calibration.compensation import CompensatedShapeProposal
from probewise.calibration.faint_gaussian_reference import FaintGaussianReferenceDensity, has_uniform_prior_of_light
from probewise.calibration.light_integral import FaintGaussianLikelihoodRatio, bridge_log_z_ratio
from probewise.calibration.mixed_reference import MixedReferenceDensity
from probewise.calibration.order_problems import ProblemsByOrder
from probewise.calibration.order_search import OrderPosterior, Progress, Search
from probewise.calibration.peak_density import PeakDensity, fit_density_about_peak, share_missed_about_peak
from probewise.calibration.peaks import HighestPeak, find_highest_likelihood_peak_by_order
from probewise.calibration.posterior_parts import (
    FootprintPlaceAndSize,
    PosteriorPart,
    evidence_shares,
    join_smc_results_of_parts,
    split_posterior_by_n_bright,
)
from probewise.calibration.reference_density import ReferenceDensity
from probewise.calibration.smc import N_CLOUDS, N_SNAPSHOTS, SMCResult, TemperatureSummary, run_smc
from probewise.calibration.whole_coordinates import count_bright_gaussians

# With fewer the posterior may lie along the bounds of the prior, far from any peak; and a search costs little.
_LEAST_READINGS = 80
# Quadrature nodes over curved edges for the shifts of `CompensatedShapeProposal`: mostly within 0.001 of the span.
_FEW_NODES = 8
_N_PARTICLES = 1000
# Gain in ln L by one Gaussian above which the posterior is assumed to lie about the highest peak.
_NEEDED = 20.0
# Least effective share of the samples in a bridge.
_LEAST_SHARE = 0.05
# Factor by which the density of the first run from a peak is widened: particles gather more easily than they spread.
_WIDENED = 1.6
# Runs from a peak: moves at each temperature; moves once the posterior is reached, in the first and the second run.
_STEPS, _FEW_MOVES, _MANY_MOVES = 5, 6, 60
# Draws of a density fitted to the samples about a peak.
_N_FITTED = 6000
# Two evidences disagree beyond this many errors and this many nats: the scatter of few clouds is only rough.
_DISAGREE, _APART = 4.0, 1.0
# A peak higher than all samples by this many nats is checked; it was missed if it holds this share of Z.
_HIGHER, _MISSED = 2.0, 0.2
_N_PILOTS, _N_WEIGHED = 400, 2000
_AT_ONCE_FROM = 3
# A part of the posterior of the order below is used if it holds the first share, by many particles above the second.
_LEAST_HELD, _MUCH_HELD, _FEW_PARTICLES = 0.005, 0.3, 400
_POOL, _SMALL_POOL = 24_000, 6_000
# All Gaussians may be bright where those of the order below are so with this share.
_BRIGHT_HELD = 0.03
# Moves at each temperature on the way to there, and the share of the particles that it leaves effective: what two
# bright Gaussians hold counts in every order above.
_TWO_BRIGHT, _MORE_BRIGHT = (15, 0.6), (6, 0.4)


def fit_orders_quickly(
    problems: ProblemsByOrder,
    orders: Sequence[int],
    *,
    search: Search,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> tuple[dict[int, OrderPosterior], tuple[str, ...]]:
    """Fit all orders up to the greatest by SMC; `search` fits those whose SMC run is doubtful.

    Return the posterior of each of `orders`, and notes. With fewer than 80 usable readings, or a prior to which SMC
    does not apply, there are no posteriors, and the note says why all orders must be searched in full.
    """
    highest = max(orders)
    n_usable = int(problems.recording.usable.sum())
    if n_usable < _LEAST_READINGS:
        return {}, (f"searched in full: {n_usable} usable readings, fewer than {_LEAST_READINGS}",)
    unlike = _why_smc_does_not_apply(problems, highest)
    if unlike:
        return {}, (unlike,)
    climbing = rng.spawn(1)[0]
    peaks = find_highest_likelihood_peak_by_order(problems.problem, highest, rng=climbing)
    whole = FootprintPlaceAndSize.from_gaussian(peaks[1].theta)
    found: dict[int, OrderPosterior] = {}
    parts: dict[int, PosteriorPart] = {}
    for n in range(1, highest + 1):
        needed = n == 1 or peaks[n].log_likelihood - peaks[n - 1].log_likelihood > _NEEDED
        found[n], parts = fit_next_order(
            problems, n, parts, peaks[n], climbing, whole=whole, needed=needed, search=search, progress=progress
        )
    return _check_chosen_order_or_search_in_full(
        problems, {n: found[n] for n in orders}, climbing, search=search, progress=progress
    ), ()


def _check_chosen_order_or_search_in_full(
    problems: ProblemsByOrder,
    found: dict[int, OrderPosterior],
    rng: np.random.Generator,
    *,
    search: Search,
    progress: Progress | None,
) -> dict[int, OrderPosterior]:
    """Check the chosen order by a search of the prior; if it missed a peak, search it and all orders above in full.

    The orders above may have started from its samples. Where another order is then chosen, it is checked too. Return
    the posteriors by order.
    """
    asked: set[int] = set()
    while True:
        chosen = max(found, key=lambda n: found[n].evidence_result.log_z)
        made = found[chosen].result
        if chosen in asked or not isinstance(made, SMCResult):
            return found
        asked.add(chosen)
        why = search_for_missed_part(problems, chosen, made, rng=rng, progress=progress)
        if why:
            note = f"searched in full, since the quick way missed a peak of order {chosen}: {why}"
            for n in (n for n in found if n >= chosen):
                full = search(n, rng)
                found[n] = replace(full, notes=(*full.notes, f"order {n} was {note}"))


def _why_smc_does_not_apply(problems: ProblemsByOrder, highest: int) -> str:
    """Return in words why SMC does not apply to the priors up to `highest`; "" if it does."""
    priors = [problems.prior_of(n) for n in range(1, highest + 1)]
    if not all(has_uniform_prior_of_light(prior) for prior in priors):
        return "searched in full: the prior of a Gaussian's light is not uniform from 0"
    if any(replace(prior, n_gaussians=1) != priors[0] for prior in priors):
        return "searched in full: the prior of a Gaussian differs from order to order"
    return ""


def fit_next_order(
    problems: ProblemsByOrder,
    n: int,
    below: dict[int, PosteriorPart],
    peak: HighestPeak,
    rng: np.random.Generator,
    *,
    whole: FootprintPlaceAndSize,
    needed: bool,
    search: Search,
    progress: Progress | None,
) -> tuple[OrderPosterior, dict[int, PosteriorPart]]:
    """Fit one Gaussian more than the order below has, by SMC; search the order in full where that is doubtful.

    `n`: the order. `below`: parts of the posterior of n - 1, by number of bright Gaussians; empty for the first order.
    `peak`: highest peak of the likelihood of `n`. `whole`: centre and size of the whole footprint. `needed`: whether
    the readings need the last Gaussian, so that the posterior lies about the peak. `search` searches an order in full.
    `progress` is called with the order after each temperature.

    Return the posterior of the order, and its parts by number of bright Gaussians.
    """
    report: Callable[[TemperatureSummary], None] | None = None if progress is None else partial(progress, n)
    about = partial(_smc_from_peak, problems, n, peak, rng, report)
    from_below = partial(_smc_from_order_below, problems, n, below, peak, whole, rng, report) if below else None
    ways = [about, from_below] if needed else [from_below, about]
    notes: list[str] = []
    for way in ways:
        if way is None:
            continue
        made, parts = way()
        made = _with_doubt_of_missed_peaks(problems, n, made, peak, rng)
        if not made.warnings:
            return OrderPosterior(made, None), parts or split_posterior_by_n_bright(made, rng)
        notes.extend(made.warnings)
    full = search(n, rng)
    note = f"order {n} was searched in full, since the climb to it is doubtful: {'; '.join(dict.fromkeys(notes))}"
    found = replace(full, notes=(*full.notes, note))
    return found, split_posterior_by_n_bright(found.evidence_result, rng)


def _smc_from_peak(
    problems: ProblemsByOrder,
    n: int,
    peak: HighestPeak,
    rng: np.random.Generator,
    report: Callable[[TemperatureSummary], None] | None,
) -> tuple[SMCResult, dict[int, PosteriorPart]]:
    """Sample the posterior of `n`, starting from a density about the peak; return the run, and no parts."""
    problem = problems.problem(n)
    density, n_calls = fit_density_about_peak(problem, peak.theta, rng=rng)
    density = density.widened(_WIDENED)
    nothing = np.empty((_N_PARTICLES, 0))
    clouds = np.zeros(N_CLOUDS)
    # Once more from a density fitted to the samples: it is nearer, and proposes moves that are accepted.
    for n_more in (_FEW_MOVES, _FEW_MOVES if n == 1 else _MANY_MOVES):
        made = run_smc(
            problem,
            density,
            nothing,
            log_z_below=clouds,
            error_below=0.0,
            n_calls_below=n_calls,
            n_steps=_STEPS,
            n_more=n_more,
            rng=rng,
            progress=report,
        )
        density, n_calls = density.fitted_to(made.theta), made.n_calls
    if made.warnings:
        return made, {}
    fitted = density
    drawn = fitted.draw(np.empty((_N_FITTED, 0)), rng=rng)
    log_weight = np.full(_N_FITTED, -np.inf)
    inside = np.flatnonzero(np.isfinite(drawn).all(axis=1))
    log_weight[inside] = problem.log_likelihood(drawn[inside]) - fitted.log_density_over_prior(drawn[inside])
    taken = (made.log_likelihood - fitted.log_density_over_prior(made.theta))[:, None]
    return _with_bridged_evidence(made, clouds, log_weight, taken), {}


def _smc_from_order_below(
    problems: ProblemsByOrder,
    n: int,
    below: dict[int, PosteriorPart],
    peak: HighestPeak,
    whole: FootprintPlaceAndSize,
    rng: np.random.Generator,
    report: Callable[[TemperatureSummary], None] | None,
) -> tuple[SMCResult, dict[int, PosteriorPart]]:
    """Sample each part of the posterior of `n`: those with faint Gaussians, and the one where all are bright.

    Parts with faint Gaussians start from the same part of the order below, a faint Gaussian added. Return the joined
    run, and the parts by number of bright Gaussians.
    """
    tops = [peak.theta, *peak.others]
    about = [fit_density_about_peak(problems.problem(n), theta, rng=rng, n_pilots=_N_PILOTS)[0] for theta in tops]
    bright = count_bright_gaussians(np.array(tops))
    held = evidence_shares(below)
    made: dict[int, SMCResult] = {}
    for m, part in below.items():
        near = tuple(density for density, own in zip(about, bright, strict=True) if own == m)
        if held[m] > _LEAST_HELD:
            many = held[m] > _MUCH_HELD
            made[m] = _smc_with_faint_gaussian_added(
                problems, n, m, part, near, whole, many=many, rng=rng, report=report
            )
    if held.get(n - 1, 0.0) > _BRIGHT_HELD:
        near = tuple(density for density, own in zip(about, bright, strict=True) if own == n)
        made[n] = _smc_with_all_gaussians_bright(problems, n, below[n - 1], near, whole, rng=rng, report=report)
    return join_smc_results_of_parts(made, rng), {m: PosteriorPart.from_smc(climbed) for m, climbed in made.items()}


def _smc_with_faint_gaussian_added(
    problems: ProblemsByOrder,
    n: int,
    n_bright: int,
    below: PosteriorPart,
    about: tuple[PeakDensity, ...],
    whole: FootprintPlaceAndSize,
    *,
    many: bool,
    rng: np.random.Generator,
    report: Callable[[TemperatureSummary], None] | None,
) -> SMCResult:
    """Sample the part of `n` with `n_bright` bright Gaussians; the evidence comes from a bridge to the part `below`.

    Particles start from that part of n - 1 with a faint Gaussian added, and from the densities `about` peaks.
    """
    problem_below = problems.problem(n - 1)
    coordinates = whole.whole_footprint_coordinates(problems.prior_of(n - 1), n_bright)
    rest = below.theta
    n_particles = _N_PARTICLES if many else _FEW_PARTICLES
    few = rest[np.arange(n_particles) * len(rest) // n_particles]
    compensation = CompensatedShapeProposal.from_samples(
        problem_below,
        coordinates,
        problems.problem(1, n_nodes=_FEW_NODES),
        few,
        rng=rng,
        n_pool=_POOL if many else _SMALL_POOL,
    )
    reference: ReferenceDensity = FaintGaussianReferenceDensity(
        problems.prior_of(n), problem_below, compensation, n_bright
    )
    if about:
        reference = MixedReferenceDensity(reference, about, below.log_z)
    made = run_smc(
        problems.problem(n),
        reference,
        few,
        log_z_below=below.log_z_of_clouds,
        error_below=below.start_error,
        rng=rng,
        space=whole.whole_footprint_coordinates(problems.prior_of(n), n_bright),
        at_once_from=_AT_ONCE_FROM,
        progress=report,
    )
    integral = FaintGaussianLikelihoodRatio(problems.prior_of(n), problems.problem(1), n_bright)
    gaussian = problems.prior_of(1).from_unit_cube(rng.random((len(rest), 8)))[:, :6]
    # Any of the n - n_bright faint Gaussians may be the one that is added.
    labels = math.log(n / (n - n_bright))
    log_z = below.log_z_of_clouds + labels
    return _with_bridged_evidence(
        made,
        log_z,
        integral.log_likelihood_ratio_of_added_gaussian(rest, gaussian),
        integral.log_likelihood_ratios_of_faint_gaussians(made.theta),
    )


def _smc_with_all_gaussians_bright(
    problems: ProblemsByOrder,
    n: int,
    below: PosteriorPart,
    about: tuple[PeakDensity, ...],
    whole: FootprintPlaceAndSize,
    *,
    rng: np.random.Generator,
    report: Callable[[TemperatureSummary], None] | None,
) -> SMCResult:
    """Sample the part of the posterior of `n` where all Gaussians are bright.

    Particles start from a wide density made from the samples of `below`, and from the densities `about` peaks.
    """
    space = whole.whole_footprint_coordinates(problems.prior_of(n), n)
    fewer = whole.whole_footprint_coordinates(problems.prior_of(n - 1), n - 1).enter(below.theta)
    reference: ReferenceDensity = AllGaussiansBrightDensity.from_samples_below(space, fewer)
    if about:
        reference = MixedReferenceDensity(reference, about, 0.0)
    n_steps, least_effective = _TWO_BRIGHT if n == 2 else _MORE_BRIGHT
    return run_smc(
        problems.problem(n),
        reference,
        np.empty((_N_PARTICLES if n == 2 else _FEW_PARTICLES, 0)),
        log_z_below=np.zeros(N_CLOUDS),
        error_below=0.0,
        rng=rng,
        space=space,
        n_steps=n_steps,
        n_more=_FEW_MOVES,
        least_effective=least_effective,
        progress=report,
    )


def _with_bridged_evidence(made: SMCResult, log_z: FloatArray, added: FloatArray, taken: FloatArray) -> SMCResult:
    """Return a complete run with the evidence of a bridge, if enough samples are effective; else the run unchanged.

    `log_z`: of the other end of the bridge, per cloud. `added`, `taken`: see `bridge_log_z_ratio`. If the two evidences
    disagree, a run of few temperatures gets a doubt.
    """
    if made.temperatures[-1] < 1.0:
        return made
    ratio, share = bridge_log_z_ratio(added, taken)
    if share < _LEAST_SHARE:
        return made
    # What each cloud adds to the bridge of all (jackknife): by itself a cloud that is stuck would outweigh the others.
    own = np.repeat(np.arange(N_CLOUDS), len(taken) // N_CLOUDS)
    of_added = np.repeat(np.arange(N_CLOUDS), len(added) // N_CLOUDS)
    without = np.array([bridge_log_z_ratio(added[of_added != k], taken[own != k])[0] for k in range(N_CLOUDS)])
    # Samples of the posterior that still drift give another evidence late than early.
    by_time = taken.reshape(N_CLOUDS, N_SNAPSHOTS, -1, taken.shape[1])
    early, late = (half.reshape(-1, taken.shape[1]) for half in np.split(by_time, 2, axis=1))
    drift = bridge_log_z_ratio(added, late)[0] - bridge_log_z_ratio(added, early)[0]
    found = replace(
        made,
        log_z_of_clouds=log_z + N_CLOUDS * ratio - (N_CLOUDS - 1) * without,
        start_error=math.hypot(made.start_error, drift),
    )
    apart = abs(found.log_z - made.log_z)
    if len(made.temperatures) > _AT_ONCE_FROM or not apart > max(
        _DISAGREE * math.hypot(found.log_z_error, made.log_z_error), _APART
    ):
        return found
    words = f"{made.log_z:.2f} ± {made.log_z_error:.2f} by temperatures, {found.log_z:.2f} ± {found.log_z_error:.2f}"
    return replace(found, doubts=(*found.doubts, f"two estimates of ln Z disagree: {words} by a bridge"))


def _with_doubt_of_missed_peaks(
    problems: ProblemsByOrder, n: int, made: SMCResult, peak: HighestPeak, rng: np.random.Generator
) -> SMCResult:
    """Add a doubt to an SMC run without samples about a higher `peak` that holds a fifth of the evidence or more."""
    if made.warnings or peak.log_likelihood - made.log_likelihood.max() < _HIGHER:
        return made
    problem = problems.problem(n)
    density, _ = fit_density_about_peak(problem, peak.theta, rng=rng, n_pilots=_N_PILOTS)
    share = share_missed_about_peak(problem, density, made.theta, made.log_z, n_draws=_N_WEIGHED, rng=rng)
    if share < _MISSED:
        return made
    higher = peak.log_likelihood - float(made.log_likelihood.max())
    words = f"a peak with ln L higher by {higher:.1f} holds at least {share:.0%} of Z, and no samples"
    return replace(made, doubts=(*made.doubts, words))
