"""Forms on the reading: offsets, gains, lag, delay, hysteresis, bend, saturation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.polynomial.chebyshev import chebfit, chebval

from probewise._arrays import BoolArray, FloatArray, distinct_values, rounding_error, varies
from probewise._words import value_with_sd
from probewise.priors import LogUniform, Uniform
from probewise.sensor import Stage
from probewise.systems.forms import modulations
from probewise.systems.forms.about import ReferenceFit
from probewise.systems.forms.form import Act, Form
from probewise.systems.forms.lags import late_forms
from probewise.systems.forms.modulations import Modulation
from probewise.systems.table import RunTable

_N_SIZES = 9
_BEND_DEGREE = 4
_OUTLYING = 5.0  # medians of the residual's size


def modulated_form(
    about: ReferenceFit,
    name: str,
    stage: Stage,
    how: Modulation,
    act: Act,
    guess: float,
    what: str,
    unit: str,
    covariates: tuple[str, ...] = (),
) -> Iterator[Form]:
    """Yield the form by which a quantity varies over the rows as `how`, applied by `act`; none if without effect."""
    entries = how.entries(guess)
    typical = about.typical_amplitude(stage, act, entries, guess, how.amplitudes)
    if typical is not None and np.isfinite(typical) and typical > 0:
        form = Form(
            name,
            stage,
            marginals=how.marginals(about.amplitude_prior(typical)),
            units=how.units(unit),
            covariates=(*how.covariates, *covariates),
            act=act,
            entries=how.entries(typical),
            amplitudes=how.amplitudes,
            says=lambda mean, sd: how.says(what, unit, mean, sd),
            change_points=how.change_points,
            joined=how.joined,
            counted_from=how.counted_from,
            suggested=how.suggested(typical),
            shared_scale=how.shared_scale,
        )
        # All runs may differ about as much, or one of them alone by far more than the others.
        yield replace(form, alternatives=(replace(form, shared_scale=False),)) if form.shared_scale else form


def forms_on_readings(about: ReferenceFit) -> Iterator[Form]:
    """Yield every form of the reading that could be detectable in this table."""
    table, unit, zero = about.table, about.reading_unit, about.system.simulator.noise.zero
    reading = about.system.simulator.reading
    span = float(np.ptp(about.predicted)) or about.sd
    over: dict[str, Modulation] = {}
    if table.has_varying_time:
        over["drift"] = modulations.linear_drift_modulation(table, about.time_unit)
    over["step"] = modulations.change_point_step_modulation(table, about.time_unit, gated=True)
    if about.can_fit_value_per_run:
        over["per_run"] = modulations.value_per_run_modulation(table)
    for kind, how in over.items():
        yield from modulated_form(
            about,
            f"offset_{kind}",
            stage=Stage.OFFSET,
            how=how,
            act=_reading_adder(how),
            guess=about.sd,
            what=reading,
            unit=unit,
        )
        yield from modulated_form(
            about,
            f"gain_{kind}",
            stage=Stage.GAIN,
            how=how,
            act=_reading_scaler(how, zero),
            guess=about.sd / span,
            what=f"the gain of {reading}",
            unit="1",
            covariates=("level",),
        )
    if table.has_varying_time:
        how = modulations.sinusoid_modulation(about)
        yield from modulated_form(
            about,
            "interference",
            stage=Stage.OFFSET,
            how=how,
            act=_reading_adder(how),
            guess=about.sd,
            what=reading,
            unit=unit,
        )
        yield from _settling_form(about)
        yield from late_forms(about)
    for name, values in table.covariates.items():
        if name not in (reading, about.system.simulator.noise.sd) and varies(values):
            how = modulations.column_proportional_modulation(name, table)
            yield from modulated_form(
                about,
                f"sensitivity:{name}",
                stage=Stage.OFFSET,
                how=how,
                act=_reading_adder(how),
                guess=about.sd,
                what=reading,
                unit=unit,
            )
    yield from _hysteresis_form(about)
    yield from _nonlinearity_form(about)
    yield from _saturation_form(about)


def _reading_adder(how: Modulation) -> Act:
    return lambda value, theta, table: value + how.at_rows(theta, table)


def _reading_scaler(how: Modulation, zero: float) -> Act:
    return lambda value, theta, table: zero + (value - zero) * (1 + how.at_rows(theta, table))


def time_since_start_of_run(table: RunTable) -> FloatArray:
    """Return the time since the first row of each row's run, (n_points,)."""
    first = np.array([table.time_s[rows].min() if rows.size else 0.0 for rows in table.rows_by_scan()])
    return np.asarray(table.time_s - first[table.scan])


def settling_time_prior(about: ReferenceFit) -> LogUniform:
    """Return the log-uniform prior of a settling time constant, from half a gap between rows to twice the longest run.

    It begins at a hundredth of the longest run if that is less.
    """
    longest = float(time_since_start_of_run(about.table).max()) or 1.0
    return LogUniform(min(0.5 * about.median_gap, 0.01 * longest), 2 * longest)


def _settling_form(about: ReferenceFit) -> Iterator[Form]:
    def act(value: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
        return np.asarray(value + theta[:, :1] * np.exp(-time_since_start_of_run(table) / theta[:, 1:2]))

    prior = settling_time_prior(about)
    taus = np.geomspace(prior.low * 1.5, 0.5 * prior.high, _N_SIZES)
    entries = np.stack([np.full(_N_SIZES, 1.0), taus], axis=-1)[:, None, :]
    typical = about.typical_amplitude(Stage.OFFSET, act, entries, 1.0)
    if typical is None:
        return
    entries[:, :, 0] = typical
    unit, time_unit, reading = about.reading_unit, about.time_unit, about.system.simulator.reading
    yield Form(
        "settling",
        Stage.OFFSET,
        marginals={"a": about.amplitude_prior(typical), "tau_s": prior},
        units=(unit, time_unit),
        covariates=("time", "run"),
        act=act,
        entries=entries,
        amplitudes=(0,),
        says=lambda mean, sd: (
            f"{reading} is off by {value_with_sd(mean[0], sd[0], unit)} at the start of each run, and settles "
            f"with a time constant of {value_with_sd(mean[1], sd[1], time_unit)}"
        ),
    )


def sign_of_change(values: FloatArray, table: RunTable) -> FloatArray:
    """Return the sign of the change from the previous row of the run, (n_samples, n_points).

    Where values do not change, the sign of the last change holds; before a run's first change, the sign of that one.
    """
    out, still = np.zeros_like(values), rounding_error(values, axis=1)
    for rows in table.rows_by_scan():
        if len(rows) < 2:
            continue
        changes = np.diff(values[:, rows], axis=1)
        signs = np.where(np.abs(changes) > still, np.sign(changes), 0.0)
        number = np.where(signs != 0, np.arange(signs.shape[1]), -1)
        last = np.maximum.accumulate(number, axis=1)
        first = np.argmax(signs != 0, axis=1)
        last = np.where(last < 0, first[:, None], last)
        own = np.take_along_axis(signs, last, axis=1)
        out[:, rows[1:]] = own
        out[:, rows[0]] = own[:, 0]
    return out


def _hysteresis_form(about: ReferenceFit) -> Iterator[Form]:
    def act(value: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
        return np.asarray(value + theta[:, :1] * sign_of_change(value, table))

    if np.ptp(sign_of_change(about.predicted[None, :], about.table)) == 0:
        return
    unit, reading = about.reading_unit, about.system.simulator.reading
    yield Form(
        "hysteresis",
        Stage.HYSTERESIS,
        marginals={"a": about.amplitude_prior(about.sd)},
        units=(unit,),
        covariates=("previous",),
        act=act,
        entries=np.full((1, 1, 1), about.sd),
        amplitudes=(0,),
        says=lambda mean, sd: (
            f"{reading} reads {value_with_sd(2 * abs(mean[0]), 2 * sd[0], unit)} {'more' if mean[0] > 0 else 'less'} "
            "while it rises than while it falls"
        ),
    )


def _expected_range_of_readings(about: ReferenceFit) -> tuple[float, float]:
    """Return the least and the largest reading to be expected in the table, without noise."""
    bent = _expected_readings_and_inliers(about)[0]
    return float(bent.min()), float(bent.max())


def _expected_readings_and_inliers(about: ReferenceFit) -> tuple[FloatArray, BoolArray]:
    """Return the readings to be expected, (n_points,), and the mask of the readings that are no outliers from these.

    Expected are the predicted readings, bent as the recorded ones are: by a polynomial in the predicted reading, fitted
    to the residuals. Without it a law that lacks a bend misses the ends of the range by many noise sds.
    """
    predicted, readings = about.predicted, about.table.columns[about.system.simulator.reading]
    low, high = float(predicted.min()), float(predicted.max())
    there = np.isfinite(readings)
    degree = min(_BEND_DEGREE, distinct_values(predicted[there]).size - 1)
    if not low < high or degree < 1:
        return predicted, there
    level, residual = 2 * (predicted - low) / (high - low) - 1, readings - predicted
    bend = np.zeros(1)
    for _ in range(3):  # the last two without outlying residuals
        bend = chebfit(level[there], residual[there], degree)
        off = np.abs(residual - chebval(level, bend))
        there = np.isfinite(readings) & (off <= _OUTLYING * max(np.nanmedian(off), about.sd))
    return predicted + chebval(level, bend), there


def _nonlinearity_form(about: ReferenceFit) -> Iterator[Form]:
    low, high = _expected_range_of_readings(about)
    if not low < high:
        return

    def act(value: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
        share = (value - low) / (high - low)
        bent = np.sign(share) * np.abs(share) ** theta[:, 1:2]
        return np.asarray(value + theta[:, :1] * (high - low) * (bent - share))

    powers = np.array([0.5, 1.5, 2.0, 3.0, 4.0])
    entries = np.stack([np.full(len(powers), 1.0), powers], axis=-1)[:, None, :]
    guess = about.sd / (high - low)
    entries[:, :, 0] = guess
    typical = about.typical_amplitude(Stage.BEND, act, entries, guess)
    if typical is None:
        return
    entries[:, :, 0] = typical
    unit, reading = about.reading_unit, about.system.simulator.reading
    yield Form(
        "nonlinearity",
        Stage.BEND,
        marginals={"a": about.amplitude_prior(typical), "power": LogUniform(0.4, 5.0)},
        units=("1", "1"),
        covariates=("level",),
        act=act,
        entries=entries,
        amplitudes=(0,),
        says=lambda mean, sd: (
            f"{reading} has a bent response, y + a (hi - lo) (z^power - z) with z from 0 at {low:.4g} to 1 at "
            f"{high:.4g} {unit}, a = {value_with_sd(mean[0], sd[0], '')}, power = {value_with_sd(mean[1], sd[1], '')}"
        ),
    )


def _saturation_form(about: ReferenceFit) -> Iterator[Form]:
    low, high = float(about.predicted.min()), float(about.predicted.max())
    if not low < high:
        return
    # One wild reading would move the middle of the range, which tells a ceiling from a floor.
    readings = about.table.columns[about.system.simulator.reading][_expected_readings_and_inliers(about)[1]]
    lowest, highest = about.system.simulator.noise.ends
    within = (readings >= lowest) & (readings <= highest)
    # Outside the declared range are no readings of the quantity, such as 9999 for an error.
    least, most = (float(end(readings[within] if within.any() else readings)) for end in (np.min, np.max))

    # Clipped readings end at the limit: a limit in the upper half of their range is a ceiling, in the lower half a
    # floor.
    middle = 0.5 * (least + most)

    def clip(value: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
        level = theta[:, :1]
        return np.where(level > middle, np.minimum(value, level), np.maximum(value, level))

    top, bottom = max(high, most), min(low, least)
    span = top - bottom
    depths = np.geomspace(0.005, 0.9, 16)
    ceilings, floors = top - span * depths, bottom + span * depths
    levels = np.concatenate([ceilings[ceilings > middle], floors[floors < middle]])
    if not levels.size:
        return
    unit, reading = about.reading_unit, about.system.simulator.reading
    yield Form(
        "saturation",
        Stage.SATURATION,
        marginals={"level": Uniform(bottom - 0.02 * span, top + 0.02 * span)},
        units=(unit,),
        covariates=("level",),
        act=clip,
        entries=levels[:, None, None],
        amplitudes=(),
        says=lambda mean, sd: (
            f"{reading} {'rises' if mean[0] > middle else 'falls'} no further than "
            f"{value_with_sd(mean[0], sd[0], unit)}"
        ),
        absent={0: float(top + 1e3 * span)},
    )


WORDS = {
    "offset_step": "a jump of all readings",
    "gain_step": "a jump of the readings' gain",
    "offset_per_run": "an offset of its own in each run",
    "gain_per_run": "a gain of its own in each run",
    "delay": "readings that come late",
    "settling": "readings that settle at the start of each run",
    "interference": "a wave in the readings",
    "sensitivity": "readings that depend on {0}",
}
"""A noun phrase for each form here, with places for its targets, to follow "the model leaves out"."""
