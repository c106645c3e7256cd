"""Diagnosis of a user's simulator against a table: fit it, scale the effects to the fit, diagnose.

The integration step is chosen for the residuals of the law without effects. A repair leaves smaller residuals, so its
integration may need a finer step; then everything is repeated.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
from scipy.special import ndtr

from probewise._arrays import BoolArray, FloatArray, own_arithmetic
from probewise._kinds import require_progress, require_rng
from probewise._words import count_with_noun
from probewise.diagnosis.diagnosis import Diagnosis, Thorough, diagnose_prepared
from probewise.diagnosis.fit import Fit, with_prior
from probewise.diagnosis.locate import Covariate
from probewise.diagnosis.noise import NoiseLaw, white_noise_of_recording
from probewise.diagnosis.outlying import find_lost_readings
from probewise.diagnosis.prepared import MOST_DIAGNOSED_READINGS, Prepared, positions_in_stretches
from probewise.diagnosis.search.search import search
from probewise.diagnosis.simulator_fit import fit_system, is_noise_sd_known_beside_misfit
from probewise.diagnosis.simulator_rows import CALLS_OF_A_SEARCH, SimulatorApparatus
from probewise.effects import Effect
from probewise.errors import ParameterError
from probewise.priors import LogUniform, Normal, Uniform
from probewise.progress import Progress, silent
from probewise.recordings.plan import Plan, masks_of_readings_at_ends
from probewise.systems import ProgressWithCallCount, RunRecording, RunTable, Simulator, System, as_recording, table_for
from probewise.systems.forms import ReferenceFit
from probewise.systems.forms.binding import sorting_column
from probewise.systems.forms.reference import note_on_row_order
from probewise.systems.forms.stop import MeterStop, meter_stops_and_masks
from probewise.systems.integrate import Integrations
from probewise.systems.system import STANDS_STILL, with_converged_step

NEAR_END = 2.0  # noise sds from an end of the declared range to a prediction whose noise the end may cut off
_EXPLAINED = 3.0  # noise sds from the prediction, limited to the range, to a reading that it explains


def _without_readings(recording: RunRecording, rows: BoolArray, *notes: str) -> RunRecording:
    return replace(recording, readings=np.where(rows, np.nan, recording.readings), notes=(*recording.notes, *notes))


def recording_from_table(simulator: Simulator, table: RunTable) -> RunRecording:
    """Convert a table to a recording whose readings are the predicted column.

    Of more than 2,400 readings, about that many are used, in stretches of six, and a note says so; the simulator still
    predicts every row.

    Raises ParameterError if the column is missing or contains no number, or if time falls within a run.
    """
    if simulator.reading not in table.columns:
        raise ParameterError("reading", simulator.reading, f"a column of the table: {', '.join(table.columns)}")
    table.require_rising_time()
    table.require_moderate_numbers()
    whole = as_recording(simulator, table)
    usable = np.flatnonzero(whole.usable)
    chosen = usable[positions_in_stretches(table.scan[usable], MOST_DIAGNOSED_READINGS)]
    if len(chosen) == len(usable):
        return whole
    note = f"{len(chosen):,} of {len(usable):,} readings are used, in stretches of six spread over the whole table"
    return _without_readings(whole, ~np.isin(np.arange(len(table)), chosen), note)


def without_unpredictable_readings(system: System, recording: RunRecording, *, every_row: bool = False) -> RunRecording:
    """Leave out, with a note, the readings of rows in which a missing column makes a prediction impossible.

    If there is such a row, missing values of all columns are interpolated from the other rows of the run, so that
    effects with a memory, such as backlash, are defined in later rows.

    Raises ParameterError if the simulator gives no finite reading in a row where no column is missing: one with a
    reading or, if `every_row`, any, since the change by an effect would not be finite there.
    """
    table, law = cast(RunTable, recording.plan), system.simulator.law
    there = np.isfinite(system.chain(table, ()).predict(system.theta(system.starts), table))
    unpredictable = ~there[there.any(axis=1)].any(axis=0) if there.any() else np.ones(len(table), dtype=np.bool_)
    lost = unpredictable & recording.usable
    if not unpredictable.any():
        return recording
    inputs, missing = system.simulator.inputs(table.covariates), np.zeros(len(table), dtype=np.bool_)
    for values in inputs.values():
        missing |= ~np.isfinite(values)
    gaps = np.flatnonzero(missing)
    if law is not None:  # what is missing once is missing to the end of its run
        for rows in table.rows_by_scan():
            missing[rows] = np.maximum.accumulate(missing[rows])
    wrong = np.flatnonzero((unpredictable if every_row else lost) & ~missing)
    if wrong.size:
        where = f"no finite reading in {len(wrong)} of {len(table)} rows, first in row {wrong[0] + table.first_line}"
        allowed = "a finite reading in each row somewhere in the prior, or a table without these rows"
        raise ParameterError("simulate" if law is None else "rates", where, allowed)
    filled = table.with_columns({name: table.interpolated_within_runs(values) for name, values in inputs.items()})
    recording = replace(recording, plan=cast(Plan, filled))
    if not lost.any():
        return recording
    why = "simulator reads is missing there"
    if law is not None:
        more = f" and {len(gaps) - 1} more" if len(gaps) > 1 else ""
        why = f"law reads is missing in row {gaps[0] + table.first_line}{more}, and a law ends at the first gap of its "
        why += "run; fill the gaps in to use them"
    note = f"{count_with_noun(int(lost.sum()), 'reading')} left out: a column that the {why}"
    return _without_readings(recording, lost, note)


def _without_rows_at_stop(recording: RunRecording, stop: MeterStop, rows: BoolArray) -> RunRecording:
    level = f"{stop.level:.6g} {stop.unit}".rstrip()
    note = f"{count_with_noun(int(rows.sum()), 'reading')} left out, at {level}, where the meter stops"
    return _without_readings(recording, rows, note)


def without_readings_near_ends(system: System, found: Fit, sd: float, recording: RunRecording) -> RunRecording:
    """Leave out, with a note, readings whose noise an end of the declared range cuts off, and note those at an end.

    Of the former, the fit predicts the signal near an end or beyond, and explains the reading: near an end only noise
    away from the end is seen, so their mean is biased. There are none at an end that no reading reaches, nor where only
    the misfit of the simulator tells the noise sd. Where too few readings would be left for a fit, all stay. The
    recording itself is returned if no reading is near an end.
    """
    table, usable = cast(RunTable, recording.plan), recording.usable
    near = at_end = usable & recording.censored
    if is_noise_sd_known_beside_misfit(system.simulator, table):
        (low, high), own_sd = system.simulator.noise.ends, sd * recording.relative_sd
        at_low, at_high = masks_of_readings_at_ends(recording.readings, low, high, system.simulator.noise.step)
        predicted = replace(system, limited=False).chain(table, ()).predict(system.theta(found.z[None, :]), table)[0]
        is_near = at_low.any() & (predicted - low < NEAR_END * own_sd)
        is_near |= at_high.any() & (high - predicted < NEAR_END * own_sd)
        is_explained = np.abs(recording.readings - np.clip(predicted, low, high)) < _EXPLAINED * own_sd
        near = at_end | usable & is_near & is_explained
    if not near.any():
        return recording
    cut = near & ~at_end & ((usable & ~near).sum() >= system.least_readings)
    words = (
        (at_end, "at an end of the declared range: used only as the statement that the signal is there or beyond"),
        (cut, "left out near an end of the declared range, which cuts off the noise"),
    )
    notes = [f"{count_with_noun(int(rows.sum()), 'reading')} {what}" for rows, what in words if rows.any()]
    return _without_readings(recording, cut, *notes)


_FAR = 4.0  # sds; if the truth is at the end of its prior, one recording in 30,000 is this far beyond it
_MUCH = 1.1  # factor by which the noise differs from what was declared


def notes_on_prior_conflict(system: System, found: Fit, law: NoiseLaw) -> Iterator[str]:
    """Yield a note on each parameter of a fitted system, without effects, whose prior the readings contradict.

    With the prior of one parameter removed, the readings alone move its standard-normal coordinate z by a step, known
    to within an sd; both are linear approximations. A bounded prior is uniform in the probability Phi(z), so its end is
    Phi(-|z|) / phi(z) away, measured in z.
    """
    slopes = law(found.slopes[:, : system.n_params]) / found.sd
    z, curvature = found.z[: system.n_params], with_prior(slopes.T @ slopes)
    downhill = slopes.T @ law(found.residuals[:, None])[:, 0] / found.sd - z
    covariance = np.linalg.inv(curvature)
    variance = np.diag(covariance)
    with np.errstate(all="ignore"):  # of what the readings do not tell: no number, and no note
        # Row k of the inverse without the prior of parameter k is that with it over 1 - variance (Sherman-Morrison).
        steps = (covariance @ downhill + z * variance) / (1 - variance)
        sds = np.sqrt(variance / (1 - variance))
    for (name, prior), at, step, sd in zip(system.marginals.items(), z.tolist(), steps.tolist(), sds, strict=True):
        if isinstance(prior, Uniform | LogUniform):
            end = float(ndtr(-abs(at)) / (np.exp(-0.5 * at**2) / np.sqrt(2 * np.pi)))
            if np.sign(at) * step - end > _FAR * sd:
                where, more = ("upper", "larger") if at > 0 else ("lower", "smaller")
                yield f"{name} is at the {where} end of its prior, {prior}, but the readings ask for a {more} value"
        elif isinstance(prior, Normal) and abs(at + step) > _FAR * np.hypot(1, sd):
            way = "above" if at + step > 0 else "below"
            yield f"the readings ask for {name} {abs(at + step):.1f} sds {way} the mean of its prior, {prior}"


def notes_on_declared_noise(simulator: Simulator, noise_sd: FloatArray) -> Iterator[str]:
    """Yield a note if samples of the noise sd, (n_samples,), contradict the number that was declared."""
    declared = simulator.noise.sd
    if declared is None or isinstance(declared, str):
        return
    mean, sd = float(np.mean(noise_sd)), float(np.std(noise_sd))
    if abs(mean - declared) > max(_FAR * sd, (_MUCH - 1) * declared):
        unit = f" {simulator.unit}" if simulator.unit else ""
        yield f"the noise sd of a reading is {mean:.3g} ± {sd:.1g}{unit}, though {declared:g} was declared"


@own_arithmetic
def diagnose_system(
    simulator: Simulator,
    table: RunTable | Mapping[str, Any],
    *,
    source: str = "",
    notes: Sequence[str] = (),
    thorough: Thorough | None = None,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> Diagnosis:
    """Diagnose which physics a simulator leaves out, from a table of readings, as `probewise.diagnose` does.

    `source`, `notes`: name of the table, and notes on it for the report; `thorough` as in `diagnose`; `progress` is
    also called with the number of calls of `simulate`.

    Raises
    ------
    ParameterError
        If the table lacks a column that the simulator names, has too few readings, or time falls within a run; if
        readings are not finite, or change when `simulate` is called again; or if no affordable step integrates the law.
    FileError
        If `simulate`, `rates` or `observe` raises an error at every point of the prior that is tried.
    ShapeError
        If `simulate` or `observe` does not return one reading per row.
    NotConvergedError
        If the fit of the simulator did not converge.
    """
    table = table_for(simulator, table)
    require_rng(rng)
    require_progress(progress)

    def fit_and_diagnose(
        simulator: Simulator, *, stiff: bool = False, sought: frozenset[str] | None = None
    ) -> Diagnosis:
        prepared = prepare_system(simulator, table, source=source, notes=notes, progress=progress, stiff=stiff)
        prepared = replace(prepared, sought=sought)
        told = _progress_with_call_count(progress, cast(SimulatorApparatus, prepared.apparatus).system)
        searched = None
        if prepared.has_too_little_data:  # the verdict is that they cannot tell, whatever a search would find
            prior = prepared.apparatus.prior_odds(prepared.effects)
            searched = replace(search(replace(prepared, effects={}), prior=prior, progress=told), prepared=prepared)
        return diagnose_prepared(prepared, searched=searched, thorough=thorough, progress=told, rng=rng)

    diagnosis = fit_and_diagnose(simulator)
    needed = finer_step_for_repair(diagnosis)
    if needed is None:
        return diagnosis
    step, stiff = needed
    assert simulator.law is not None
    progress(f"once more, with integration steps of {step:.3g} {simulator.time_unit}, which the repaired law needs")
    # Finer steps cost more, and move evidences by a few nats: a second search of everything is not needed.
    sought = frozenset(n for h in diagnosis.hypotheses if h.probability > _SOUGHT_AGAIN for n in h.effects)
    return fit_and_diagnose(replace(simulator, law=replace(simulator.law, max_step_s=step)), stiff=stiff, sought=sought)


def prepare_system(
    simulator: Simulator,
    table: RunTable,
    *,
    source: str = "",
    notes: Sequence[str] = (),
    progress: Progress = silent,
    with_effects: bool = True,
    stiff: bool = False,
) -> Prepared:
    """Fit the simulator, and build the engine's input; effects are scaled to the fit, none unless `with_effects`.

    A law is integrated by a linearly implicit method if `stiff`, or where it needs one.
    """
    said = (*table.notes, *notes, *note_on_row_order(simulator, table))
    recording = replace(recording_from_table(simulator, table), source=source or simulator.source, notes=said)
    system = System.of(simulator, table, stiff=stiff)
    if with_effects and len(table) < 2:  # nothing can change along it
        raise ParameterError("the table", "one row", f"{system.least_readings} rows or more, not all readings equal")
    plan, recording = recording.plan, without_unpredictable_readings(system, recording, every_row=with_effects)
    if recording.plan is not plan:
        table = replace(table, columns=cast(RunTable, recording.plan).columns)
    stopped = next(meter_stops_and_masks(as_recording(simulator, table), simulator.reading), None)
    stop = None if stopped is None else stopped[0]
    recording = recording if stopped is None else _without_rows_at_stop(recording, *stopped)
    least = system.least_readings if with_effects else system.n_params + 1
    n_usable, n_within = int(recording.usable.sum()), int((recording.usable & ~recording.censored).sum())
    if n_usable < (1 if with_effects else least):
        raise ParameterError("usable readings", n_usable, f"{least} or more in column {simulator.reading}")
    if recording.censored.any() and n_within < least:
        allowed = f"{least} or more: readings at its ends do not determine the noise"
        raise ParameterError("readings within the declared range", n_within, allowed)
    told = _progress_with_call_count(progress, system)
    told("fitting the simulator")
    plain = system
    system, found, sd = fit_system(plain, recording)
    first = SimulatorApparatus(ReferenceFit(system, table, found.z, sd))

    def covariates(fitted: Fit) -> Sequence[Covariate]:
        return first.covariates_and_predicted_slope(fitted, recording)[0]

    lost = find_lost_readings(found.model, recording, found, list(system.starts), covariates, sd=sd)
    effect = None if lost is None else lost.effect(recording)
    if lost is not None:
        told("fitting the simulator without lost readings")
        recording = cast(RunRecording, lost.left_out_of(recording))
        system, found, sd = fit_system(plain, recording)
    beside_ends = without_readings_near_ends(system, found, sd, recording)
    if beside_ends is not recording:
        recording, known = beside_ends, is_noise_sd_known_beside_misfit(simulator, table)
        system = replace(system, first=found.z, slack=NEAR_END * sd if known else 0.0)
        system, found, sd = fit_system(system, recording)
    misfit = float(np.sqrt(np.mean(found.residuals**2))) / sd
    conflicts = tuple(notes_on_prior_conflict(system, found, white_noise_of_recording(recording)))
    apparatus = SimulatorApparatus(ReferenceFit(system, table, found.z, sd, misfit=misfit), stop, lost=effect)
    sorting = sorting_column(apparatus.about)
    if sorting is not None:
        told_of = f"what jumps or wanders from row to row may change with {sorting} instead"
        conflicts = (*conflicts, f"rows are sorted by {sorting}: {told_of}")
    recording = replace(recording, notes=(*recording.notes, *conflicts))
    begun = replace(system, first=found.z)
    told("building the effects")
    effects = apparatus.effects(recording, begun) if with_effects else {}
    return Prepared(recording, effects, begun, apparatus, recording)


def _progress_with_call_count(progress: Progress, system: System) -> Progress:
    return progress if system.caller is None else ProgressWithCallCount(progress, system.caller)


def notes_on_calls(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return notes on calls of a simulator or integration of its law (cut short, failed, interpolated, stiff); else ().

    With those on its declared noise.
    """
    apparatus = diagnosis.apparatus
    if not isinstance(apparatus, SimulatorApparatus):
        return ()
    white = diagnosis.noise.model == "white"
    out = [*notes_on_declared_noise(apparatus.system.simulator, diagnosis.repaired.noise_sd)] if white else []
    caller, done = apparatus.system.caller, apparatus.system.integrations
    if caller is None:
        law = apparatus.system.simulator.law
        sets_step = law is not None and law.max_step_s is not None
        return (*out, *_notes_on_integration(done, apparatus.evaluations_of_a_search, sets_step=sets_step))
    if caller.cut_short:
        out.append(
            f"simulate takes one sample at a time: after {CALLS_OF_A_SEARCH:,} calls some promising combinations of "
            "effects were not fitted; if simulate takes arrays, the search is complete"
        )
    if caller.n_failed:
        out.append(f"simulate raised an error for {caller.n_failed:,} parameter vectors, which count as impossible")
    if caller.interpolated:
        out.append(
            f"simulate takes no array of {', '.join(sorted(caller.interpolated))}: each reading is interpolated "
            "between fixed values, as if the parameter had had that row's value from the start; if earlier rows affect "
            "later ones, let simulate take arrays, or write a law"
        )
    return tuple(out)


def _notes_on_integration(done: Integrations, most: int, *, sets_step: bool) -> Iterator[str]:
    if done.cut_short:
        way_out = "a larger max_step_s, shorter runs" if sets_step else "shorter runs"
        yield (
            f"integrating the law takes long: after {most:,} evaluations of its rates some promising combinations of "
            f"effects were not fitted; with {way_out} or fewer rows the search is complete"
        )
    if done.too_stiff:
        yield (
            "the law is stiff: parameters that may fit the readings would need more integration steps than are taken, "
            "and count as impossible; their intervals may be too narrow; set a shorter max_step_s, or write simulate "
            "with an integrator of your own"
        )
    if done.n_failed:
        yield f"rates raised an error for {done.n_failed:,} parameter vectors, which count as impossible"


_SOUGHT_AGAIN = 1e-4  # probability of a hypothesis, nine nats behind, whose effects are searched again with finer steps
_N_HALVED = 4  # posterior samples of the repaired law for which the step is halved


def finer_step_for_repair(diagnosis: Diagnosis) -> tuple[float, bool] | None:
    """Return the finer integration step that the repaired law needs, or the finest within reach, and if it is stiff.

    None if the step used was fine enough, or the simulator has no law, or the repair no effects.
    """
    system = cast(SimulatorApparatus, diagnosis.apparatus).system
    model, table = diagnosis.repaired, cast(RunTable, diagnosis.recording.plan)
    effects = cast(Sequence[Effect], model.chain.effects)
    if system.simulator.law is None or not effects:
        return None
    tolerance = STANDS_STILL * float(np.median(model.noise_sd))
    try:
        theta = model.theta[:_N_HALVED]
        still = with_converged_step(system, table, theta, effects, tolerance=tolerance, or_finest=True)
    except ParameterError:  # a friction or a bound that no step meets exactly
        return None
    needed = still.max_step, still.stiff
    return needed if needed != (system.max_step, system.stiff) else None
