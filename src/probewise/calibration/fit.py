"""Calibrate: the evidence of one to four Gaussians, the mean SSF field, the fitted sensor (paper, table and fig. 5)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from numbers import Integral
from pathlib import PurePath

import numpy as np

from probewise._arrays import FloatArray, own_arithmetic
from probewise._display import Reported
from probewise._kinds import checked_whole, require_flag, require_like, require_rng
from probewise.calibration.fields import (
    choose_pixel_mm,
    draw_sd,
    gaussians_sorted_by_mass,
    mixture_moments,
    noise_by_scan,
    posterior_mean_ssf_field,
)
from probewise.calibration.paper import OrderPosterior, ProblemsByOrder, Progress, search_prior_of_order
from probewise.calibration.priors import SSFPrior, blind_axis_rad, default_prior, scan_geometry
from probewise.calibration.quick import fit_orders_quickly
from probewise.calibration.sensor_file import FittedSensor, OrderEvidence
from probewise.errors import DoubtfulResultWarning, ParameterError, require, warn
from probewise.inference import sd_ceiling, sd_floor
from probewise.nested import NestedResult, StopRule, Weighted, least_live
from probewise.recordings import Recording, fingerprint
from probewise.recordings.plan import require_patterns_described, require_recording
from probewise.sensor import SSFField

_N_SAMPLES = 1000
# Ratio of posterior to prior sd above which the recording is not informative.
_UNINFORMED = 0.7


@dataclass(frozen=True, eq=False)
class OrderFit:
    """The fit of an SSF of `n_gaussians` Gaussians: its prior, evidence and posterior `found`, and fitted sensor."""

    n_gaussians: int
    prior: SSFPrior
    found: OrderPosterior
    sensor: FittedSensor

    @property
    def result(self) -> NestedResult | Weighted:
        """The posterior samples: a nested sampling run, or the weighted samples of a quick calibration."""
        return self.found.result

    @property
    def log_z(self) -> float:
        """Natural log of the evidence: the estimate refined by importance sampling if that is reliable."""
        return self.found.evidence_result.log_z

    @property
    def log_z_error(self) -> float:
        """Standard error of the estimate `log_z`."""
        return self.found.evidence_result.log_z_error

    @property
    def field(self) -> SSFField:
        """Weighted mean of the sampled SSF fields."""
        return self.sensor.field


@dataclass(frozen=True, eq=False)
class Calibration(Reported):
    """The fits of all orders that were tried; the evidence chooses one."""

    recording: Recording
    fits: tuple[OrderFit, ...]

    @property
    def chosen(self) -> OrderFit:
        """The fit of the order of greatest evidence."""
        return max(self.fits, key=lambda fit: fit.log_z)

    @property
    def sensor(self) -> FittedSensor:
        """The fitted sensor of the chosen order."""
        return self.chosen.sensor

    @property
    def orders(self) -> tuple[OrderEvidence, ...]:
        """The paper's table: one row per order, with log evidence, its error and parameter counts."""
        return self.sensor.orders

    @property
    def fields(self) -> dict[int, SSFField]:
        """Mean SSF field of each fit, in a dict by order."""
        return {fit.n_gaussians: fit.field for fit in self.fits}

    def summary(self) -> str:
        """Describe the calibration in plain text."""
        return self.sensor.summary()


@own_arithmetic
def calibrate(
    recording: Recording,
    *,
    orders: Sequence[int] = (1, 2, 3, 4),
    n_live: int = 300,
    rng: np.random.Generator,
    quick: bool = False,
    progress: Progress | None = None,
    prior: Callable[[Recording, int], SSFPrior] = default_prior,
    stop: StopRule | None = None,
    refined: bool = True,
    executor: Executor | None = None,
) -> Calibration:
    """Fit SSFs of several orders to a recording and compare their evidences (paper, section 2.7).

    Parameters
    ----------
    recording
        Readings over known patterns.
    orders
        Numbers of Gaussians to try.
    n_live
        Live points of nested sampling, at least two per parameter and ten. With `quick` only the orders whose whole
        prior is searched use them.
    rng
        Source of randomness; spawned for each order.
    quick
        Whether to sample each order from the peaks of its likelihood, upwards until the evidence has clearly fallen,
        with one search of the prior for the chosen order; notes name the orders not tried, or searched in full.
        `probewise.calibrate` does this by default.
    progress
        Called with the order and a `RoundSummary` after every round of nested sampling; not with a process pool.
    prior
        Function that makes the prior from the recording and an order; `paper_prior` is the paper's.
    stop
        When nested sampling ends; default `RemainingEvidence()`. The paper's rule is `EvidenceChange(1e-8)`.
    refined
        Whether to refine each evidence by importance sampling; the paper's is of nested sampling alone.
    executor
        Runs the orders in parallel; by default they run here, one by one. The result does not depend on it.

    Returns
    -------
    Calibration
        With a `sensor` for each order that was fitted; the chosen order has the greatest evidence.

    Raises
    ------
    ParameterError
        If `orders` is empty, a pattern of the recording is not described, the recording has no contrast (see
        `scan_geometry`), a name in it cannot be written to a file, a value is out of its range, or `quick` is asked
        with `refined=False`.

    Warns
    -----
    DoubtfulResultWarning
        If there are fewer usable readings than parameters, or the sampler warns of a doubtful run.
    """
    require_recording(recording)
    require_patterns_described(recording.plan)
    require_rng(rng)
    wanted = _checked_orders(orders)
    checked_whole("n_live", n_live, least=least_live(6 * max(wanted) + 2))
    fingerprint(recording)  # raises now, not after hours, where a file could not hold what the recording does
    if executor is not None:
        require_like("executor", executor, ("submit",), "an Executor of concurrent.futures, or None")
    require_flag("quick", quick)
    require(not quick or refined, "refined", refined, "True with quick=True, or leave quick out")
    problems = ProblemsByOrder(recording, prior)
    search = partial(search_prior_of_order, problems, n_live=n_live, stop=stop, refined=refined, progress=progress)
    streams = dict(zip(wanted, rng.spawn(len(wanted)), strict=True))
    quickly: dict[int, OrderPosterior] = {}
    note = ""
    if quick:
        quickly, note = fit_orders_quickly(problems, wanted, search=search, rng=rng.spawn(1)[0], progress=progress)
        wanted = tuple(n for n in wanted if n in quickly) or wanted
    why = (note,) if note else ()
    each = {n: partial(_fit_order, problems, search, n, streams[n], found=quickly.get(n), why=why) for n in wanted}
    if executor is None:
        fits = [fit() for fit in each.values()]
    else:
        # The costliest order first, so that no worker waits for it at the end.
        running = {n: executor.submit(each[n]) for n in sorted(wanted, reverse=True)}
        fits = [running[n].result() for n in wanted]
    table = tuple(OrderEvidence(fit.n_gaussians, fit.log_z, fit.log_z_error) for fit in fits)
    close = _notes_on_close_evidences(table)
    return Calibration(
        recording,
        tuple(
            replace(fit, sensor=replace(fit.sensor, orders=table, notes=(*fit.sensor.notes, *close))) for fit in fits
        ),
    )


def _checked_orders(orders: object) -> tuple[int, ...]:
    """Return the numbers of Gaussians without duplicates, or raise ParameterError."""
    allowed = "one or more whole numbers from 1, such as (1, 2)"
    if isinstance(orders, str) or not isinstance(orders, Iterable) or getattr(orders, "ndim", 1) == 0:
        raise ParameterError("orders", orders, allowed)
    asked = tuple(orders)
    require(asked and all(isinstance(n, Integral) and int(n) >= 1 for n in asked), "orders", asked, allowed)
    return tuple(dict.fromkeys(int(n) for n in asked))


def _fit_order(
    problems: ProblemsByOrder,
    search: Callable[[int, np.random.Generator], OrderPosterior],
    n_gaussians: int,
    rng: np.random.Generator,
    *,
    found: OrderPosterior | None,
    why: tuple[str, ...],
) -> OrderFit:
    """Fit one order; search its prior if it is not `found` yet, with `why` among the notes; make a sensor of it.

    At module level, so that another process can run it.
    """
    recording, problem, prior = problems.recording, problems.problem(n_gaussians), problems.prior_of(n_gaussians)
    plan, usable, n_usable = recording.plan, recording.usable, int(recording.usable.sum())
    notes: tuple[str, ...] = ()
    if n_usable < len(prior.names):
        notes = (f"{n_usable} usable readings for {len(prior.names)} parameters: the result depends on the prior",)
        warn(notes[0], DoubtfulResultWarning)
    if found is None:
        found = search(n_gaussians, rng)
    notes, result = (*notes, *why, *found.notes), found.result
    samples = gaussians_sorted_by_mass(result.samples(_N_SAMPLES, rng=rng), n_gaussians)
    residuals = recording.readings[usable] - problem.model.predict(samples, plan)[:, usable]
    floor, ceiling = sd_floor(recording), sd_ceiling(recording)
    pixel_mm = choose_pixel_mm(samples, n_gaussians, step_mm=scan_geometry(recording).step_mm)
    theta, weight = (samples, None) if isinstance(result, Weighted) else (result.theta, result.weight)
    blind, silent = blind_axis_rad(recording), _names_of_unconstrained_moments(samples, prior, rng)
    if blind is not None:
        notes = (
            *notes,
            "all edges cross the sensor in one direction: nothing is learnt of the SSF along "
            f"{math.degrees(blind):.3g} degrees in its frame; there the posterior is the prior",
        )
    elif silent:
        notes = (*notes, f"the recording says little about {', '.join(silent)}: there the posterior is the prior")
    if n_usable < len(plan):
        notes = (*notes, f"{len(plan) - n_usable} of {len(plan)} readings missing or out of range, left out")
    sensor = FittedSensor(
        names=prior.names,
        samples=samples,
        n_gaussians=n_gaussians,
        noise_sd=draw_sd(residuals, sd_floor=floor, sd_ceiling=ceiling, rng=rng),
        field=posterior_mean_ssf_field(theta, n_gaussians, pixel_mm=pixel_mm, weight=weight),
        instrumentation=plan.instrumentation,
        scan_noise=noise_by_scan(
            residuals, plan.scan[usable], plan.scan_names, sd_floor=floor, sd_ceiling=ceiling, rng=rng
        ),
        fingerprint=fingerprint(recording),
        source=PurePath(recording.source).name,
        priors=prior.table_rows(),
        notes=(*notes, *result.warnings),
    )
    return OrderFit(n_gaussians, prior, found, sensor)


def _names_of_unconstrained_moments(samples: FloatArray, prior: SSFPrior, rng: np.random.Generator) -> tuple[str, ...]:
    """Return the names of the moments (centre, widths, correlation) whose posterior sd exceeds 0.7 of the prior's."""
    before = mixture_moments(prior.from_unit_cube(rng.random((2000, len(prior.names)))), prior.n_gaussians)
    after = mixture_moments(samples, prior.n_gaussians)
    return tuple(
        name.removeprefix("log ") for name in after if np.std(after[name]) > _UNINFORMED * np.std(before[name])
    )


def _notes_on_close_evidences(table: tuple[OrderEvidence, ...]) -> tuple[str, ...]:
    """Return one note if the evidences of the two best orders agree within two errors, else none."""
    if len(table) < 2:
        return ()
    first, second = sorted(table, key=lambda order: -order.log_z)[:2]
    lead, error = first.log_z - second.log_z, math.hypot(first.log_z_error, second.log_z_error)
    if lead > 2 * error:
        return ()
    return (
        f"orders {first.n_gaussians} and {second.n_gaussians} are too close to call: "
        f"log evidence differs by {lead:.2f} ± {error:.2f}",
    )
