"""Diagnosis of a user's simulator against a table: fit it, scale the effects to the fit, diagnose.

The integration step is chosen for the residuals of the law without effects. A repair leaves smaller residuals, so its
integration may need a finer step; then everything is repeated. Where a law is stiff, as one whose time constant may be
far shorter than the time between readings, the step of the best fit makes predictions run away at parameters that fit
the readings as well; there it is the step that likely parameters need.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
from scipy.special import ndtr, ndtri

from probewise._arrays import BoolArray, FloatArray, own_arithmetic
from probewise._kinds import require_progress, require_rng
from probewise._words import count_with_noun
from probewise.diagnosis.diagnosis import Diagnosis, Thorough, diagnose_prepared
from probewise.diagnosis.evidence import covariance_root, log_evidence_of
from probewise.diagnosis.fit import AT_ONCE, DIFFERENCE, FARTHEST, Fit, Model, fit, fit_each_start, with_prior
from probewise.diagnosis.noise import LEAST_SCALE, NoiseLaw, rough_sd, white_noise_of_recording
from probewise.diagnosis.outlying import find_lost_readings, find_meter_stop
from probewise.diagnosis.prepared import MOST_DIAGNOSED_READINGS, Prepared, positions_in_stretches
from probewise.diagnosis.search import search
from probewise.diagnosis.simulator_rows import CALLS_OF_A_SEARCH, SimulatorApparatus
from probewise.effects import Effect, NoiseEffect
from probewise.effects.noise import SAYS_THE_SAME, says_what_readings_say
from probewise.errors import ParameterError, ProbewiseError
from probewise.priors import LogUniform, Normal, Uniform
from probewise.progress import Progress, silent
from probewise.recordings.columns import notes_on_codes
from probewise.recordings.plan import Plan, Recording, masks_of_readings_at_ends
from probewise.systems import RunRecording, RunTable, Simulator, System, as_recording, table_for
from probewise.systems.calls import Caller, progress_with_call_count
from probewise.systems.forms import ReferenceFit, sorting_column
from probewise.systems.forms.modulations import time_since_start_of_run
from probewise.systems.forms.reference import note_on_row_order, rows_are_in_order
from probewise.systems.system import STANDS_STILL, with_converged_step

_COARSE = 0.1, 1e-2, 1e-3  # steps of a coordinate where smaller ones change nothing
_STEPS_TRIED = 8  # from each start
_BEST_STARTS = 3  # of which it goes on
_SCREENED, _DESCENTS = 2000, 200  # points of the prior that are predicted, and the best of them, that are followed
_STAGES = (12, 40), (18, 12), (50, 6), (120, 6)  # steps of all, and the number of the best that go on
_POLISH, _POLISH_FEW = 400, 25  # steps with central differences, where they cost little, and else
_STILL = 1e-11  # nats
_EVENLY_HIGH = 1e-5  # nats
_DIFFERENCE = 1e-6  # of a coordinate
_ROUNDING = 1e-15


def fit_system(system: System, recording: Recording) -> tuple[System, Fit, float]:
    """Fit a system to readings, at an integration step at which likely predictions no longer change.

    Returns the system with that step, the fit, and the sd of a reading: as declared, or else the smaller of the
    estimates from the fit and from successive readings.
    """
    table = cast(RunTable, recording.plan)
    law = white_noise_of_recording(recording)
    if system.caller is not None:
        system = replace(system, differences=_differences(system, table))
    found = _fit_from_best_starts(system, recording, law)
    sd = _noise_sd_of(system.simulator, table, recording, found)

    def refitted(finer: System) -> tuple[System, Fit, float]:
        again = fit(Model(finer, (), recording.plan), recording, found.z, law)
        return finer, again, _noise_sd_of(finer.simulator, table, recording, again)

    for _ in range(4):
        finer = with_converged_step(system, table, system.theta(found.z[None, :]), tolerance=STANDS_STILL * sd)
        if finer is system:
            break
        system, found, sd = refitted(finer)
    finer = with_step_for_likely_parameters(system, table, found, sd)
    return (system, found, sd) if finer is system else refitted(finer)


def _differences(system: System, table: RunTable) -> FloatArray:
    """Return the step of each coordinate for differences, (n_params,).

    It is small, but larger for a parameter that `simulate` rounds, counts by, or looks up: the least step that changes
    predictions at most points of the prior where the largest one does.
    """
    chain, eye = replace(system, caller=replace(cast(Caller, system.caller))).chain(table, ()), np.eye(system.n_params)
    about, out = chain.predict(system.theta(system.starts), table), np.full(system.n_params, DIFFERENCE)

    def changed(step: float) -> BoolArray:
        """Return at which points, of which coordinates: (n_params, n_points)."""
        theta = system.theta((system.starts - step * eye[:, None]).reshape(-1, system.n_params))
        with np.errstate(invalid="ignore"):  # between two infinite readings there is no change
            change = chain.predict(theta, table).reshape(system.n_params, *about.shape) - about
        return np.asarray((np.isfinite(change) & (change != 0)).any(axis=2))

    if not (changed(DIFFERENCE).mean(axis=1) > 0.5).all():
        there = changed(_COARSE[0])
        for step in (*_COARSE, DIFFERENCE):
            out[2 * (changed(step) & there).sum(axis=1) >= there.sum(axis=1)] = step
    return out


def _fit_from_best_starts(system: System, recording: Recording, law: NoiseLaw) -> Fit:
    """Fit a few steps from every start, then to convergence from the best, `_starts_from_partial_runs` and `modes_of`.

    A mode of the density in the priors' own coordinates leads where the evidence is larger, by Laplace's method.
    """
    model = Model(system, (), recording.plan)
    tried = _best_fits(model, recording, list(system.starts), law, max_steps=_STEPS_TRIED)
    longer = _starts_from_partial_runs(model, recording)
    if longer or not all(found.settled for found in tried):
        tried = _best_fits(model, recording, [*(found.z for found in tried), *longer], law)
    best = tried[0]
    if system.first is None and _broadcasts(system):
        for found in fit_each_start(model, recording, list(modes_of(system, recording, law, best.z)[0]), law):
            if log_evidence_of(found, law) > log_evidence_of(best, law) + 0.5:  # nats
                best = found
    return best


def _broadcasts(system: System) -> bool:
    return system.caller is not None and system.caller.broadcasts


def _starts_from_partial_runs(model: Model, recording: Recording) -> list[FloatArray]:
    """Return starts of a fit, (n_params,) each: the best three fits to the beginning of every run.

    A quarter of the longest run's duration is fitted first, then half of it. There are no starts without a time, with
    too few readings, or if predictions are costly. For an oscillating system the objective has a local minimum for
    every period by which a run can be wrong; over the first quarter of a run there are few.
    """
    system, table = cast(System, model.sensor), cast(RunTable, recording.plan)
    if not (system.predicts_in_bulk and table.has_varying_time):
        return []
    since = time_since_start_of_run(table)
    starts = list(system.starts)
    for share in (0.25, 0.5):
        begun = since <= share * since.max()
        part = recording.with_readings(np.where(begun, recording.readings, np.nan))
        if (part.usable & ~part.censored).sum() < system.least_readings:
            return []
        law = white_noise_of_recording(part)
        starts = [found.z for found in _best_fits(model, part, starts, law, max_steps=_STEPS_TRIED)]
    return starts


def _best_fits(model: Model, recording: Recording, starts: list[FloatArray], law: NoiseLaw, **steps: int) -> list[Fit]:
    """Return the best few fits, the best first."""
    found = fit_each_start(model, recording, starts, law, **steps)
    return sorted(found, key=lambda each: each.objective if np.isfinite(each.objective) else np.inf)[:_BEST_STARTS]


def modes_of(system: System, recording: Recording, law: NoiseLaw, found: FloatArray) -> tuple[FloatArray, int]:
    """Return the modes of the posterior density in the priors' own coordinates, (n_modes, n_params), and how many tie.

    In its own coordinate, the value or its logarithm, a bounded prior is flat; a normal one has its own density. Of
    modes that are equally high, as of exchangeable terms, the one nearest to the middle of the prior is first; after
    these come the lower ones. They are in standard-normal coordinates. Levenberg-Marquardt descends from many points
    of the prior at once if predictions cost little, else from one fit, of coordinates `found` (n_params,). The noise sd
    is the likeliest everywhere.
    """
    descent = _Descent(system, recording, law)
    x, n_steps = descent.from_normal(found[None, :]), _POLISH_FEW
    if _broadcasts(system):
        points, n_steps = AT_ONCE // len(recording), _POLISH
        scattered = descent.from_normal(system.scattered_points(int(np.clip(16 * points, 50, _SCREENED))))
        heights = descent.heights(descent.residuals(scattered), scattered)[0]
        kept = np.argsort(heights)[: int(np.clip(points // (system.n_params + 1), 8, _DESCENTS))]
        x = np.concatenate([x, scattered[kept]])
        for n, n_kept in _STAGES:
            x, heights = descent.follow(x, n)
            x = x[np.argsort(heights)[:n_kept]]
    x, heights = descent.follow(x, n_steps, central=True)
    x, heights = x[np.isfinite(heights)], heights[np.isfinite(heights)]
    if not len(x):
        return np.clip(found, -FARTHEST, FARTHEST)[None, :], 1
    z = np.clip(np.where(descent.flat, ndtri(np.where(descent.flat, x, 0.5)), x), -FARTHEST, FARTHEST)
    # The error of a height by rounding is no small one where readings are met to their last digits.
    rms = np.exp(heights.min() / law.n_kept)
    rounding = float(np.finfo(np.float64).eps * law.n_kept * np.abs(descent.readings).max() / rms)
    even = heights <= heights.min() + _EVENLY_HIGH + rounding
    out: list[int] = []
    for k in np.lexsort((np.where(even, np.sum(z**2, axis=1), heights), ~even)).tolist():
        if all(np.abs(x[k] - x[j]).max() > 1e-4 for j in out):
            out.append(k)
    return z[out], int(even[out].sum())


class _Descent:
    """Levenberg-Marquardt from many points at once, in coordinates in which bounded priors are flat.

    A coordinate is the share of its prior below the value, from 0 to 1, or standard normal if the prior has no bounds.
    """

    def __init__(self, system: System, recording: Recording, law: NoiseLaw) -> None:
        self.system, self.law, self.model = system, law, Model(system, (), recording.plan)
        self.usable, self.readings = np.flatnonzero(recording.usable), recording.readings[recording.usable]
        self.flat = np.array([isinstance(prior, Uniform | LogUniform) for prior in system.marginals.values()])
        self.low, self.high = np.where(self.flat, 0.0, -FARTHEST), np.where(self.flat, 1.0, FARTHEST)
        self.per_block = max(AT_ONCE // len(recording), 1)

    def from_normal(self, z: FloatArray) -> FloatArray:
        return np.where(self.flat, ndtr(z), z)

    def residuals(self, x: FloatArray) -> FloatArray:
        """Return whitened residuals, (..., n_params) -> (..., n_usable)."""
        u = np.where(self.flat, x, ndtr(x)).reshape(-1, x.shape[-1])
        blocks = np.array_split(u, -(-len(u) // self.per_block))
        part, at = self.model.part_that_predicts(self.usable)
        with np.errstate(all="ignore"):
            out = [
                self.law((self.readings - self.model.chain.predict(theta, part)[:, at]).T).T
                for theta in map(self.system.prior.from_unit_cube, blocks)
            ]
        return np.concatenate(out).reshape(*x.shape[:-1], -1)

    def heights(self, residuals: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return minus the log density at points, of whitened residuals, and the likeliest variance, (k,) both."""
        with np.errstate(all="ignore"):
            variance = np.maximum(np.sum(residuals**2, axis=-1) / self.law.n_kept, LEAST_SCALE**2)
            height = 0.5 * self.law.n_kept * np.log(variance) + 0.5 * np.sum(np.where(self.flat, 0.0, x) ** 2, axis=-1)
        return np.where(np.isfinite(height), height, np.inf), variance

    def _look(self, x: FloatArray, *, central: bool) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return residuals (k, n), slopes of the readings (k, n_params, n), variances and heights, (k,), at points."""
        steps = np.where(x > 0.5 * (self.low + self.high), -_DIFFERENCE, _DIFFERENCE) * (10.0 if central else 1.0)
        steps = steps * np.asarray(self.system.differences) / DIFFERENCE
        apart = steps[:, :, None] * np.eye(x.shape[1])
        sides = [x[:, None], x[:, None] + apart, *([x[:, None] - apart] if central else [])]
        ends = [1, 1 + x.shape[1]][: len(sides) - 1]
        own, up, *down = np.split(self.residuals(np.concatenate(sides, axis=1)), ends, axis=1)
        with np.errstate(all="ignore"):
            slopes = (down[0] - up) / (2 * steps[:, :, None]) if central else (own - up) / steps[:, :, None]
        residuals = own[:, 0]
        height, variance = self.heights(residuals, x)
        wrong = ~(np.isfinite(height) & np.isfinite(slopes).all(axis=(1, 2)))
        height[wrong], variance[wrong], residuals[wrong], slopes[wrong] = np.inf, 1.0, 0.0, 0.0
        return residuals, slopes, variance, height

    def follow(self, x: FloatArray, n_steps: int, *, central: bool = False) -> tuple[FloatArray, FloatArray]:
        """Descend from each point; return where to, (k, n_params), and minus the log density there, (k,)."""
        x, damping, n_still = x.copy(), np.full(len(x), 1e-2), np.zeros(len(x))
        now = self._look(x, central=central)
        eye, of_prior = np.eye(x.shape[1]), np.where(self.flat, 0.0, 1.0)
        for _ in range(n_steps):
            go = np.flatnonzero(n_still < 8)  # steps
            if not go.size:
                break
            residuals, slopes, variance, height = (values[go] for values in now)
            at = x[go]
            curvature = slopes @ slopes.transpose(0, 2, 1) + (variance[:, None] * of_prior)[:, :, None] * eye
            downhill = np.einsum("kpn,kn->kp", slopes, residuals) - variance[:, None] * of_prior * at
            held = ((at <= self.low) & (downhill < 0)) | ((at >= self.high) & (downhill > 0))
            scale = np.sqrt(np.maximum(np.einsum("kpp->kp", curvature), LEAST_SCALE))
            curvature = np.where(held[:, :, None] | held[:, None], eye, curvature / scale[:, :, None] / scale[:, None])
            damped = curvature + (damping[go, None, None] + _ROUNDING) * eye
            step = np.linalg.solve(damped, np.where(held, 0.0, downhill / scale)[:, :, None])[:, :, 0] / scale
            longest = 0.3 * (self.high - self.low)  # step of a coordinate
            to = np.clip(at + np.clip(step, -longest, longest), self.low, self.high)
            then = self._look(to, central=central)
            with np.errstate(invalid="ignore"):
                gain = np.nan_to_num(height - then[3], nan=0.0)
            better = gain > 0
            for values, new in zip((x, *now), (to, *then), strict=True):
                values[go[better]] = new[better]
            n_still[go] = np.where(better & (gain > _STILL), 0, n_still[go] + 1)
            damping[go] = np.clip(damping[go] * np.where(better, 1 / 6, 5.0), 1e-14, 1e8)
        return x, now[3]


def is_noise_sd_known_beside_misfit(simulator: Simulator, table: RunTable) -> bool:
    """Return whether the noise sd is declared, or successive readings tell it: not from residuals alone."""
    return simulator.noise.sd is not None or rows_are_in_order(simulator, table)


def _noise_sd_of(simulator: Simulator, table: RunTable, recording: Recording, found: Fit) -> float:
    known = simulator.declared_sd(table)
    if known is not None:
        return float(known)
    rough = rough_sd(recording) if rows_are_in_order(simulator, table) else 0.0  # sorted, successive ones are too alike
    return min(found.sd, rough) if rough > 0 else found.sd


_WRONG = 1.0  # noise sds, rms, by which half the step changes predictions where the step fails
_REACH = 3.0  # sds of a parameter about its best value: what is further off has no share of the posterior


def with_step_for_likely_parameters(system: System, table: RunTable, found: Fit, sd: float) -> System:
    """Return the system with a step that integrates the law three sds of a shared parameter off the fit, too.

    The sds are those of Laplace's approximation. If this takes more than 4,096 steps beyond one per row, the step stays
    longer, and `system.integrations.too_stiff` is set. A system without a law, or of which the step does not fail
    there, is returned as it is. `sd` is that of a reading.
    """
    if system.simulator.law is None:
        return system
    sds = np.linalg.norm(covariance_root(found.slopes, sd**2), axis=1)
    shared = [name in system.simulator.parameters for name in system.marginals]  # not of one run, as where it starts
    apart = _REACH * np.diag(sds)[shared]
    theta = system.theta(np.clip(found.z + np.concatenate([apart, -apart]), -FARTHEST, FARTHEST))
    try:
        if with_converged_step(system, table, theta, tolerance=_WRONG * sd) is not system:
            return with_converged_step(system, table, theta, tolerance=STANDS_STILL * sd)
    except ParameterError:
        system.integrations.too_stiff = True
    return system


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


def _note_on_gaps_without_runs(simulator: Simulator, table: RunTable) -> tuple[str, ...]:
    """Return a note where the time of a law's table, without runs, has gaps longer than all the rest; else ()."""
    if simulator.law is None or table.run is not None or not table.has_varying_time:
        return ()
    gaps = np.diff(table.time_s)
    long = np.flatnonzero(gaps > 20 * np.median(gaps[gaps > 0]))
    if gaps[long].sum() <= 0.5 * gaps.sum():
        return ()
    at = table.row_name(int(long[0]))
    said = f"the time jumps by {gaps[long[0]]:.4g} {simulator.time_unit} after row {at}"
    return (f"{said}; if separate runs begin at such jumps, a column that names them, and run = its name, say so",)


def _note_on_copied_rows(table: RunTable) -> tuple[str, ...]:
    """Return a note if each row of a table is there several times, as where it was pasted twice; else ()."""
    like_first = np.all([values == values[0] for values in table.columns.values()], axis=0)
    if like_first.sum() < 2:
        return ()  # before all rows of a long table are counted
    times = {*Counter(zip(*(values.tolist() for values in table.columns.values()), strict=True)).values()}
    if len(times) > 1 or times == {1}:
        return ()
    said = f"each row is there {times.pop()} times, and counts as often: if it was taken once, every sd is too small"
    return (f"{said}; delete the copies",)


def _without_copies_of_reading(simulator: Simulator, table: RunTable) -> RunTable:
    """Leave out, with a note, columns that are the reading in another unit, unless the simulator reads them."""
    readings, inputs = table.covariates.get(simulator.reading), simulator.inputs(table.covariates)
    if readings is None:
        return table
    for name in sorted(inputs.keys() - {*simulator.controls}):
        if says_what_readings_say(inputs[name], readings):
            less = replace(table, columns={k: v for k, v in table.columns.items() if k != name})
            with contextlib.suppress(ProbewiseError):
                System.of(simulator, less)
                table = replace(less, notes=(*less.notes, f"column {name} left out: {SAYS_THE_SAME}"))
    return table


def without_unpredictable_readings(system: System, recording: RunRecording, *, every_row: bool = False) -> RunRecording:
    """Leave out, with a note, the readings of rows in which a missing column makes a prediction impossible.

    Missing values of all columns are interpolated from the other rows of the run, so that effects with a memory, such
    as backlash, are defined in later rows; if `every_row`, also those that only effects read. Readings there are left
    out too unless that would cost more than a tenth, as of a column that was logged less often.

    Raises ParameterError if the simulator gives no finite reading in a row where no column is missing: one with a
    reading or, if `every_row`, any, since the change by an effect would not be finite there.
    """
    table, law = cast(RunTable, recording.plan), system.simulator.law
    there = np.isfinite(system.chain(table, ()).predict(system.theta(system.starts), table))
    unpredictable = ~there[there.any(axis=1)].any(axis=0) if there.any() else np.ones(len(table), dtype=np.bool_)
    lost = unpredictable & recording.usable
    inputs, missing = system.simulator.inputs(table.covariates), np.zeros(len(table), dtype=np.bool_)
    filled = system.simulator.interpolated_inputs(table)
    for values in inputs.values():
        missing |= ~np.isfinite(values)
    if not unpredictable.any() and not (every_row and filled):
        return recording
    gaps = np.flatnonzero(missing)
    if law is not None:  # what is missing once is missing to the end of its run
        for rows in table.rows_by_scan():
            missing[rows] = np.maximum.accumulate(missing[rows])
    wrong = np.flatnonzero((unpredictable if every_row else lost) & ~missing)
    if wrong.size:
        where = f"no finite reading in {len(wrong)} of {len(table)} rows, first in row {table.row_name(wrong[0])}"
        way_out = (
            "a table without these rows" if law is None else "for a state far faster than the rows its equilibrium"
        )
        allowed = f"a finite reading in each row somewhere in the prior, or {way_out}"
        raise ParameterError("simulate" if law is None else "rates", where, allowed)
    recording = replace(recording, plan=cast(Plan, table.with_columns(filled)))
    for name in filled if every_row else ():
        beside = recording.usable & ~lost & ~np.isfinite(inputs[name])
        if 0 < beside.sum() <= 0.1 * recording.usable.sum():  # the rest tells the noise nearly as well
            readings = count_with_noun(int(beside.sum()), "reading")
            recording = _without_readings(recording, beside, f"{readings} left out: column {name!r} is missing there")
        elif beside.any():
            note = f"column {name!r} is missing at {int(beside.sum())} readings; it is interpolated within each run"
            recording = replace(recording, notes=(*recording.notes, note))
    if not lost.any():
        return recording
    why = "simulator reads is missing there"
    if law is not None:
        more = f" and {len(gaps) - 1} more" if len(gaps) > 1 else ""
        why = f"law reads is missing in row {table.row_name(gaps[0])}{more}, and a law ends at the first gap of its "
        why += "run; fill the gaps in to use them"
    note = f"{count_with_noun(int(lost.sum()), 'reading')} left out: a column that the {why}"
    return _without_readings(recording, lost, note)


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

    def diagnosed(simulator: Simulator, *, stiff: bool = False, sought: frozenset[str] | None = None) -> Diagnosis:
        prepared = prepare_system(simulator, table, source=source, notes=notes, progress=progress, stiff=stiff)
        prepared = replace(prepared, sought=sought)
        caller = cast(SimulatorApparatus, prepared.apparatus).system.caller
        told = progress_with_call_count(progress, caller)
        searched = None
        if prepared.has_too_little_data:  # the verdict is that they cannot tell, whatever a search would find
            prior = prepared.apparatus.prior_odds(prepared.effects)
            searched = replace(search(replace(prepared, effects={}), prior=prior, progress=told), prepared=prepared)
        diagnosis = diagnose_prepared(prepared, searched=searched, thorough=thorough, progress=told, rng=rng)
        if caller is not None:
            caller.on_call = None  # what the result is asked later is no progress of this diagnosis
        return diagnosis

    diagnosis = diagnosed(simulator)
    needed = finer_step_for_repair(diagnosis)
    if needed is None:
        return diagnosis
    step, stiff = needed
    assert simulator.law is not None
    progress(f"once more, with integration steps of {step:.3g} {simulator.time_unit}, which the repaired law needs")
    # Finer steps cost more, and move evidences by a few nats: hypotheses nine nats behind need no second search.
    sought = frozenset(n for h in diagnosis.hypotheses if h.probability > 1e-4 for n in h.effects)
    return diagnosed(replace(simulator, law=replace(simulator.law, max_step_s=step)), stiff=stiff, sought=sought)


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
    table = _without_copies_of_reading(simulator, table) if with_effects else table
    order = (*_note_on_copied_rows(table), *note_on_row_order(simulator, table))
    codes = notes_on_codes({n: values for n, values in table.covariates.items() if n != simulator.reading})
    said = (*table.notes, *notes, *order, *codes, *_note_on_gaps_without_runs(simulator, table))
    recording = replace(recording_from_table(simulator, table), source=source or simulator.source, notes=said)
    system = System.of(simulator, table, stiff=stiff)
    if with_effects and len(table) < 2:  # nothing can change along it
        raise ParameterError("the table", "one row", f"{system.least_readings} rows or more, not all readings equal")
    plan, recording = recording.plan, without_unpredictable_readings(system, recording, every_row=with_effects)
    if recording.plan is not plan:
        table = replace(table, columns=cast(RunTable, recording.plan).columns)
    left_out = list[NoiseEffect]()
    if (stop := find_meter_stop(as_recording(simulator, table), simulator.reading)) is not None:
        recording, left_out = cast(RunRecording, stop.left_out_of(recording)), [stop.effect]
    least = system.least_readings if with_effects else system.n_params + 1
    n_usable, n_within = int(recording.usable.sum()), int((recording.usable & ~recording.censored).sum())
    if n_usable < (1 if with_effects else least):
        raise ParameterError("usable readings", n_usable, f"{least} or more in column {simulator.reading}")
    if recording.censored.any() and n_within < least:
        allowed = f"{least} or more: readings at its ends do not determine the noise"
        raise ParameterError("readings within the declared range", n_within, allowed)
    told = progress_with_call_count(progress, system.caller)
    told("fitting the simulator")
    plain = system
    system, found, sd = fit_system(plain, recording)
    covariates = SimulatorApparatus(ReferenceFit(system, table, found.z, sd)).covariates_and_predicted_slope
    lost = find_lost_readings(found.model, recording, found, list(system.starts), covariates, sd=sd)
    if lost is not None:
        told("fitting the simulator without lost readings")
        left_out.append(lost.effect(recording))
        recording = cast(RunRecording, lost.left_out_of(recording))
        system, found, sd = fit_system(plain, recording)
    beside_ends = without_readings_near_ends(system, found, sd, recording)
    if beside_ends is not recording:
        recording, known = beside_ends, is_noise_sd_known_beside_misfit(simulator, table)
        system = replace(system, first=found.z, slack=NEAR_END * sd if known else 0.0)
        system, found, sd = fit_system(system, recording)
    misfit = float(np.sqrt(np.mean(found.residuals**2))) / sd
    conflicts = tuple(notes_on_prior_conflict(system, found, white_noise_of_recording(recording)))
    apparatus = SimulatorApparatus(ReferenceFit(system, table, found.z, sd, misfit=misfit), tuple(left_out))
    if (sorting := sorting_column(apparatus.about)) is not None:
        told_of = f"what jumps or wanders from row to row may change with {sorting} instead"
        conflicts = (*conflicts, f"rows are sorted by {sorting}: {told_of}")
    recording = replace(recording, notes=(*recording.notes, *conflicts))
    begun = replace(system, first=found.z)
    told("building the effects")
    effects = apparatus.effects(recording, begun) if with_effects else {}
    return Prepared(recording, effects, begun, apparatus, recording)


def notes_on_calls(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return notes on calls of a simulator, or the integration of its law, and on its declared noise; else ()."""
    apparatus = diagnosis.apparatus
    if not isinstance(apparatus, SimulatorApparatus):
        return ()
    noise_sd = diagnosis.repaired.noise_sd if diagnosis.noise.model == "white" else None
    return tuple(notes_on_simulator(apparatus, noise_sd))


def notes_on_simulator(apparatus: SimulatorApparatus, noise_sd: FloatArray | None) -> Iterator[str]:
    """Yield notes on what its function or law did not predict, or not exactly, and on a noise sd that it declares.

    `noise_sd`: samples of it, (n_samples,), or None.
    """
    system, declared = apparatus.system, apparatus.system.simulator.noise.sd
    caller, done, law = system.caller, system.integrations, system.simulator.law
    if noise_sd is not None and declared is not None and not isinstance(declared, str):
        mean, sd, unit = float(np.mean(noise_sd)), float(np.std(noise_sd)), system.simulator.unit
        if abs(mean - declared) > max(_FAR * sd, (_MUCH - 1) * declared):
            found = f"{mean:.3g} ± {sd:.1g} {unit}".rstrip()
            yield f"the noise sd of a reading is {found}, though {declared:g} was declared"
    if caller is not None and caller.cut_short:
        yield (
            f"simulate takes one sample at a time: after {CALLS_OF_A_SEARCH:,} calls some promising combinations of "
            "effects were not fitted; if simulate takes arrays, the search is complete"
        )
    if done.cut_short:
        way_out = "a larger max_step_s, shorter runs" if law is not None and law.max_step_s else "shorter runs"
        yield (
            f"integrating the law takes long: after {apparatus.evaluations_of_a_search:,} evaluations of its rates "
            f"some promising combinations of effects were not fitted; with {way_out} or fewer rows the search is "
            "complete"
        )
    if done.too_stiff:
        yield (
            "the law is stiff: parameters that may fit the readings would need more integration steps than are taken, "
            "and count as impossible; their intervals may be too narrow; set a shorter max_step_s, or write simulate "
            "with an integrator of your own"
        )
    what, n_failed, n_odd = "rates", done.n_failed, 0
    if caller is not None:
        what, n_failed, n_odd = "simulate", caller.n_failed, caller.n_not_finite
    for did, n in (("raised an error", n_failed), ("gave readings that are not finite", n_odd)):
        if n:
            yield f"{what} {did} for {n:,} parameter vectors, which count as impossible"
    if caller is not None and caller.interpolated:
        yield (
            f"simulate takes no array of {', '.join(sorted(caller.interpolated))}: each reading is interpolated "
            "between fixed values, as if the parameter had had that row's value from the start; if earlier rows affect "
            "later ones, let simulate take arrays, or write a law"
        )


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
        theta = model.theta[:4]  # samples for which the step is halved
        still = with_converged_step(system, table, theta, effects, tolerance=tolerance, or_finest=True)
    except ParameterError:  # a friction or a bound that no step meets exactly
        return None
    needed = still.max_step, still.stiff
    return needed if needed != (system.max_step, system.stiff) else None
