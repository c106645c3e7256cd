"""Several recordings of one apparatus, diagnosed together."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from probewise.errors import ParameterError
from probewise.recordings.patterns import Pattern
from probewise.recordings.plan import Plan, Recording
from probewise.sensor import COMMANDED

__all__ = ["join"]


def join(recordings: Sequence[Recording]) -> Recording:
    """Set recordings behind each other: scans stay apart, patterns of one name but two descriptions too.

    Only covariates that all recordings have are kept; what is commanded (LED, height) is NaN, as at
    calibration, where a recording does not say. Times stay as they are in each file.

    Raises
    ------
    ParameterError
        If there is none, or their readings are in different units.
    """
    if not recordings:
        raise ParameterError("recordings", (), "one or more")
    first = recordings[0]
    if len(recordings) == 1:
        return first
    for other in recordings[1:]:
        if other.plan.instrumentation.unit != first.plan.instrumentation.unit:
            raise ParameterError(
                "reading unit", other.plan.instrumentation.unit, f"{first.plan.instrumentation.unit!r}, as the first"
            )
    patterns: dict[str, Pattern] = {}
    names: list[str] = []
    scan_names: list[str] = []
    codes, scans = [], []
    for number, recording in enumerate(recordings):
        plan = recording.plan
        renamed = []
        for name in plan.pattern_names:
            described = plan.patterns.get(name)
            own = name
            if described is not None and name in patterns and patterns[name] is not described:
                own = name if repr(patterns[name]) == repr(described) else f"{name} ({number + 1})"
            if described is not None:
                patterns[own] = described
            if own not in names:
                names.append(own)
            renamed.append(names.index(own))
        codes.append(np.array(renamed, dtype=np.int64)[plan.pattern])
        scans.append(plan.scan + len(scan_names))
        scan_names += [_unused(s, scan_names) for s in plan.scan_names]
    plans = [r.plan for r in recordings]
    shared = set.intersection(*({*p.covariates, *COMMANDED} for p in plans)) & {k for p in plans for k in p.covariates}
    joined = Plan(
        x_mm=np.concatenate([p.x_mm for p in plans]),
        y_mm=np.concatenate([p.y_mm for p in plans]),
        orientation_rad=np.concatenate([p.orientation_rad for p in plans]),
        time_s=np.concatenate([p.time_s for p in plans]),
        scan=np.concatenate(scans),
        scan_names=tuple(scan_names),
        pattern=np.concatenate(codes),
        pattern_names=tuple(names),
        patterns=patterns,
        covariates={
            k: np.concatenate([p.covariates.get(k, np.full(len(p), np.nan)) for p in plans]) for k in sorted(shared)
        },
        instrumentation=first.plan.instrumentation,
    )
    readings = np.concatenate([np.where(r.usable, r.readings, np.nan) for r in recordings])
    joined_recording = Recording(joined, readings, first.source, tuple(n for r in recordings for n in r.notes))
    return replace(joined_recording, source=" + ".join(r.source for r in recordings if r.source))


def _unused(name: str, taken: Sequence[str]) -> str:
    """Count up until a name is free."""
    numbered = (f"{name} ({k})" for k in itertools.count(2))
    return next(n for n in itertools.chain([name], numbered) if n not in taken)
