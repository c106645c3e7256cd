"""Join several recordings of one apparatus."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from probewise._arrays import FloatArray, own_arithmetic
from probewise.errors import ParameterError
from probewise.recordings.patterns import Pattern, have_same_albedo
from probewise.recordings.plan import Plan, Recording, require_recording
from probewise.sensor import COMMANDED, with_declared_height_commanded
from probewise.systems.table import unused_name


@own_arithmetic
def join(recordings: Sequence[Recording]) -> Recording:
    """Concatenate recordings: scans remain distinct, and so do patterns of one name with different descriptions.

    A covariate of the first, such as battery voltage, keeps its last known value in recordings that lack it; one that
    the first lacks is left out. The range and step that the first declares count for all; readings of a recording that
    declares another height than the first are at that height, if both declare one. Notes say so. Times are unchanged.

    Raises
    ------
    ParameterError
        If there is no recording, readings are in different units, or two recordings are the same.
    """
    if isinstance(recordings, str) or not isinstance(recordings, Sequence):
        require_recording(recordings)
    if not recordings:
        raise ParameterError("recordings", (), "one or more")
    for recording in recordings:
        require_recording(recording)
    first = recordings[0]
    if len(recordings) == 1:
        return first
    for other in recordings[1:]:
        if other.plan.instrumentation.unit != first.plan.instrumentation.unit:
            raise ParameterError(
                "reading unit", other.plan.instrumentation.unit, f"{first.plan.instrumentation.unit!r}, as the first"
            )
    for (i, one), (j, other) in itertools.combinations(enumerate(recordings), 2):
        if _is_same_recording(one, other):
            found = f"{_recording_label(one, i)} (number {i + 1}) and {_recording_label(other, j)} (number {j + 1})"
            raise ParameterError("recordings", found, "recordings that differ; these are the same")
    notes = [note for recording in recordings for note in recording.notes]
    return Recording(
        join_plans([recording.plan for recording in recordings], own_sessions=True),
        np.concatenate([np.where(r.usable, r.readings, np.nan) for r in recordings]),
        " + ".join(r.source for r in recordings if r.source),
        (*notes, *_notes_on_missing_covariates(recordings), *_notes_on_other_instrumentation(recordings)),
    )


def join_plans(plans: Sequence[Plan], *, own_sessions: bool = False) -> Plan:
    """Concatenate plans, with the covariates of the first and commanded columns (LED, height) of all.

    Commanded columns are NaN (as at calibration) where a plan lacks them, unless it declares another height than the
    first; other covariates keep their last known value. With `own_sessions`, or if any plan has sessions (numbers of
    the recordings joined in it), they are numbered on, and a plan without sessions is one.
    """
    first = plans[0]
    plans = [with_declared_height_commanded(plan, first.instrumentation.height_mm) for plan in plans]
    patterns: dict[str, Pattern] = {}
    names: list[str] = []
    scan_names: list[str] = []
    codes, scans = [], []
    for plan in plans:
        renamed = []
        for name in plan.pattern_names:
            described = plan.patterns.get(name)
            own = name
            if described is not None and name in patterns and patterns[name] is not described:
                own = name if _is_same_pattern(patterns[name], described) else unused_name(name, {*names, *patterns})
            if described is not None:
                patterns[own] = described
            if own not in names:
                names.append(own)
            renamed.append(names.index(own))
        codes.append(np.array(renamed, dtype=np.int64)[plan.pattern])
        scans.append(plan.scan + len(scan_names))
        scan_names += _unused_scan_names(plan.scan_names, scan_names)
    commanded = {name for plan in plans for name in plan.covariates if name in COMMANDED}
    return Plan(
        x_mm=np.concatenate([p.x_mm for p in plans]),
        y_mm=np.concatenate([p.y_mm for p in plans]),
        orientation_rad=np.concatenate([p.orientation_rad for p in plans]),
        time_s=np.concatenate([p.time_s for p in plans]),
        scan=np.concatenate(scans),
        scan_names=tuple(scan_names),
        pattern=np.concatenate(codes),
        pattern_names=tuple(names),
        patterns=patterns,
        covariates={name: _joined_covariate(plans, name) for name in sorted({*first.covariates, *commanded})},
        instrumentation=first.instrumentation,
        sessions=_joined_sessions(plans) if own_sessions or any(plan.sessions for plan in plans) else (),
    )


def _unused_scan_names(names: Sequence[str], taken: Sequence[str]) -> list[str]:
    """Return a plan's scan names, those that are taken renamed; names that differ stay different."""
    new: dict[str, str] = {}
    for name in dict.fromkeys(names):
        new[name] = unused_name(name, {*taken, *new.values(), *({*names} - {name})})
    return [new[name] for name in names]


def _joined_sessions(plans: Sequence[Plan]) -> tuple[int, ...]:
    """Return, for each of the joined scans, the number of the recording that it is from."""
    found: list[int] = []
    for plan in plans:
        before = max(found, default=-1) + 1
        found += [before + session for session in plan.sessions or (0,) * len(plan.scan_names)]
    return tuple(found)


def last_known_value(values: FloatArray, otherwise: float = math.nan) -> float:
    """Return the last finite value of a covariate; `otherwise` if there is none."""
    known = values[np.isfinite(values)]
    return float(known[-1]) if known.size else otherwise


def _joined_covariate(plans: Sequence[Plan], name: str) -> FloatArray:
    """Return a covariate of every row; where a plan lacks it, NaN if commanded, else its last known value."""
    columns: list[FloatArray] = []
    last = math.nan
    for plan in plans:
        column = plan.covariates.get(name)
        if column is None:
            column = np.full(len(plan), math.nan if name in COMMANDED else last)
        last = last_known_value(column, last)
        columns.append(column)
    return np.concatenate(columns)


def _notes_on_missing_covariates(recordings: Sequence[Recording]) -> list[str]:
    """List notes on covariates that some recordings lack."""
    first, out = recordings[0], []
    for k, other in enumerate(recordings[1:], 1):
        for name in sorted({*first.plan.covariates} - {*other.plan.covariates, *COMMANDED}):
            out.append(f"{_recording_label(other, k)} has no column {name}: taken to be there as it was last known")
        for name in sorted({*other.plan.covariates} - {*first.plan.covariates, *COMMANDED}):
            out.append(f"column {name} of {_recording_label(other, k)} left out: {_recording_label(first, 0)} has none")
    return out


def _notes_on_other_instrumentation(recordings: Sequence[Recording]) -> list[str]:
    """List notes on each range, step or height that a later recording declares otherwise than the first."""
    first, out = recordings[0], []
    for k, other in enumerate(recordings[1:], 1):
        for name in ("min", "max", "step", "height_mm"):
            own, taken = (getattr(recording.plan.instrumentation, name) for recording in (other, first))
            if own == taken:
                continue
            label, value = _recording_label(other, k), "no value" if own is None else f"{own:g}"
            if name == "height_mm" and own is not None and taken is not None:
                as_taken = f"{_recording_label(first, 0)} {taken:g}: readings are taken to be at the height of each"
                out.append(f"{label} declares {value} for height_mm, {as_taken}")
            else:
                as_first = "none, as" if taken is None else f"{taken:g}, that of"
                out.append(f"{label} declares {value} for {name}: taken is {as_first} {_recording_label(first, 0)}")
    return out


def _is_same_pattern(one: Pattern, other: Pattern) -> bool:
    """Return whether two patterns have the same kind and values; of an image, the name of its file too."""
    return have_same_albedo(one, other) and getattr(one, "file", None) == getattr(other, "file", None)


def _is_same_recording(one: Recording, other: Recording) -> bool:
    """Return whether two recordings hold the same readings at the same poses and times, with the same commands."""
    first, second = one.plan.covariates, other.plan.covariates
    commanded = {*COMMANDED, *one.plan.instrumentation.controls} & {*first, *second}
    return (
        len(one) == len(other)
        and np.array_equal(one.readings, other.readings, equal_nan=True)
        and all(
            np.array_equal(getattr(one.plan, k), getattr(other.plan, k))
            for k in ("x_mm", "y_mm", "orientation_rad", "time_s")
        )
        and all(k in first and k in second and np.array_equal(first[k], second[k], equal_nan=True) for k in commanded)
    )


def _recording_label(recording: Recording, index: int) -> str:
    return recording.source or f"recording {index + 1}"
