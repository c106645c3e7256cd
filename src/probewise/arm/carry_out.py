"""Execution of a plan by an arm, row by row, with a person who turns the sensor and changes the pattern; recordings."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.arm.geometry import wrapped_to_pi
from probewise.arm.instrument import Instrument, Pose, Reading, require_within_reach
from probewise.arm.lego import LegoArm
from probewise.arm.own import Measures, OwnInstrument, as_instrument
from probewise.arm.simulated import SimulatedArm
from probewise.errors import FileError, ParameterError, shown
from probewise.recordings import read_plan_and_readings
from probewise.recordings.patterns import Pattern, Uniform, have_same_albedo, where_white_in_words
from probewise.recordings.plan import Instrumentation, Plan, Recording

QUARTER_RAD = math.pi / 2  # a LEGO mount turns by right angles
_SAME_TURN_RAD = math.radians(0.5)
BY_HAND_S = 30.0  # to lay a sheet or to turn the sensor
PATTERN = "field"  # under readings of no plan
_OFF_PLAN_MM = 5.0  # tolerance, since a user's own instrument may report the true place
_OFF_PLAN_RAD = math.radians(5.0)  # and the true orientation
_LEGO_OFF_PLAN_RAD = math.radians(47.0)  # a LEGO mount turns by right angles, so that up to 45 degrees are left


@dataclass(frozen=True)
class RequestToPerson:
    """A request to the person at the bench: a sentence, and for a simulated bench what is to be done.

    `pattern` is the name of the pattern to be laid under the arm, `turned_rad` the angle to which the sensor is to be
    turned on its mount, anticlockwise from its usual one; None: unchanged.
    """

    text: str
    pattern: str | None = None
    turned_rad: float | None = None

    def __str__(self) -> str:
        return self.text


def carry_out(
    arm: Instrument | Measures,
    plan: Plan,
    *,
    origin_mm: tuple[float, float],
    ask: Callable[[RequestToPerson], None],
    first: int = 0,
) -> Iterator[Reading]:
    """Take a plan's readings, in order; a person changes the pattern and turns the sensor on its mount.

    The LEGO arm's sensor turns with the base; the person turns the sensor by the right angles that come nearest to the
    planned orientation. With a user's own instrument that cannot turn its sensor, the person turns the sensor to the
    planned orientation. The person is asked whenever the angle on the mount changes, and before row `first` if an
    earlier plan, or earlier rows of this one, turned the sensor. If `arm.mounted_rad` is NaN, as somebody may have
    turned it before, the person is asked too, unless the plan neither turns the sensor nor has a pattern that looks
    different to a turned one.

    `arm` is entered already, or any object with a `measure(pose)`, see `as_instrument`; `origin_mm` the place of the
    plan's origin on the field, lab frame; `ask` shows a `RequestToPerson` to a person and returns when it is
    done; rows before `first` have been taken. Yields a reading for each row, in the plan's frame, at the place and
    orientation that the arm measured, or at the planned ones. Raises ReachError if a row is out of the arm's reach
    (nothing moves); ParameterError if the plan needs the LED off, or a height at which this arm does not read.
    """
    arm = as_instrument(arm, name="arm")
    places = np.stack([plan.x_mm, plan.y_mm], axis=-1) + np.asarray(origin_mm)
    require_within_reach(arm.reach, places, "row of the plan", way_out="; move the plan's origin")
    _require_feasible_settings(arm, plan)
    from_where = "where the geometry has it" if isinstance(arm, LegoArm) else "how it stands by itself"
    turns = _turns_by_hand_rad(arm, plan, places)
    if (turns[:first] > _SAME_TURN_RAD).any():
        arm.mounted_rad = math.nan  # by hand, in an earlier session
    # A sensor that nobody has to turn reads the same over uniform sheets however it stands on its mount.
    uniform = all(isinstance(plan.patterns.get(name), Uniform) for name, _ in plan.rows_by_pattern())
    unturned = arm.turns or (uniform and not (turns > _SAME_TURN_RAD).any())
    does_not_matter = math.isnan(arm.mounted_rad) and unturned
    lying = -1
    for row in range(first, len(plan)):
        if plan.pattern[row] != lying:
            lying = int(plan.pattern[row])
            name = plan.pattern_names[lying]
            where = f"its origin at ({origin_mm[0]:g}, {origin_mm[1]:g}) mm of the field, its x axis along the field's"
            shown = f": {where_white_in_words(plan.patterns[name])}" if name in plan.patterns else ""
            ask(RequestToPerson(f"lay sheet {name!r}, {where}{shown}", pattern=name))
        turned = float(turns[row])
        if not does_not_matter and not abs(turned - arm.mounted_rad) <= _SAME_TURN_RAD:
            text = (
                f"turn the sensor on its mount to {math.degrees(turned):.4g} degrees, anticlockwise seen from above, "
                f"from {from_where}"
            )
            ask(RequestToPerson(text, turned_rad=turned))
            arm.mounted_rad = turned
        reading = _measure_row(arm, places[row], plan, row)
        there, (x_mm, y_mm) = (float(plan.x_mm[row]), float(plan.y_mm[row])), origin_mm
        if (reading.pose.x_mm, reading.pose.y_mm) != (there[0] + x_mm, there[1] + y_mm):  # taken elsewhere: to a micron
            there = round(reading.pose.x_mm - x_mm, 3), round(reading.pose.y_mm - y_mm, 3)
        yield dataclasses.replace(reading, pose=Pose(*there, reading.pose.orientation_rad))


def duration_s(arm: Instrument, plan: Plan, *, origin_mm: tuple[float, float], first: int = 0) -> float:
    """Estimate a plan's duration in seconds, by arguments as of `carry_out`: travel, readings, half a minute by hand.

    Every change of the pattern or of the planned orientation counts as a step by hand, and so does the start.
    """
    places = (np.stack([plan.x_mm, plan.y_mm], axis=-1) + np.asarray(origin_mm))[first:]
    turns, lying = plan.orientation_rad[first:], plan.pattern[first:]
    seconds, here = 0.0, places[:1]
    for place in places:
        seconds += float(arm.travel_s(Pose(*here[0].tolist()), place[None, :])[0])
        here = place[None, :]
    turned_rad = np.abs(np.angle(np.exp(1j * np.diff(turns))))  # 0 for a whole turn
    by_hand = 1 + np.count_nonzero(np.diff(lying)) + np.count_nonzero(turned_rad > _SAME_TURN_RAD)
    return seconds + BY_HAND_S * float(by_hand)


def _turns_by_hand_rad(arm: LegoArm | OwnInstrument | SimulatedArm, plan: Plan, places_mm: FloatArray) -> FloatArray:
    """Return the angle to which a person turns the sensor for each row, (n_points,): 0 if the arm turns it itself.

    The LEGO arm's base turns the sensor, and a person adds 0 to 3 right angles.
    """
    if arm.turns:
        return np.zeros(len(plan))
    if isinstance(arm, LegoArm):
        off = plan.orientation_rad - arm.geometry.orientation_rad(places_mm)
        return np.asarray(np.rint(off / QUARTER_RAD) % 4 * QUARTER_RAD)
    off = (plan.orientation_rad - arm.orientation_rad(places_mm)) % math.tau
    return np.where(math.tau - off < _SAME_TURN_RAD, 0.0, off)


def _measure_row(arm: LegoArm | OwnInstrument | SimulatedArm, place_mm: FloatArray, plan: Plan, row: int) -> Reading:
    """Measure at a row's place, with its orientation and, if the arm can, its height, in the lab frame."""
    x_mm, y_mm = place_mm.tolist()
    if isinstance(arm, LegoArm):
        return arm.measure(Pose(x_mm, y_mm, float(arm.orientation_rad(place_mm[None, :])[0])))
    height_mm = plan.covariates.get("height_mm", np.full(len(plan), np.nan))[row] if arm.lifts else math.nan
    up_mm = None if math.isnan(height_mm) else float(height_mm)
    return arm.measure(Pose(x_mm, y_mm, float(plan.orientation_rad[row]), up_mm))


def recording_of_readings(plan: Plan, readings: Sequence[Reading]) -> Recording:
    """Build a recording of the plan's first rows, with the readings' own places, orientations, times and covariates.

    `readings` are those of its first rows, as `carry_out` yields them. The height of a pose is the covariate
    `height_mm`, unless the reading has its own. A covariate that a reading lacks is the planned one, or NaN if none is
    planned. `Plan.sessions` is left out.
    """
    rows, known = plan.take(np.arange(len(readings))), [covariates_with_height(reading) for reading in readings]
    covariates = dict(rows.covariates)
    for name in sorted({name for own in known for name in own}):
        planned = rows.covariates.get(name, np.full(len(readings), math.nan)).tolist()
        covariates[name] = np.array([own.get(name, usual) for own, usual in zip(known, planned, strict=True)])
    there: dict[str, Any] = {
        name: np.array([getattr(reading.pose, name) for reading in readings])
        for name in ("x_mm", "y_mm", "orientation_rad")
    }
    time_s = np.array([reading.time_s for reading in readings])
    taken = dataclasses.replace(rows, **there, time_s=time_s, covariates=covariates, sessions=())
    return Recording(taken, np.array([reading.value for reading in readings]))


def recording_of(
    readings: Sequence[Reading],
    *,
    patterns: Mapping[str, Pattern] | None = None,
    instrumentation: Instrumentation | None = None,
    source: str = "",
) -> Recording:
    """Convert readings of no plan, in order of time, to a recording of one scan over the pattern "field".

    Covariates are as by `recording_of_readings`. `patterns` is the pattern on the field, {"field": ...}, if known;
    otherwise hypotheses take its place. `source` names the readings in messages.
    """
    none, zeros = np.zeros(len(readings)), np.zeros(len(readings), dtype=np.int64)
    under, of_sensor = patterns or {}, instrumentation or Instrumentation()
    plan = Plan(none, none, none, none, zeros, (PATTERN,), zeros, (PATTERN,), under, instrumentation=of_sensor)
    return dataclasses.replace(recording_of_readings(plan, readings), source=source)


def covariates_with_height(reading: Reading) -> Mapping[str, float]:
    """Return a reading's covariates; `height_mm` is the pose's, if the pose has one and the covariates have none."""
    height_mm = reading.pose.height_mm
    return reading.covariates if height_mm is None else {"height_mm": height_mm, **reading.covariates}


def readings_of_recording(recording: Recording) -> list[Reading]:
    """Return a recording's readings, each with pose, time and covariates: the inverse of `recording_of_readings`."""
    rows = recording.plan
    return [
        Reading(
            float(value),
            Pose(float(rows.x_mm[k]), float(rows.y_mm[k]), float(rows.orientation_rad[k])),
            float(rows.time_s[k]),
            {name: float(values[k]) for name, values in rows.covariates.items()},
        )
        for k, value in enumerate(recording.readings)
    ]


def read_unfinished_recording(path: Path) -> Recording:
    """Read the recording of an earlier session, all of whose readings may be missing; FileError if it is a plan."""
    plan, readings = read_plan_and_readings(path)
    if readings is None:
        raise FileError(path, "no column of readings: this is a plan", "a recording, or another --out")
    return Recording(plan, readings, str(path))


def readings_begun_with(plan: Plan, path: Path, *, is_lego: bool = True) -> list[Reading]:
    """List the readings in the recording of an earlier session; FileError if they are not of this plan's first rows."""
    before = read_unfinished_recording(path)
    difference = next(_differences(before.plan, plan, _LEGO_OFF_PLAN_RAD if is_lego else _OFF_PLAN_RAD), None)
    if difference is not None:
        raise FileError(path, difference, "the plan and options of the session that began it; or another --out")
    return readings_of_recording(before)


def _differences(before: Plan, plan: Plan, off_rad: float) -> Iterator[str]:
    """Yield what differs between an earlier session's rows and this plan's first ones, one phrase each."""
    if len(before) > len(plan):
        yield f"readings of another plan: it has {len(before)} rows, this plan {len(plan)}"
        return
    first = plan.take(np.arange(len(before)))
    names_before, names = (np.array(each.pattern_names)[each.pattern] for each in (before, first))
    rows = {
        "x_mm": np.abs(before.x_mm - first.x_mm) > _OFF_PLAN_MM,
        "y_mm": np.abs(before.y_mm - first.y_mm) > _OFF_PLAN_MM,
        "orientation": np.abs(wrapped_to_pi(before.orientation_rad - first.orientation_rad)) > off_rad,
        "scan": before.scan != first.scan,
        "pattern": names_before != names,
    }
    for name, differs in rows.items():
        if differs.any():
            yield f"readings of another plan: the {name} of reading {1 + int(differs.argmax())} differs"
    for name in dict.fromkeys(names_before.tolist()):
        there, here = before.patterns[name], plan.patterns[name]
        if not have_same_albedo(there, here):
            yield f"readings of another plan: pattern {name!r} is {shown(there)} there, {shown(here)} here"
    for field in dataclasses.fields(plan.instrumentation):
        values = [getattr(each.instrumentation, field.name) for each in (before, plan)]
        if values[0] != values[1] and field.name != "description":
            yield f"{field.name} is {values[0]!r} there, {values[1]!r} here"


def _require_feasible_settings(arm: LegoArm | OwnInstrument | SimulatedArm, plan: Plan) -> None:
    """Raise ParameterError if the plan needs the LED off, or a height at which this arm does not read."""
    height_mm = arm.geometry.read_height_mm if isinstance(arm, LegoArm) else plan.instrumentation.height_mm
    there = {"led": 1.0} | ({} if arm.lifts else {"height_mm": height_mm})
    for name, value in there.items():
        wanted = plan.covariates.get(name, np.empty(0))
        wanted = wanted[np.isfinite(wanted)]
        if value is None and wanted.size:  # an arm that reads at one height, which the plan alone says
            value = float(wanted[0])
        if (wanted != value).any():
            found = float(wanted[wanted != value][0])
            raise ParameterError(f"the plan's {name}", found, f"{value:g} in every row: this arm reads at no other")
