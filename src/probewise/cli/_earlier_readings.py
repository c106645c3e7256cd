"""Readings of an earlier session of `arm record`, and whether this session continues the same recording."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from probewise.arm.geometry import wrapped_to_pi
from probewise.errors import FileError, shown
from probewise.recordings.patterns import have_same_albedo

if TYPE_CHECKING:
    from probewise.arm import Reading
    from probewise.recordings import Plan, Recording

OFF_PLAN_MM = 5.0  # tolerance, since a user's own instrument may report the true place
OFF_PLAN_RAD = math.radians(5.0)  # and the true orientation
LEGO_OFF_PLAN_RAD = math.radians(47.0)  # a LEGO mount turns by right angles, so that up to 45 degrees are left


def read_unfinished_recording(path: Path) -> Recording:
    """Read the recording of an earlier session, all of whose readings may be missing.

    Raises FileError if it cannot be used.
    """
    from probewise.recordings import Recording, read_plan_and_readings

    plan, readings = read_plan_and_readings(path)
    if readings is None:
        raise FileError(path, "no column of readings: this is a plan", "a recording, or another --out")
    return Recording(plan, readings, str(path))


def earlier_readings(out: Path, plan: Plan, *, resume: bool, is_lego: bool) -> list[Reading]:
    """List the readings of an earlier session, from `out`; none without `resume`.

    Parameters
    ----------
    out
        File of the recording.
    plan
        The plan of this session, with the instrumentation of its arm.
    resume
        Whether the file is to be continued.
    is_lego
        Whether the arm is the LEGO arm, whose sensor stands up to 45 degrees from the planned orientation.

    Raises
    ------
    FileError
        If the file exists without `resume`, or it was begun with another plan or another description of its readings.
    """
    from probewise.arm import readings_of_recording

    if not resume:
        if out.exists():
            raise FileError(out, "the file exists already", "--resume to continue it, or another --out")
        return []
    before = read_unfinished_recording(out)
    off_rad = LEGO_OFF_PLAN_RAD if is_lego else OFF_PLAN_RAD
    difference = next(_differences(before.plan, plan, off_rad), None)
    if difference is not None:
        raise FileError(out, difference, "the plan and options of the session that began it; or another --out")
    return readings_of_recording(before)


def _differences(before: Plan, plan: Plan, off_rad: float) -> Iterator[str]:
    """Yield what differs between an earlier session's rows and this plan's first ones, one phrase each."""
    if len(before) > len(plan):
        yield f"readings of another plan: it has {len(before)} rows, this plan {len(plan)}"
        return
    first = plan.take(np.arange(len(before)))
    turned_rad = np.abs(wrapped_to_pi(before.orientation_rad - first.orientation_rad))
    rows = {
        "x_mm": np.abs(before.x_mm - first.x_mm) > OFF_PLAN_MM,
        "y_mm": np.abs(before.y_mm - first.y_mm) > OFF_PLAN_MM,
        "orientation": turned_rad > off_rad,
        "scan": before.scan != first.scan,
        "pattern": np.array(_pattern_names_by_row(before)) != np.array(_pattern_names_by_row(first)),
    }
    for name, differs in rows.items():
        if differs.any():
            yield f"readings of another plan: the {name} of reading {1 + int(differs.argmax())} differs"
    for name in dict.fromkeys(_pattern_names_by_row(before)):
        there, here = before.patterns[name], plan.patterns[name]
        if not have_same_albedo(there, here):
            yield f"readings of another plan: pattern {name!r} is {shown(there)} there, {shown(here)} here"
    for field in dataclasses.fields(plan.instrumentation):
        values = [getattr(each.instrumentation, field.name) for each in (before, plan)]
        if values[0] != values[1] and field.name != "description":
            yield f"{field.name} is {values[0]!r} there, {values[1]!r} here"


def _pattern_names_by_row(plan: Plan) -> list[str]:
    return [plan.pattern_names[code] for code in plan.pattern]
