"""Carry out a plan with the real arm: row after row, with a person who turns the sensor and changes the pattern."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from probewise.arm.instrument import Pose, Reading
from probewise.arm.lego import LegoArm
from probewise.arm.reach import require_reach
from probewise.errors import ParameterError
from probewise.recordings.plan import Plan, Recording

__all__ = ["carry_out", "recorded"]

QUARTER_RAD = math.pi / 2  # a LEGO mount turns by right angles


def carry_out(
    arm: LegoArm, plan: Plan, *, origin_mm: tuple[float, float], ask: Callable[[str], None], first: int = 0
) -> Iterator[Reading]:
    """Take a plan's readings, in order.

    The sensor's orientation follows from the arm; the person turns it on its mount by right angles,
    to come as near to the planned orientation as that allows. The reading tells the true one.

    Parameters
    ----------
    arm
        The arm, entered already.
    plan
        Where to read and over what.
    origin_mm
        Where on the field the plan's origin lies, lab frame.
    ask
        Asks a person to do something, and returns when it is done.
    first
        Row to start at: rows before it have been taken.

    Yields
    ------
    A reading for each row, its place the plan's, as commanded, its orientation the true one.

    Raises
    ------
    ReachError
        If the arm cannot take some row; nothing moves.
    ParameterError
        If the plan commands what this arm has not: another height, the LED off.
    """
    places = np.stack([plan.x_mm, plan.y_mm], axis=-1) + np.asarray(origin_mm)
    require_reach(arm.geometry, places, "row of the plan", way_out="; move the plan's origin")
    _require_settings(arm, plan)
    arm.turned_rad = 0.0
    turns = np.rint((plan.orientation_rad - arm.orientation_rad(places)) / QUARTER_RAD) % 4
    mounted, lying = 0, -1
    for row in range(first, len(plan)):
        if plan.pattern[row] != lying:
            lying = int(plan.pattern[row])
            ask(
                f"put pattern {plan.pattern_names[lying]!r} under the arm, its origin at "
                f"({origin_mm[0]:g}, {origin_mm[1]:g}) mm of the field, its x axis along the field's"
            )
        if int(turns[row]) != mounted:
            mounted = int(turns[row])
            ask(
                f"turn the sensor on its mount to {90 * mounted} degrees, anticlockwise seen from above, "
                "from where the geometry has it"
            )
            arm.turned_rad = mounted * QUARTER_RAD
        x_mm, y_mm = places[row]
        reading = arm.measure(Pose(float(x_mm), float(y_mm), float(arm.orientation_rad(places[row : row + 1])[0])))
        there = Pose(float(plan.x_mm[row]), float(plan.y_mm[row]), reading.pose.orientation_rad)
        yield dataclasses.replace(reading, pose=there)


def recorded(plan: Plan, readings: Sequence[Reading]) -> Recording:
    """Write down what was read: the plan's first rows with true orientation, time, battery and height of each.

    Parameters
    ----------
    plan
        The plan.
    readings
        Those of its first rows, one or more, as `carry_out` yields them.
    """
    rows = plan.take(np.arange(len(readings)))
    names = sorted({name for reading in readings for name in reading.covariates})
    covariates = {name: np.array([reading.covariates.get(name, math.nan) for reading in readings]) for name in names}
    taken = dataclasses.replace(
        rows,
        orientation_rad=np.array([reading.pose.orientation_rad for reading in readings]),
        time_s=np.array([reading.time_s for reading in readings]),
        covariates={**rows.covariates, **covariates},
    )
    return Recording(taken, np.array([reading.value for reading in readings]))


def _require_settings(arm: LegoArm, plan: Plan) -> None:
    there = {"led": 1.0, "height_mm": arm.geometry.read_height_mm}
    for name, value in there.items():
        wanted = plan.covariates.get(name, np.empty(0))
        other = wanted[np.isfinite(wanted) & (wanted != value)]
        if other.size:
            raise ParameterError(f"the plan's {name}", float(other[0]), f"{value:g}, which this arm reads at")
