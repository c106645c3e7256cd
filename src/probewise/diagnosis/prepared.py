"""Input of a diagnosis: recordings joined, of long ones a few thousand readings, possible effects, and the null."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray, IntArray, own_arithmetic
from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.fit import Model, Null, fit_each_start
from probewise.diagnosis.noise import rough_sd, white_noise_of_recording
from probewise.diagnosis.outlying import LostReadings, find_lost_readings
from probewise.diagnosis.sensors import (
    LEAST_READINGS,
    SensorPrior,
    default_sensor,
    require_same_unit,
    require_sensor_prior,
    sensor_from_samples,
    starts_of_one_gaussian,
)
from probewise.effects import Effect, Extent
from probewise.effects.noise import LARGEST_SIZE, SAYS_THE_SAME, says_what_readings_say
from probewise.errors import ParameterError, require
from probewise.recordings.patterns import Pattern, have_same_albedo
from probewise.recordings.plan import Plan, Recording, require_patterns_described, require_recording
from probewise.sensor import COMMANDED, Stage, with_declared_height_commanded
from probewise.systems.table import unused_name


@own_arithmetic
def join(recordings: Sequence[Recording]) -> Recording:
    """Concatenate recordings: scans remain distinct, and so do patterns of one name with different descriptions.

    A covariate of the first, such as battery voltage, keeps its last known value in recordings that lack it; one that
    the first lacks is left out. The range and step that the first declares count for all; readings of a recording that
    declares another height than the first are at that height, if both declare one. Notes say so. Times are unchanged.
    Raises ParameterError if there is no recording, readings are in different units, or two recordings are the same.
    """
    if isinstance(recordings, str) or not isinstance(recordings, Sequence):
        require_recording(recordings)
    require(recordings, "recordings", (), "one or more")
    for recording in recordings:
        require_recording(recording)
    if len(recordings) == 1:
        return recordings[0]
    unit = recordings[0].plan.instrumentation.unit
    for other in recordings[1:]:
        if other.plan.instrumentation.unit != unit:
            raise ParameterError("reading unit", other.plan.instrumentation.unit, f"{unit!r}, as the first")
    labels = [recording.source or f"recording {k + 1}" for k, recording in enumerate(recordings)]
    for i, j in itertools.combinations(range(len(recordings)), 2):
        if _is_same_recording(recordings[i], recordings[j]):
            found = f"{labels[i]} (number {i + 1}) and {labels[j]} (number {j + 1})"
            raise ParameterError("recordings", found, "recordings that differ; these are the same")
    plans = [recording.plan for recording in recordings]
    notes = [note for recording in recordings for note in recording.notes]
    return Recording(
        join_plans(plans, own_sessions=True),
        np.concatenate([np.where(r.usable, r.readings, np.nan) for r in recordings]),
        " + ".join(r.source for r in recordings if r.source),
        (*notes, *_notes_on_differences(plans, labels)),
    )


_POSES = ("x_mm", "y_mm", "orientation_rad", "time_s")


def join_plans(plans: Sequence[Plan], *, own_sessions: bool = False) -> Plan:
    """Concatenate plans, with the covariates of the first and commanded columns (LED, height) of all.

    Commanded columns are NaN (as at calibration) where a plan lacks them, unless it declares another height than the
    first; other covariates keep their last known value. With `own_sessions`, or if any plan has sessions (numbers of
    the recordings joined in it), they are numbered on, and a plan without sessions is one.
    """
    first = plans[0]
    plans = [with_declared_height_commanded(plan, first.instrumentation.height_mm) for plan in plans]
    patterns, names, scan_names = dict[str, Pattern](), list[str](), list[str]()
    codes, scans, sessions = [], [], list[int]()
    for plan in plans:
        renamed = []
        for name in plan.pattern_names:
            own, described, known = name, plan.patterns.get(name), patterns.get(name)
            if described is not None and known is not None and known is not described:
                # Of the same kind and values and, of an image, the name of its file.
                same = have_same_albedo(known, described)
                same = same and getattr(known, "file", None) == getattr(described, "file", None)
                own = name if same else unused_name(name, {*names, *patterns})
            if described is not None:
                patterns[own] = described
            if own not in names:
                names.append(own)
            renamed.append(names.index(own))
        codes.append(np.array(renamed, dtype=np.int64)[plan.pattern])
        scans.append(plan.scan + len(scan_names))
        # Names that are taken change; names that differ stay different.
        new: dict[str, str] = {}
        for name in dict.fromkeys(plan.scan_names):
            new[name] = unused_name(name, {*scan_names, *new.values(), *({*plan.scan_names} - {name})})
        scan_names += [new[name] for name in plan.scan_names]
        before = max(sessions, default=-1) + 1
        sessions += [before + session for session in plan.sessions or (0,) * len(plan.scan_names)]
    commanded = {name for plan in plans for name in plan.covariates if name in COMMANDED}
    return Plan(
        **{name: np.concatenate([getattr(plan, name) for plan in plans]) for name in _POSES},
        scan=np.concatenate(scans),
        scan_names=tuple(scan_names),
        pattern=np.concatenate(codes),
        pattern_names=tuple(names),
        patterns=patterns,
        covariates={name: _joined_covariate(plans, name) for name in sorted({*first.covariates, *commanded})},
        instrumentation=first.instrumentation,
        sessions=tuple(sessions) if own_sessions or any(plan.sessions for plan in plans) else (),
    )


def last_known_value(values: FloatArray, otherwise: float = math.nan) -> float:
    """Return the last finite value of a covariate; `otherwise` if there is none."""
    known = values[np.isfinite(values)]
    return float(known[-1]) if known.size else otherwise


def _joined_covariate(plans: Sequence[Plan], name: str) -> FloatArray:
    """Return a covariate of every row; where a plan lacks it, NaN if commanded, else its last known value."""
    columns, last = list[FloatArray](), math.nan
    for plan in plans:
        lacking = np.full(len(plan), math.nan if name in COMMANDED else last)
        columns.append(plan.covariates.get(name, lacking))
        last = last_known_value(columns[-1], last)
    return np.concatenate(columns)


def _notes_on_differences(plans: Sequence[Plan], labels: Sequence[str]) -> Iterator[str]:
    first = plans[0].covariates.keys()
    for other, label in zip(plans[1:], labels[1:], strict=True):
        for name in sorted(first - {*other.covariates, *COMMANDED}):
            yield f"{label} has no column {name}: taken to be there as it was last known"
        for name in sorted(other.covariates.keys() - {*first, *COMMANDED}):
            yield f"column {name} of {label} left out: {labels[0]} has none"
        for name in ("min", "max", "step", "height_mm"):
            own, taken = (getattr(plan.instrumentation, name) for plan in (other, plans[0]))
            if own == taken:
                continue
            declares = f"{label} declares {'no value' if own is None else f'{own:g}'} for {name}"
            if name == "height_mm" and own is not None and taken is not None:
                yield f"{declares}, {labels[0]} {taken:g}: readings are taken to be at the height of each"
            else:
                yield f"{declares}: taken is {'none, as' if taken is None else f'{taken:g}, that of'} {labels[0]}"


def _without_copies_of_reading(recording: Recording) -> Recording:
    """Leave out, with a note, covariates that are the reading in another unit, unless they were commanded."""
    plan, usable = recording.plan, recording.usable
    own = plan.covariates.keys() - {*COMMANDED, *plan.instrumentation.controls}
    same = [k for k in own if says_what_readings_say(plan.covariates[k][usable], recording.readings[usable])]
    if not same:
        return recording
    kept = {name: values for name, values in plan.covariates.items() if name not in same}
    notes = [f"column {name} left out: {SAYS_THE_SAME}" for name in sorted(same)]
    return replace(recording, plan=replace(plan, covariates=kept), notes=(*recording.notes, *notes))


def _is_same_recording(one: Recording, other: Recording) -> bool:
    """Return whether two recordings hold the same readings at the same poses and times, with the same commands."""
    first, second = one.plan.covariates, other.plan.covariates
    commanded = {*COMMANDED, *one.plan.instrumentation.controls} & {*first, *second}
    return (
        len(one) == len(other)
        and np.array_equal(one.readings, other.readings, equal_nan=True)
        and all(np.array_equal(getattr(one.plan, k), getattr(other.plan, k)) for k in _POSES)
        and all(k in first and k in second and np.array_equal(first[k], second[k], equal_nan=True) for k in commanded)
    )


MOST_DIAGNOSED_READINGS = 2400
_STRETCH = 6  # readings
_CONTRAST = 5.0  # sds of the noise, of readings that a sensor can be seen not to predict
_SEED = 0  # the same rows of the same recording, whatever the seed of its diagnosis


def rows_to_diagnose(recording: Recording) -> IntArray:
    """Choose rows spread over the recording with about 2,400 usable readings; all rows if there are no more.

    Whole scans are chosen, to preserve correlations between readings; or, if these would be fewer than eight, stretches
    of six successive rows. Both are spread evenly but not regularly, so that what repeats itself is seen at all phases.

    Returns row numbers, ascending.
    """
    n_usable, scan, n_scans = int(recording.usable.sum()), recording.plan.scan, len(recording.plan.scan_names)
    if n_usable <= MOST_DIAGNOSED_READINGS:
        return np.arange(len(recording))
    share = MOST_DIAGNOSED_READINGS / n_usable
    n_kept = math.floor(n_scans * share)
    if n_kept >= 8:
        # One of each n_scans / n_kept, with the first and the last: scans that go there and back must not all go there.
        jitter = np.random.default_rng(_SEED).random(n_kept)
        kept = np.floor((np.arange(n_kept) + jitter) * n_scans / n_kept).astype(np.int64)
        kept[[0, -1]] = 0, n_scans - 1
        return np.flatnonzero(np.isin(scan, kept))
    return positions_in_stretches(scan, round(len(recording) * share))


def positions_in_stretches(run: IntArray, most: int) -> IntArray:
    """Choose about `most` of some rows in stretches of six neighbours of one run; all if there are no more.

    The gaps between stretches are a half to one and a half of their mean, the same for every table of this length: with
    equal gaps a table that repeats itself, as by the hour, may show the same hours in every stretch.

    `run`: number of each row's run, (n_rows,). Neighbours are successive rows of a run, also where runs are
    interleaved. Returns row numbers, ascending.
    """
    n_rows, n_stretches = len(run), round(most / _STRETCH)
    if n_rows <= most:
        return np.arange(n_rows)
    gaps = np.cumsum(0.5 + np.random.default_rng(_SEED).random(n_stretches + 1))
    slack = n_rows - n_stretches * _STRETCH
    first = _STRETCH * np.arange(n_stretches) + np.floor(slack * gaps[:-1] / gaps[-1]).astype(np.int64)
    by_run = np.argsort(run, kind="stable")
    own = run[by_run][first + _STRETCH // 2]  # a stretch over the end of a run is moved into it, if it is long enough
    begin, end = np.searchsorted(run[by_run], own, side="left"), np.searchsorted(run[by_run], own, side="right")
    first = np.where(end - begin >= _STRETCH, np.clip(first, begin, end - _STRETCH), first)
    return np.unique(by_run[first[:, None] + np.arange(_STRETCH)])


@dataclass(frozen=True, eq=False)
class Prepared:
    """Input of a diagnosis.

    `recording`: the readings used; `effects`: effects that could act in them, by name; `null`: the null model; None:
    calibrated from the recording; `apparatus`: the apparatus that took the readings; `everything`: all readings; the
    same as `recording` if all are used; `sought`: names of the effects on the mean that a search tries, without a limit
    on its cost; None: all, within the budget of the apparatus.
    """

    recording: Recording
    effects: Mapping[str, Effect]
    null: Null | None
    apparatus: Apparatus
    everything: Recording
    sought: frozenset[str] | None = None

    @property
    def is_thinned(self) -> bool:
        """Whether only some readings are used."""
        return self.everything is not self.recording

    def is_refit_budget_spent(self, share: float = 1.0) -> bool:
        """Return whether this share of the apparatus' budget is spent; a search of few effects has no limit."""
        return self.sought is None and self.apparatus.is_refit_budget_spent(share)

    @cached_property
    def usable_rows(self) -> IntArray:
        """Rows with a usable reading, (n_usable,)."""
        return np.flatnonzero(self.recording.usable)

    @cached_property
    def usable_rows_of_everything(self) -> IntArray:
        """Rows of `everything` with a reading that is used, (n_usable,)."""
        return rows_to_diagnose(self.everything)[self.usable_rows] if self.is_thinned else self.usable_rows

    @cached_property
    def noise_effect_names(self) -> frozenset[str]:
        """Names of the effects on the noise."""
        return frozenset(name for name, effect in self.effects.items() if effect.stage is Stage.NOISE)

    @property
    def least_readings(self) -> int:
        """Fewest usable readings for a verdict."""
        return LEAST_READINGS if self.null is None else self.null.least_readings

    @property
    def has_only_equal_readings(self) -> bool:
        """Whether all usable readings are equal."""
        return float(np.ptp(self.recording.readings[self.usable_rows])) == 0.0

    @property
    def has_too_little_data(self) -> bool:
        """Whether the readings are too few for a verdict, or all equal; those at an end of the range do not count."""
        n_informative = len(self.usable_rows) - int(self.recording.censored[self.usable_rows].sum())
        n_informative += len(self.recording.left_out)
        return n_informative < self.least_readings or self.has_only_equal_readings

    def expand_usable_to_all_rows(self, values: FloatArray) -> FloatArray:
        """Expand values of usable readings to all rows, NaN elsewhere: (n_usable,) -> (n_points,)."""
        out = np.full(len(self.recording), np.nan)
        out[self.usable_rows] = values
        return out


def prepare(
    recordings: Recording | Sequence[Recording],
    *,
    sensor: SensorPrior | None = None,
    null: Null | None = None,
    apparatus: Apparatus,
) -> Prepared:
    """Join recordings, thin out long ones, and let the apparatus build the effects; errors as in `diagnose`."""
    if sensor is not None and null is not None:
        raise ParameterError("sensor, null", "both", "one of them: a null contains the prior of its sensor")
    if sensor is not None:
        require_sensor_prior(sensor)
    everything = _without_copies_of_reading(join([recordings] if isinstance(recordings, Recording) else recordings))
    if null is None:
        require_patterns_described(everything.plan)
    if sensor is not None:
        require_same_unit(sensor, everything.plan)
        null = sensor_from_samples(sensor)
        there = Model(null, (), everything.plan).predict(np.zeros((1, null.n_params)))[0]
        usable, read = everything.usable, everything.readings
        if np.mean((read - there)[usable] ** 2) > np.var(read[usable]) > (_CONTRAST * rough_sd(everything)) ** 2:
            note = "the sensor given predicts these readings worse than their mean does: are they its own?"
            everything = replace(everything, notes=(*everything.notes, note))
    rows = rows_to_diagnose(everything)

    def chosen() -> Recording:
        return everything if len(rows) == len(everything) else everything.take(rows)

    recording, of_lost = chosen(), dict[str, Effect]()
    lost = _lost_readings(recording, null, apparatus) if recording.usable.sum() >= LEAST_READINGS else None
    if lost is not None:
        effect = lost.effect(recording)
        of_lost[effect.name] = effect
        everything = replace(lost, rows=rows[lost.rows]).left_out_of(everything)
        recording = chosen()
    return Prepared(recording, {**apparatus.effects(recording, null), **of_lost}, null, apparatus, everything)


def _lost_readings(recording: Recording, null: Null | None, apparatus: Apparatus) -> LostReadings | None:
    """Find lost readings about the null, or about one Gaussian with a prior scaled to readings that are not far out.

    Nothing is fitted unless a reading differs from the two before or after it by more than widest outliers do.
    """
    rough, readings = rough_sd(recording), recording.readings
    usable = np.flatnonzero(recording.usable)
    if np.abs(np.diff(readings[usable], 2)).max() <= LARGEST_SIZE * rough:
        return None
    low, middle, high = np.quantile(readings[usable], [0.1, 0.5, 0.9])
    wild = np.flatnonzero(recording.usable & (np.abs(readings - middle) > 5.0 * (high - low)))  # no scale of a prior
    if null is None:
        kept = replace(recording, left_out=(*recording.left_out, *wild.tolist()))
        null = default_sensor(Extent.of(kept), 1)
        starts = starts_of_one_gaussian(null)
    else:
        starts = null.starts
    model = Model(null, (), recording.plan)
    law = replace(white_noise_of_recording(recording), lost=np.isin(usable, wild))
    first = min(fit_each_start(model, recording, list(starts), law), key=lambda found: found.objective)
    if not np.isfinite(first.objective):
        return None
    return find_lost_readings(model, recording, first, [], apparatus.covariates_and_predicted_slope, sd=rough)
