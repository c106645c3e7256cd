"""Effects on the noise, single faulty readings and undeclared rounding among them."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from probewise._arrays import ROUNDING, TINY, FloatArray, varies
from probewise._words import unit_after_number, value_with_sd
from probewise.effects.effect import (
    Act,
    Declared,
    Effect,
    LightEffect,
    NoiseEffect,
    Say,
    acting,
    in_words,
    light_effect,
)
from probewise.effects.noise_distribution import FittedReadings
from probewise.effects.reference import Extent
from probewise.priors import LogHeavyTailedPrior, LogUniform, Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import NoiseParameters, Stage

_SPREADS = (0.1, 0.2, 0.4, 0.8, 1.6)  # hyperprior, equal weights: sds between runs of the logarithm of a run's sd
_NEWTON_STEPS = 40
_NEAR_END = 1e-4  # of the range of a lost reading's value: distance of the bank's values from its ends
_TELLING = 15.0  # least ratio of a lattice's step to the rounding of the printed values
_FINE = 1e-2  # of the range
_FINEST = 1e-5  # of the range: the least step of a lattice that is looked for
_ON_A_LINE = 5  # least distinct values of a column that is the readings in another unit
_DIGITS = 1e-6  # of a step, a range or a noise sd: below this a difference is rounding
_N_SHARES = 12


def _on_noise(
    kind: LightEffect, of: Extent, parameters: Declared, act: Act, says: Say, n_nodes: tuple[int, ...] = (10,), *,
    from_prior: bool = True,
    **more: Any,
) -> Effect:  # fmt: skip
    """Return an effect with nodes of its prior: midpoints of `n_nodes` equal shares along each parameter."""
    axes = [(np.arange(n) + 0.5) / n for n in n_nodes]
    u = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, len(axes))
    entries = Product({name: prior for name, (prior, _) in parameters.items()}).from_unit_cube(u)[:, None, :]
    more = {"amplitudes": (0,), "nodes_per_parameter": n_nodes if from_prior else (), **more}
    return kind.bind(of, parameters, act, says, entries, kind=NoiseEffect, **more)


SD_FACTORS = LogUniform(0.25, 6.0)  # prior of the noise sd since the calibration, in units of the sd then


@light_effect(
    "noise_sd",
    Stage.NOISE,
    "noise of another size than at the calibration",
    ("level", "time"),
    is_absorbed_by_ssf=lambda plan: True,  # with the SSF the sd is free too
)
def noise_sd(kind: LightEffect, of: Extent) -> Effect:
    """Noise of another size than at the calibration: sd x factor."""
    return _on_noise(
        kind,
        of,
        {"factor": (SD_FACTORS, "1")},
        lambda noise, theta, plan: replace(noise, sd=noise.sd * theta[:, :1]),
        in_words("the sd of the noise is {0} times that at the calibration"),
        (12,),
        from_prior=False,  # the readings' sd tells the factor: `diagnosis.noise.SdPrior`
        amplitudes=(),
        absent={0: 1.0},
    )


@light_effect("correlated_noise", Stage.NOISE, "correlated noise", ("scan",))
def correlated_noise(kind: LightEffect, of: Extent) -> Effect:
    """Correlated noise, AR(1) within a scan: e_k = rho e_(k-1) + new noise."""
    says = "the noise of successive readings has correlation {0}: part of each error returns in the next reading"
    n = (28,)  # dense enough to integrate the posterior of a thousand readings
    act = acting(lambda noise, plan, rho: replace(noise, rho=rho))
    return _on_noise(kind, of, {"rho": (Uniform(-0.5, 0.95), "1")}, act, in_words(says), n)


@light_effect("signal_dependent_noise", Stage.NOISE, "noise that grows with the signal", ("level",))
def signal_dependent_noise(kind: LightEffect, of: Extent) -> Effect:
    """Noise that grows with the light: variance x (1 + ratio u), u the seen white fraction."""

    def says(mean: FloatArray, sd: FloatArray) -> str:
        times = f"its variance at the highest level is {value_with_sd(1 + mean[0], sd[0])} times that at the lowest"
        return f"the noise grows with the reading: {times}"

    act = acting(lambda noise, plan, r: replace(noise, sd=noise.sd * np.sqrt(1 + r * np.clip(noise.seen, 0, 1))))
    return _on_noise(kind, of, {"ratio": (LogUniform(0.05, 50.0), "1")}, act, says)


@light_effect("drifting_noise", Stage.NOISE, "noise that changes in time", ("time",))
def drifting_noise(kind: LightEffect, of: Extent) -> Effect:
    """Noise whose sd grows or shrinks exponentially in time: sd x growth^(time / duration - 1/2).

    The effect is outside the vocabulary: a nuisance that keeps the tests of the mean valid. Time counts from the first
    reading to the last of the plan; no repaired model holds it, so that it never acts on another plan than the
    recording's.
    """

    def act(noise: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        elapsed = (plan.time_s - plan.time_s.min()) / (float(np.ptp(plan.time_s)) or 1.0)
        return replace(noise, sd=noise.sd * theta[:, :1] ** (elapsed - 0.5))

    says = in_words("the sd of the noise at the end is {0} times that at the start")
    return _on_noise(kind, of, {"growth": (LogUniform(0.2, 5.0), "1")}, act, says)


@light_effect("random_walk", Stage.NOISE, "a random walk of the zero", ("time", "row", "run"))
def random_walk(kind: LightEffect, of: Extent) -> Effect:
    """A random walk of the offset of a table's readings: a normal step from each row to the next, across runs too."""
    says = in_words("the offset is a random walk with steps of sd {0} noise sds from row to row")
    act = acting(lambda noise, plan, walk: replace(noise, walk=walk))
    return _on_noise(kind, of, {"sd_per_row": (LogUniform(5e-3, 3.0), "noise sd")}, act, says, (16,))


@light_effect("noise_per_run", Stage.NOISE, "noise that differs from run to run", ("run",))
def noise_per_run(kind: LightEffect, of: Extent) -> Effect | None:
    """Noise that differs between runs: sd x the run's value, whose logarithm has a heavy-tailed prior."""
    names, run = tuple(of.plan.scan_names), of.plan.scan
    return noise_of_runs(names, np.bincount(run, minlength=len(names))) if len(names) > 1 else None


def noise_of_runs(runs: tuple[str, ...], n_rows: Any = 1) -> NoiseEffect:
    """Return the effect of noise that differs between runs of these names.

    `n_rows` (n_runs,) are the numbers of readings from which each run's value was estimated, where that counts.
    """
    known, widths = {name: k for k, name in enumerate(runs)}, 1 / np.sqrt(2 * np.maximum(n_rows, 1))

    def act(noise: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        at = np.array([known.get(name, len(runs)) for name in plan.scan_names])
        values = np.concatenate([theta, np.ones((len(theta), 1))], axis=1)
        return replace(noise, sd=noise.sd * values[:, at[plan.scan]])

    def says(mean: FloatArray, sd: FloatArray) -> str:
        low, high = int(np.argmin(mean)), int(np.argmax(mean))
        most, least = value_with_sd(mean[high], sd[high]), value_with_sd(mean[low], sd[low])
        there = f"{most} times the typical one in run {runs[high]} and {least} times in run {runs[low]}"
        return f"the noise differs from run to run: its sd is {there}"

    return NoiseEffect(
        noise_per_run.name,
        noise_per_run.stage,
        {f"values[{run}]": LogHeavyTailedPrior(0.3) for run in runs},
        ("1",) * len(runs),
        noise_per_run.covariates,
        act,
        np.ones((1, 1, len(runs))),
        says,
        amplitudes=(),
        absent=dict.fromkeys(range(len(runs)), 1.0),
        nodes_about=partial(_likeliest_run_values, len(runs)),
        draws_about=lambda nodes, rng: np.asarray(nodes * np.exp(widths * rng.standard_normal(nodes.shape))),
    )


def _likeliest_run_values(n_runs: int, residuals: FloatArray, rows: FittedReadings) -> tuple[FloatArray, FloatArray]:
    """Return the runs' most probable values, (n_nodes, n_runs), and log Laplace weights, (n_nodes,).

    There is one node for each of five assumed sds, between runs, of the values' logs; none for a single run.
    """
    counts = np.bincount(rows.run, minlength=n_runs).astype(np.float64)
    squares: FloatArray = np.bincount(rows.run, residuals**2, minlength=n_runs).astype(np.float64)
    if n_runs < 2 or not (squares > 0).any():
        return np.zeros((0, n_runs)), np.zeros(0)
    values, log_weights = [], []
    for spread in _SPREADS:
        logs = _most_probable_log_sd_ratios(counts, squares, spread)
        curvature = 2 * counts + spread**-2
        # The overall sd is integrated elsewhere, at fixed values: `beside` corrects for its coupling to them.
        beside = float(np.sum(2 * counts * spread**-2 / curvature)) / float(2 * counts.sum())
        log_prior = -0.5 * float(np.sum((logs / spread) ** 2)) - n_runs * np.log(spread)
        log_weights.append(log_prior - 0.5 * float(np.log(curvature).sum() + np.log(beside)))
        values.append(np.exp(logs))
    return np.array(values), np.array(log_weights) - np.log(len(_SPREADS))


def _most_probable_log_sd_ratios(counts: FloatArray, squares: FloatArray, spread: float) -> FloatArray:
    """Return the most probable logs of each run's noise sd over the overall sd, (n_runs,); the latter is profiled out.

    `counts` and `squares` are the number of readings and the sum of squared residuals of each run, (n_runs,); `spread`
    is the prior sd of the logs.
    """
    logs = np.zeros(len(counts))
    for _ in range(_NEWTON_STEPS):
        weighed = squares * np.exp(-2 * logs)
        share = weighed * counts.sum() / weighed.sum()  # sums of squares in units of the best overall variance
        slope = share - counts - logs / spread**2
        curvature = 2 * share + spread**-2
        # Profiling out the overall sd takes a rank-one term from the Hessian: Sherman-Morrison inverts it.
        along, turned = 2 * share / curvature, slope / curvature
        step = turned - along * float(np.sum(2 * share * turned)) / (-float(2 * share.sum()) + float(2 * share @ along))
        logs = logs + np.clip(step, -1.0, 1.0)
        if np.abs(step).max() < ROUNDING:
            break
    return np.asarray(logs)


FAR = 4.0  # noise sds from its prediction beyond which a reading may be lost rather than noisy

LARGEST_SIZE = 40.0
"""Largest sd of outlying readings, in noise sds; readings too far out for it are lost ones (`diagnosis.outlying`)."""


MOST_OUTLYING = 0.2  # largest share of outlying or of lost readings


_SHARES = LogUniform(2e-3, MOST_OUTLYING)


@light_effect("outliers", Stage.NOISE, "outlying readings", ("level", "time"))
def outliers(kind: LightEffect, of: Extent) -> Effect:
    """A heavy tail: with probability `share`, a reading's noise is `size` times as wide (sd)."""
    says = in_words("outliers: {0} % of the readings scatter {1} times as widely as the others", factors=(100,))
    act = acting(lambda noise, plan, share, size: replace(noise, wide_share=share, wide_times=size))
    parameters = {"share": (_SHARES, "1"), "size": (LogUniform(2.5, LARGEST_SIZE), "noise sd")}
    return _on_noise(kind, of, parameters, act, says, (4, 4))


@light_effect("dropouts", Stage.NOISE, "lost readings", ("level", "time"))
def dropouts(kind: LightEffect, of: Extent) -> Effect:
    """Lost readings: with probability `share` a reading is `value`, whatever lies under the sensor."""
    low, high, ends = of.low - 0.01 * of.span, of.high + 0.01 * of.span, of.plan.instrumentation.declared_ends
    return _dropouts(low, high, of.reading_unit, nodes_about=partial(_commonest_far_value, ends))


def readings_lost_beyond_doubt(lost: FloatArray, n_readings: int, distance: float, unit: str) -> NoiseEffect:
    """Return the effect that lost these of `n_readings` readings; where they differ, `value` is any of theirs.

    They are left out of the recording, so that the noise of the others does not change. `distance` is the norm of their
    residuals in noise sds.
    """
    wide = 0.01 * max(float(np.ptp(lost)), float(np.abs(lost).max()), TINY)
    values = tuple(lost.tolist())
    low, high = float(lost.min()) - wide, float(lost.max()) + wide
    return _dropouts(
        low,
        high,
        unit,
        values,
        nodes_about=partial(_commonest_far_value, ()),
        draws_about=partial(_drawn_share_and_value, values, n_readings),
        known=np.array([len(values) / n_readings, max(values, key=values.count)]),
        distance=distance,
    )


def _dropouts(low: float, high: float, unit: str, lost: tuple[float, ...] = (), **more: Any) -> NoiseEffect:
    near = _NEAR_END * (high - low)
    return NoiseEffect(
        dropouts.name,
        dropouts.stage,
        {"share": _SHARES, "value": Uniform(low, high)},
        ("1", "reading"),
        dropouts.covariates,
        _lose_readings,
        np.array([[[share, end]] for share in (0.01, 0.05) for end in (low + near, high - near)]),
        partial(_dropouts_in_words, lost, unit),
        **more,
    )


def _lose_readings(noise: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
    return replace(noise, lost_share=theta[:, :1], lost_value=theta[:, 1:2])


def _commonest_far_value(
    ends: tuple[float, ...], residuals: FloatArray, rows: FittedReadings
) -> tuple[FloatArray, FloatArray]:
    """Return twelve pairs (share, value), (12, 2), with the commonest value of readings beyond four noise sds.

    There is no node, (0, 2), unless an outlying value occurs twice or is one of the `ends` of the declared range, its
    likeliest values. Log weights are equal.
    """
    far = rows.readings[np.abs(residuals) > FAR]
    # Floats differ in their last digits, so the value is one of the readings, not their mean.
    n_alike = (np.abs(far[:, None] - far) <= _DIGITS * rows.sd).sum(axis=0)
    at_end = (np.abs(far[:, None] - np.array(ends)) <= _DIGITS * rows.sd).any(axis=1)
    if not (at_end | (n_alike > 1)).any():
        return np.zeros((0, 2)), np.zeros(0)
    value = far[int(np.argmax(n_alike + 0.5 * at_end))]
    shares = _SHARES.from_unit((np.arange(_N_SHARES) + 0.5) / _N_SHARES)
    return np.stack([shares, np.full(_N_SHARES, value)], axis=1), np.full(_N_SHARES, -np.log(_N_SHARES))


def _drawn_share_and_value(
    lost: tuple[float, ...], n_readings: int, nodes: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Draw the share that the number of `lost` readings tells (Jeffreys prior), and one of their values."""
    n, n_lost = len(nodes), len(lost)
    share = rng.beta(n_lost + 0.5, n_readings - n_lost + 0.5, n)
    return np.stack([share, rng.choice(lost, n)], axis=1)


def _dropouts_in_words(lost: tuple[float, ...], unit: str, mean: FloatArray, sd: FloatArray) -> str:
    exact = f"{mean[1]:z.12g} {unit}".rstrip()  # lost readings have one value, to the last digit
    value = value_with_sd(mean[1], sd[1], unit) if sd[1] > 0 else exact
    share = value_with_sd(mean[0], sd[0], factor=100)
    if len({*lost}) > 1:
        values = [f"{each:.12g}" for each in sorted({*lost})]
        value = f"{', '.join(values[:-1])} or {values[-1]} {unit}".rstrip()
    return f"readings are lost: {share} % of them read {value}, whatever the true value"


def _rounding_in_words(unit: str, mean: FloatArray, sd: FloatArray) -> str:
    """Write the step without an sd: readings on a lattice tell it to the last digit."""
    size = f"{mean[0]:.4g} {unit}".rstrip()
    return f"the readings are rounded to steps of {size}, which were not declared"


ROUNDING_SEEN_ABOVE = 0.3  # smallest step, in noise sds, that counts: a finer lattice is only the printing of digits


@light_effect("quantisation", Stage.NOISE, "rounded readings", ("lattice",))
def quantisation(kind: LightEffect, of: Extent) -> Effect | None:
    """Readings rounded to a step that was not declared: step round(reading / step), after the noise."""
    if of.plan.instrumentation.step is not None:
        return None
    step, act = LogUniform(1e-3 * of.span, 0.2 * of.span), acting(lambda noise, plan, step: replace(noise, step=step))
    says = partial(_rounding_in_words, unit_after_number(of.reading_unit))
    return _on_noise(kind, of, {"step": (step, "reading")}, act, says, (16,), from_prior=False)  # from the readings


def sd_of_rounding(step: float) -> float:
    """Return the sd of the error of rounding to a step."""
    return step / math.sqrt(12)


def lattice_step(readings: FloatArray) -> float:
    """Find the step of a lattice that holds all readings; 0 where there is none.

    The result is 0 also for a step below 1e-5 of the range, and for fewer than three distinct readings. Readings
    printed to some digits lie on a lattice too; a coarser lattice is found through it, since printing moves each value
    by at most half a digit.
    """
    values = np.unique(readings[np.isfinite(readings)])
    if len(values) < 3:
        return 0.0
    least = _DIGITS * float(values[-1] - values[0])
    exact = _greatest_common_step(values, least)
    return _step_of_rounded_lattice(values, exact or 10 * least) or exact


SAYS_THE_SAME = "it is the reading in another unit, and cannot be what the reading depends on"


def says_what_readings_say(values: FloatArray, readings: FloatArray) -> bool:
    """Return whether a column is the readings in another unit, (n_points,) both: on a line, but for printed digits.

    Such a column holds the noise of the readings, too, so it cannot be what they depend on: its digits are finer than
    the gaps between its values, which tells it from a dial in even steps on which they depend. Five of its values must
    differ, and it must resolve a hundredth of their range.
    """
    there = np.isfinite(values) & np.isfinite(readings)
    x, y = values[there], readings[there]
    distinct = np.unique(x)
    if len(distinct) < _ON_A_LINE or not varies(y) or 2 * lattice_step(x) > np.median(np.diff(distinct)):
        return False
    x = (x - x.mean()) / np.ptp(x)
    slope = float(x @ (y - y.mean()) / (x @ x))
    off = float(np.abs(y - y.mean() - slope * x).max())
    if off > _FINE * np.ptp(y):
        return False
    digits = lattice_step(y) + abs(slope) * lattice_step(x) + _FINEST * float(np.ptp(y))
    return off <= 0.75 * digits  # half a digit, and what the line is off


def sd_of_estimated_lattice_step(readings: FloatArray, step: float) -> float:
    """Estimate the sd of a lattice's step, as fitted to distinct readings that were printed to some digits.

    The result is the printing's rounding error (sd) over the norm of the readings' centred lattice numbers; at least a
    millionth of the step.
    """
    values = np.unique(readings[np.isfinite(readings)])
    first = max(math.floor(-math.log10(step)), 0)  # the digits are no coarser than the step, which may be tiny
    fits = (np.allclose(values, np.round(values, n), rtol=0, atol=_DIGITS * 10.0**-n) for n in range(first, first + 10))
    digit = next((10.0**-n for n, fit in enumerate(fits, first) if fit), 0.0)
    reach = float(np.linalg.norm(values - values.mean())) / step
    is_printing = digit > (1 - _DIGITS) * step  # whole numbers are a lattice of exactly 1
    return max(0.0 if is_printing else sd_of_rounding(digit) / reach, _DIGITS * step)


def _step_of_rounded_lattice(values: FloatArray, rounding: float) -> float:
    """Fit the step of a lattice to rounded values, from the two closest outwards; 0 if one of them is off the lattice.

    `rounding` is the full width of the rounding error of each value.
    """
    gaps = np.diff(values)
    step, start = float(gaps.min()), float(values[np.argmin(gaps)])
    if step <= _TELLING * rounding:
        return 0.0
    reach, known = 0.0, 1.0  # distance up to which values are numbered, and how many steps the last fit spanned
    while reach < values[-1] - values[0]:
        further = 0.2 * step / rounding * known * step  # up to here every value's number is certain
        near = values[np.abs(values - start) <= further]
        if further <= reach or len(near) < 2:
            return 0.0
        number = np.round((near - start) / step)
        reach, known = further, max(float(np.ptp(number)), 1.0)
        step, start = np.polyfit(number, near, 1).tolist()
    off = np.abs(values - start - step * np.round((values - start) / step))
    return step if float(off.max()) <= 0.75 * rounding else 0.0


def _greatest_common_step(values: FloatArray, tolerance: float) -> float:
    """Find the greatest step of which all gaps of sorted values are multiples; 0 if at most ten times the tolerance."""
    step = 0.0
    for gap in np.diff(values):
        larger, smaller = max(step, float(gap)), min(step, float(gap))
        while smaller > tolerance:
            rest = larger - smaller * round(larger / smaller)
            larger, smaller = smaller, abs(rest)
        step = larger
        if step <= 10 * tolerance:
            return 0.0
    return step
