"""Predict the rows of a table with a fitted simulator."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from scipy.special import ndtr, ndtri

from probewise._arrays import LAST_DIGITS, MOST_NUMBERS, BoolArray, FloatArray, IntArray, own_arithmetic
from probewise._display import ShowsItself
from probewise._kinds import require_rng
from probewise._words import count_with_noun
from probewise.effects import EFFECTS, Effect
from probewise.effects.noise import dropouts, noise_of_runs, noise_per_run, random_walk
from probewise.effects.noise_distribution import PredictiveMixture, RecordedBefore
from probewise.errors import DoubtfulResultWarning, ParameterError, require, warn
from probewise.progress import Progress, silent
from probewise.recordings import Instrumentation, write_text_atomically
from probewise.recordings.files import prediction_summary
from probewise.recordings.plan import Plan
from probewise.sensor import NoiseParameters, Stage
from probewise.sensor.stages import effects_with_columns
from probewise.systems.fitted import FittedSystem, require_fitted_system
from probewise.systems.forms import has_value_per_run, jumps_at_row, rebind_forms
from probewise.systems.simulator import Simulator, table_for
from probewise.systems.system import STANDS_STILL, System, SystemChain, with_converged_step
from probewise.systems.table import (
    RunRecording,
    RunTable,
    column_error,
    covariate_of_column,
    median_sd_of_column,
    relative_sds_of_column,
    run_table_csv,
    table_digest,
)

_FEW = 20  # samples used to find rows that cannot be predicted
_LEAST_RUNS = 3  # recorded runs whose spread tells what a new one may have
_SOME = 200  # samples used to estimate the scatter of predictions in each row


@dataclass(frozen=True, eq=False)
class SystemPrediction(ShowsItself):
    """Predictive distribution of each row's reading, all arrays (n_points,).

    `mean` is within the declared range of the instrument. `sd` is that of one new reading, noise and parameters
    together, in the unit of the readings as `mean`; it ignores the range. `log_density` is the natural logarithm of the
    predictive density of that row's reading alone, per unit of the reading, NaN without a reading; for a reading at an
    end of the declared range, it is the log probability of reading that end. `n_failed` of `n_samples` samples were
    left out because the simulator gives no finite readings for them. `notes` say how runs were read and started.
    """

    table: RunTable
    readings: FloatArray
    mean: FloatArray
    sd: FloatArray
    log_density: FloatArray
    n_samples: int
    n_failed: int = 0
    notes: tuple[str, ...] = ()

    @property
    def predicted_table(self) -> RunTable:
        """All rows of the table with `mean`, `sd` and `log_density`; columns of these names are overwritten."""
        return self.table.with_columns({name: getattr(self, name) for name in ("mean", "sd", "log_density")})

    def to_frame(self) -> Any:
        """Return a pandas DataFrame: the table's columns, `mean`, `sd` and `log_density`; a row per reading."""
        return self.predicted_table.to_frame()

    def summary(self) -> str:
        """Return a text: notes; number of predicted readings; chi-square and log density per recorded reading."""
        notes = (f"note: {note}" for note in self.notes)
        return "\n".join([*notes, prediction_summary(self.readings, self.mean, self.sd, self.log_density)])


def as_recording(simulator: Simulator, table: RunTable) -> RunRecording:
    """Build a recording from a table, with the simulator's unit, range and step; readings are NaN without a column.

    Raises ParameterError if the readings are texts, one is infinite, or a declared sd is not positive where there is a
    reading.
    """
    (low, high), step, sd = simulator.noise.range, simulator.noise.step, simulator.noise.sd
    instrument = Instrumentation(unit=simulator.unit, min=low, max=high, step=step, controls=simulator.controls)
    readings = table.columns.get(simulator.reading, np.full(len(table), np.nan))
    if readings.dtype != np.float64 or np.isinf(readings).any():
        allowed = "a number in each row, or nothing where it is missing"
        raise column_error(f"reading {simulator.reading!r}", readings, allowed, row_name=table.row_name)
    own, sd_column = replace(table, instrumentation=instrument), sd if isinstance(sd, str) else ""
    recording = RunRecording(cast(Plan, own), np.array(readings), simulator.source, sd_column=sd_column)
    if recording.sd_column in table.covariates:
        values = table.covariates[recording.sd_column]
        wrong = np.flatnonzero(recording.usable & ~(np.isfinite(values) & (values > 0)))
        if wrong.size:
            name = f'noise["sd"], column {sd!r} in row {table.row_name(wrong[0])}'
            raise ParameterError(name, float(values[wrong[0]]), "greater than 0 wherever there is a reading")
    return recording


@own_arithmetic
def predict_system(
    fitted: FittedSystem, table: RunTable | Mapping[str, Any], *, rng: np.random.Generator, progress: Progress = silent
) -> SystemPrediction:
    """Predict every row of a table, and score its readings where there are any.

    The predictive distribution of a reading is the mixture, over posterior samples, of each sample's noise about its
    prediction, with all effects of the model. For a run outside the recording, each sample draws an effect's value per
    run from a Student-t about the sample's values for the recorded runs, with their scatter as its width, and one
    degree of freedom more than there are runs; and so the `per_run` parameters, if three runs or more were recorded, in
    the coordinate in which their prior is standard normal, else from their prior. Where no time was recorded, a step at
    a row (`at_row`) counts the rows of the recording: those of a table that neither begins with the recording's rows
    nor is a contiguous part of them, readings included, come after its end. A row that lacks a number which the
    simulator or an effect needs has no prediction (NaN), and with a law the rows after it in the run neither; effects
    that look back to it, such as a lag, take the number interpolated within the run.

    Later rows of a recorded run follow its recorded rows, if the model has them, so that its state goes on from there,
    and so does noise with a memory: each sample's is conditional on its residuals there. A gap in time counts as the
    rows that it would have held. Otherwise the run is started again at its first row, which a note says.

    `table` is a RunTable, a dict of arrays, or a DataFrame of n_points rows, with the columns that the simulator and
    the effects use; `rng` is for runs outside the recording.

    Raises
    ------
    ParameterError
        If a column is missing, no row has the numbers that it needs, or the simulator gives finite readings for no
        sample.
    FileError
        If `simulate`, `rates` or `observe` raises an error at every point of the prior that is tried.
    ShapeError
        If `simulate` or `observe` does not return one reading per row.

    Warns
    -----
    DoubtfulResultWarning
        If the simulator gives no finite readings for some samples, or some rows lack a number that they need.
    """
    require_fitted_system(fitted)
    require_rng(rng)
    recording = as_recording(fitted.simulator, table_for(fitted.simulator, table))
    own = replace(cast(RunTable, recording.plan), first_row=_number_of_first_row(fitted, recording))
    whole, recorded = _with_recorded_rows_before(fitted, own)
    before = len(recorded)
    system = replace(
        System.of(fitted.simulator, whole.with_columns(fitted.simulator.interpolated_inputs(whole))),
        max_step=fitted.max_step,
        stiff=fitted.stiff,
        limited=False,  # noise decides which readings are at an end of the range
    )
    chain = system.chain(own, _bound_effects(fitted, own))
    theta, is_drawn = _chain_samples_and_whether_drawn(fitted, chain, rng=rng)
    n_samples, per_block = len(theta), max(1, MOST_NUMBERS // max(1, len(whole)))
    given, lost = _filled_table_and_mask(chain, theta, whole)
    known, earlier = _recorded_before(fitted, own, recorded, ~lost[:before])
    ignored, lost = np.append(~known.usable, lost[before:]), lost[before:]
    chain = _chain_with_converged_step(chain, theta, given, float(np.median(fitted.noise_sd)))
    mixture = PredictiveMixture(
        recording.readings, recording.usable & ~lost, own.instrumentation.step, fitted.simulator.noise.ends
    )
    n_failed, never = 0, np.ones(len(own), dtype=np.bool_)
    between = _smoothing_width_by_row(chain, theta, given)[before:] if is_drawn else None
    for first in range(0, n_samples, per_block):
        progress("predicting", first, n_samples)
        block = theta[first : first + per_block]
        mean = np.where(ignored, 0.0, chain.predict(block, given))
        there = np.isfinite(mean).all(axis=1)
        never &= ~np.isfinite(mean[:, before:]).any(axis=0)
        n_failed += int((~there).sum())
        if there.any():
            mean, sd = mean[there], fitted.noise_sd[first : first + per_block][there, None]
            noise = _noise_parameters(fitted, chain, block[there], mean, sd, whole)
            expected, noise = known.condition(noise, sd, earlier - mean[:, :before])
            mixture.add(mean[:, before:] + expected, noise, between)
    if n_failed == n_samples:
        at = f"in {int(never.sum())} of {len(own)} rows, first in row {own.row_name(int(np.argmax(never)))}"
        found = f"no finite reading {at}" if never.any() else "no finite reading"
        allowed = "finite readings of all rows for some of the samples"
        raise ParameterError("simulate" if system.caller else "rates", found, allowed)
    if n_failed:
        left_out = f"{n_failed} of {n_samples} samples are left out: the simulator gives no finite readings for them"
        warn(left_out, DoubtfulResultWarning)
    mean, sd, scores = mixture.mean_sd_and_log_density()
    if lost.any():
        mean, sd = np.where(lost, np.nan, mean), np.where(lost, np.nan, sd)
        first_lost = own.row_name(int(np.argmax(lost)))
        rows = f"{count_with_noun(int(lost.sum()), 'row')} cannot be predicted, first row {first_lost}"
        why = "a number that they need is missing; where an effect looks back to it, it is interpolated"
        warn(f"{rows}: {why}", DoubtfulResultWarning)
    notes = (*own.notes, *_note_on_runs_started_again(fitted, own))
    counts = {"n_samples": n_samples, "n_failed": n_failed}
    return SystemPrediction(own, recording.readings, mean=mean, sd=sd, log_density=scores, notes=notes, **counts)


def _with_recorded_rows_before(fitted: FittedSystem, table: RunTable) -> tuple[RunTable, IntArray]:
    """Put first the recorded rows of a table's runs before their first rows in it; also return their numbers."""
    if fitted.known is None or not (table.has_varying_time and fitted.known.table.has_varying_time):
        return table, np.zeros(0, dtype=np.int64)
    recorded, first, columns = fitted.known.table, _first_times(table), {}
    begins = np.array([first.get(name, -np.inf) for name in recorded.scan_names])
    rows = np.flatnonzero(recorded.time_s < begins[recorded.scan])
    for name, values in table.columns.items():
        earlier = recorded.columns.get(name)
        if earlier is None or earlier.dtype.kind != values.dtype.kind:
            earlier = np.full(len(recorded), np.nan if values.dtype == np.float64 else "")
        columns[name] = np.concatenate([earlier[rows], values])
    names = (*rows.tolist(), *table.row_names) if table.row_names else ()
    return replace(table, columns=columns, first_line=table.first_line - len(rows), row_names=names, notes=()), rows


def _recorded_before(
    fitted: FittedSystem, table: RunTable, rows: IntArray, predicted: BoolArray
) -> tuple[RecordedBefore, FloatArray]:
    """Return what was recorded before the rows of a table: these recorded rows, and their readings, (n_recorded,).

    `predicted` is the mask of those that the model predicts. A lost reading, or one at an end of the range, tells
    nothing of the noise.
    """
    later, last = np.arange(len(table)) + table.first_row, np.full(len(table), -1)
    n_since, usable, readings = np.zeros(len(table), dtype=np.int64), predicted, np.zeros(0)
    if fitted.known is not None and rows.size:
        recorded = fitted.known.table
        recording = as_recording(fitted.simulator, recorded)
        readings, values = recording.readings[rows], fitted.samples.T
        lost = [own for own, name in zip(values, fitted.names, strict=True) if name == f"{dropouts.name}.value"]
        usable = predicted & (recording.usable & ~recording.censored)[rows] & ~np.isin(readings, lost)
        run = np.array(recorded.scan_names)[recorded.scan[rows]]
        for name, own in zip(table.scan_names, table.rows_by_scan(), strict=True):
            before = np.flatnonzero(run == name)
            if usable[before].any():
                last[own] = before[usable[before]][-1]
                order = np.argsort(np.argsort(table.time_s[own], kind="stable")) + 1
                in_rows = (table.time_s[own] - recorded.time_s[rows[last[own]]]) / recorded.median_gap
                n_of_run = order + np.count_nonzero(before > last[own[0]])
                n_since[own] = np.maximum(n_of_run, np.round(in_rows).astype(np.int64))
    return RecordedBefore(rows, usable, later, last, n_since), readings


def _first_times(table: RunTable) -> dict[str, float]:
    each = zip(table.scan_names, table.rows_by_scan(), strict=True)
    return {name: float(table.time_s[rows].min()) for name, rows in each}


def _note_on_runs_started_again(fitted: FittedSystem, table: RunTable) -> tuple[str, ...]:
    """Return a note where a law starts runs again that may have been recorded before their first rows here; else ().

    Runs that begin at time 0, or that have values of their own of which none is recorded, are new ones.
    """
    if fitted.simulator.law is None or fitted.known is not None or fitted.recording == table_digest(table):
        return ()
    own = (name.partition("[") for name in fitted.names)
    known = {run[:-1] for name, _, run in own if name in fitted.simulator.per_run}
    again = [name for name, time in _first_times(table).items() if time > 0 and (not known or name in known)]
    runs = f"run{'s' * (len(again) > 1)} {', '.join(again)}" if table.run else "the run"
    how = "started again at its first row here, as `states` says; give the recorded rows before it to go on from them"
    return (f"{runs}: {how}",) if again else ()


def _chain_with_converged_step(chain: SystemChain, theta: FloatArray, table: RunTable, noise_sd: float) -> SystemChain:
    """Return a chain whose integration step serves the extreme samples over a table; `chain` if none is in reach.

    The step was chosen for the likeliest parameters and the gaps between the rows of the recording. Over longer gaps,
    and at the fastest rates that the samples hold, an integration may run away.
    """
    effects, tolerance = cast(Sequence[Effect], chain.effects), STANDS_STILL * noise_sd
    extreme = theta[np.unique([theta.argmin(axis=0), theta.argmax(axis=0)])]
    try:
        system = with_converged_step(chain.system, table, extreme, effects, tolerance=tolerance, or_finest=True)
    except ParameterError:  # a friction or a bound that no step meets exactly
        return chain
    return chain if system is chain.system else system.chain(table, effects)


def _number_of_first_row(fitted: FittedSystem, recording: RunRecording) -> int:
    """Return the number of a table's first row, counted from the first row of the recording of the fit, as above."""
    reading, known = fitted.simulator.reading, fitted.known
    if known is None:
        return 0
    table, recorded = cast(RunTable, recording.plan), known.table
    if not np.isfinite(recording.readings).any():
        return len(recorded)
    inputs = sorted(recorded.covariates.keys() & table.covariates.keys() - {reading})
    now, then = (
        np.stack([np.where(np.isfinite(readings), readings, np.inf), *(own.covariates[name] for name in inputs)])
        for own, readings in ((table, recording.readings), (recorded, recorded.columns[reading]))
    )
    block = now[:, : len(recorded)]
    starts = np.arange(then.shape[1] - block.shape[1] + 1)
    for k, column in enumerate(block.T[:, :, None]):  # a NaN, which was interpolated for the fit, fits anything
        starts = starts[((then[:, starts + k] == column) | np.isnan(column)).all(axis=0)]
        if not starts.size:
            return len(recorded)
    return int(starts[0])


def _filled_table_and_mask(chain: SystemChain, theta: FloatArray, table: RunTable) -> tuple[RunTable, BoolArray]:
    """Interpolate the missing cells that predictions need, and find the rows that cannot be predicted without them.

    Returns the table with these cells interpolated within runs, and the mask of the rows without a prediction,
    (n_points,): those that lack a cell which the simulator or an effect needs, and those for which the simulator alone
    gives none, as a law from there to the end of the run. Raises ParameterError if no row can be predicted.
    """
    few, lost, needed = theta[:_FEW], np.zeros(len(table), dtype=np.bool_), list[str]()
    filled = chain.system.simulator.interpolated_inputs(table)
    whole, bare = table.with_columns(filled), chain.system.chain(table, ())
    if not filled or not np.isfinite(chain.predict(few, whole)).any():
        return table, lost
    for name in filled:
        alone = whole.with_columns({name: table.covariates[name]})
        if not np.isfinite(chain.predict(few, alone)).any(axis=0).all():
            needed.append(name)
            lost |= ~np.isfinite(table.covariates[name])
            lost |= ~np.isfinite(bare.predict(few[:, : chain.system.n_params], alone)).any(axis=0)
    if lost.all():
        row = table.row_name(int(np.argmax(~np.isfinite(table.covariates[needed[0]]))))
        raise ParameterError(f"column {needed[0]!r}", f"no number in row {row}", "a number where a prediction needs it")
    return table.with_columns({name: filled[name] for name in needed}), lost


def _bound_effects(fitted: FittedSystem, table: RunTable) -> list[Effect]:
    """Bind the effects of a fitted simulator to the runs of a table, in the order of `fitted.effects`.

    Raises ParameterError if a column that an effect reads is missing, time falls within a run and an effect depends on
    earlier times, or this version has no such effect.
    """
    forms: Mapping[str, Any] = {}
    known = fitted.known
    if known is not None:
        new = [run for run in table.scan_names if run not in known.table.scan_names]
        forms = rebind_forms(fitted.effects, fitted.simulator, known, more_runs=new)
        if any(form.needs_rising_time for form in forms.values()):
            table.require_rising_time()
        # A jump at a row may show along a column that it does not read.
        along = {covariate for form in forms.values() if not jumps_at_row(form) for covariate in form.covariates}
        columns = known.table.covariates.keys() - {fitted.simulator.reading} - table.covariates.keys()
        lacking = [name for name in columns if covariate_of_column(name) in along]
        if lacking:
            there = f"the table has {', '.join(table.columns)}"
            allowed = f"numbers in this column, which an effect of the model reads; {there}"
            raise ParameterError(f"column {min(lacking)!r}", "missing or without numbers", allowed)
    runs = dict.fromkeys((*(() if known is None else known.table.scan_names), *table.scan_names))
    of_noise = {random_walk.name: random_walk(), noise_per_run.name: noise_of_runs(tuple(runs))}
    for name in fitted.effects:
        is_known = name in forms or name in of_noise or name in EFFECTS
        require(is_known, "effects", name, "an effect that this version knows; diagnose again with it")
    return [forms.get(name) or of_noise.get(name) or EFFECTS[name]() for name in fitted.effects]


def _smoothing_width_by_row(chain: SystemChain, theta: FloatArray, table: RunTable) -> FloatArray:
    """Return the kernel width for smoothing over samples in each row, (n_points,), by Silverman's rule.

    A parameter of a new run is drawn from its prior some thousand times. If the prior is wide, the predictions are
    farther apart than the noise is wide, and without smoothing the density would depend on chance.
    """
    some = chain.predict(theta[:: max(len(theta) // _SOME, 1)], table)
    there = some[np.isfinite(some).all(axis=1)]
    if len(there) < 2:
        return np.zeros(len(table))
    low, high = np.quantile(there, [0.25, 0.75], axis=0)
    spread = np.minimum(there.std(axis=0), (high - low) / 1.349)
    return np.asarray(0.9 * spread * len(theta) ** -0.2)


def _chain_samples_and_whether_drawn(
    fitted: FittedSystem, chain: SystemChain, *, rng: np.random.Generator
) -> tuple[FloatArray, bool]:
    """Arrange the samples by the columns of a chain, (n_samples, n_params); also return whether any were drawn."""
    at = {name: k for k, name in enumerate(fitted.names)}
    n, system, is_drawn = len(fitted.samples), chain.system, False
    out = np.empty((n, len(chain.names)))
    of_effects = (name for name in at if any(name.startswith(f"{own}.") for own in fitted.effects))
    lost = next((name for name in of_effects if name not in chain.names), None)
    require(lost is None, "names", lost, "a parameter that this version knows; diagnose again with it")
    for k, name in enumerate(chain.names):
        if name in at:
            out[:, k] = fitted.samples[:, at[name]]
            continue
        is_drawn, prior = True, system.marginals.get(name)
        effect = next((own for own in fitted.effects if has_value_per_run(own) and name.startswith(f"{own}.")), None)
        # Otherwise its effect, bound to the recording again, has other parameters.
        is_known = prior is not None or effect is not None
        require(is_known, "names", fitted.names, f"all parameters of the effects; {name} is missing")
        of = f"{effect}." if prior is None else f"{name.split('[')[0]}["
        known = fitted.samples[:, [j for own, j in at.items() if own.startswith(of)]]
        if prior is None:
            positive = effect == noise_per_run.name  # positive parameters scatter in the logarithm
            drawn = draw_value_for_new_run(np.log(known) if positive else known, rng=rng)
            out[:, k] = np.exp(drawn) if positive else drawn
        elif known.shape[1] < _LEAST_RUNS:  # one stratified draw from the prior for each sample
            out[:, k] = prior.from_unit((rng.permutation(n) + rng.random(n)) / n)
        else:
            drawn = draw_value_for_new_run(ndtri(np.clip(prior.to_unit(known), LAST_DIGITS, 1 - LAST_DIGITS)), rng=rng)
            out[:, k] = prior.from_unit(np.clip(ndtr(drawn), LAST_DIGITS, 1 - LAST_DIGITS))
    return out, is_drawn


def draw_value_for_new_run(known: FloatArray, *, rng: np.random.Generator) -> FloatArray:
    """Draw the value of a new run given those of other runs: (n_samples, n_runs) -> (n_samples,).

    Mean and variance of the runs are unknown; the prior of the variance counts as two more runs with the same scatter.
    """
    n_runs = known.shape[1]
    spread = known.std(axis=1, ddof=1) if n_runs > 1 else np.abs(known[:, 0])
    return np.asarray(known.mean(axis=1) + spread * np.sqrt(1 + 1 / n_runs) * rng.standard_t(n_runs + 1, len(known)))


def _noise_parameters(
    fitted: FittedSystem, chain: SystemChain, theta: FloatArray, mean: FloatArray, sd: FloatArray, table: RunTable
) -> NoiseParameters:
    low, high = fitted.level
    seen = np.clip((mean - low) / ((high - low) or 1.0), 0.0, 1.0)
    declared = fitted.simulator.noise.sd
    if isinstance(declared, str) and fitted.known is not None:
        sd = sd * relative_sds_of_column(table, declared, median_sd_of_column(fitted.known.table, declared))
    noise = NoiseParameters(sd, np.zeros((1, 1)), seen=seen)
    for effect, columns in effects_with_columns(chain.effects, chain.system.n_params):
        if effect.stage is Stage.NOISE:
            noise = effect.apply(noise, theta[:, columns], cast(Any, table))
    return noise


def write_system_prediction(prediction: SystemPrediction, path: str | os.PathLike[str]) -> None:
    """Write all rows of the table in order as CSV, with `mean`, `sd` and `log_density`, in full precision.

    Columns of the table with one of these names are overwritten. Raises FileError if the file cannot be written.
    """
    write_text_atomically(path, run_table_csv(prediction.predicted_table))
