"""`probewise arm record`: carry out a plan and write the recording, with a check of each sheet by its readings."""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise._signals import reporting_what_is_kept
from probewise._writing import checked_output_file, is_device_or_pipe
from probewise.arm import (
    Geometry,
    Reading,
    carry_out,
    readings_of_recording,
    recording_of_readings,
)
from probewise.arm.carry_out import BY_HAND_S, duration_s
from probewise.arm.geometry import wrapped_to_pi
from probewise.calibration import read_sensor
from probewise.cli import _bench
from probewise.cli._common import message_to_resume, print_warning, progress_of, say
from probewise.cli._inputs import read_or_shipped_plan
from probewise.cli._options import SHIPPED, parse_place, refuse_options
from probewise.errors import FileError, shown
from probewise.recordings import Pattern, Plan, Recording, read_plan_and_readings, write_recording
from probewise.recordings.files import pictures_to_write
from probewise.recordings.patterns import have_same_albedo
from probewise.scene import region_of

_OFF_PLAN_MM = 5.0  # tolerance, since a user's own instrument may report the true place
_OFF_PLAN_RAD = math.radians(5.0)  # and the true orientation
_LEGO_OFF_PLAN_RAD = math.radians(47.0)  # a LEGO mount turns by right angles, so that up to 45 degrees are left

_SEES_MM = 14.0  # radius of the sensor's view
_SHARE = 0.05  # least contrast of white and black, as a share of the larger
_OFF = 0.35  # largest deviation from a level, as a share of the contrast; beyond any noise
_COLOURS = {True: "white", False: "black"}
_AROUND_MM = np.stack(
    [
        radius * np.array([math.cos(turn), math.sin(turn)])
        for radius in (0.0, _SEES_MM / 2, _SEES_MM)
        for turn in np.arange(8) * math.pi / 4
    ]
)


def record_plan(arguments: argparse.Namespace, geometry: Geometry) -> None:
    """Take the plan's readings, each kept on disk at once; a person or the bench lays the sheets."""
    out = checked_output_file(arguments.out, *([] if arguments.plan in SHIPPED else [Path(arguments.plan)]))
    chosen = None if arguments.arm is None else _bench.parse_arm(arguments.arm)
    is_own = chosen is not None and chosen.kind == "file"
    plan = _plan_for_arm(arguments, geometry, is_own=is_own)
    width, height = (0.0, 0.0) if is_own else geometry.field_mm
    origin = (width / 2, height / 2) if arguments.origin_mm is None else parse_place("--origin-mm", arguments.origin_mm)
    at_end = is_device_or_pipe(out)  # which takes the recording once
    taken: list[Reading] = []
    if not arguments.dry_run and not at_end:
        taken = _earlier_readings(out, plan, resume=arguments.resume, is_lego=chosen is None or chosen.is_lego)

    def kept_message() -> str:
        if at_end:
            return f"nothing was kept: {out} takes whole recordings"
        resume = partial(message_to_resume, out, lambda: len(_read_unfinished_recording(out)), "reading")
        return resume(arguments, "--resume", of=len(plan))

    start_s = taken[-1].time_s if taken else 0.0
    instrument, bench = _bench.open_instrument(arguments, geometry, start_s=start_s, n_taken=len(taken))
    with reporting_what_is_kept(kept_message), instrument as arm:
        check = SheetCheck(plan, white_is_bright=not is_own)
        ask: Callable[[Any], None]
        if bench is not None:
            ask = partial(bench.carry_out_request, plan.patterns, origin)
        elif arguments.dry_run:
            ask = _bench.prompter_unless_dry_run(arguments, arm)
        else:
            arm.mounted_rad = math.nan  # an earlier process may have left the sensor turned
            ask = _bench.prompter(arm)
            seconds = duration_s(arm, plan, origin_mm=origin, first=len(taken))
            about = f"{len(plan) - len(taken)} readings, about {seconds / 60:.0f} minutes"
            say(arguments, f"{about}; including {BY_HAND_S:g} s for each step by hand")
        readings = carry_out(arm, plan, origin_mm=origin, ask=ask, first=len(taken))
        with progress_of(arguments, beat=False) as progress:
            progress("readings", len(taken), len(plan))
            for reading in readings:
                wrong = check.complaint_about_reading(len(taken), reading.value)
                if wrong is not None and not arguments.dry_run:
                    print_warning(f"{wrong}; is the right sheet there, the right way round?")
                taken.append(reading)
                progress("readings", len(taken), len(plan))
                if not arguments.dry_run and not at_end:
                    write_recording(recording_of_readings(plan, taken), out)
    if not arguments.dry_run:
        if at_end:
            write_recording(recording_of_readings(plan, taken), out)
        say(arguments, f"{len(taken)} readings: {out}")


def _plan_for_arm(arguments: argparse.Namespace, geometry: Geometry, *, is_own: bool) -> Plan:
    """Read the plan and adapt it to the arm, or to the sensor of --sensor."""
    plan = read_or_shipped_plan(arguments.plan)
    if is_own:
        return _bench.plan_for_own_instrument(plan, unit=arguments.unit, range_=arguments.range, step=arguments.step)
    if arguments.sensor is not None:
        return _bench.without_measured_covariates(plan, read_sensor(arguments.sensor).instrumentation)
    refuse_options(arguments, "the LEGO arm: it is known", "unit", "range", "step")
    return _bench.plan_for_lego_arm(plan, geometry)


# Readings of an earlier session


def _read_unfinished_recording(path: Path) -> Recording:
    """Read the recording of an earlier session, all of whose readings may be missing; FileError if it is a plan."""
    plan, readings = read_plan_and_readings(path)
    if readings is None:
        raise FileError(path, "no column of readings: this is a plan", "a recording, or another --out")
    return Recording(plan, readings, str(path))


def _earlier_readings(out: Path, plan: Plan, *, resume: bool, is_lego: bool) -> list[Reading]:
    """List the readings of an earlier session, from `out`, which was begun with this plan; none without `resume`."""
    if not resume:
        for path in (out, out.with_suffix(".json"), *pictures_to_write(plan.patterns, out.parent)):
            if path.exists():
                raise FileError(path, "the file exists already", "--resume to continue it, or another --out")
        return []
    before = _read_unfinished_recording(out)
    difference = next(_differences(before.plan, plan, _LEGO_OFF_PLAN_RAD if is_lego else _OFF_PLAN_RAD), None)
    if difference is not None:
        raise FileError(out, difference, "the plan and options of the session that began it; or another --out")
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


class SheetCheck:
    """A check of each sheet that a person lays against its pattern, by the readings over its uniform white and black.

    `white_is_bright`: whether white is known to read higher than black, as with the LEGO light sensor.
    """

    def __init__(self, plan: Plan, *, white_is_bright: bool) -> None:
        self._plan, self._bright = plan, white_is_bright
        self._read: dict[bool, list[float]] = {True: [], False: []}
        self._reported: set[tuple[str, bool]] = set()
        places = np.stack([plan.x_mm, plan.y_mm], axis=-1)
        self._shades = np.full(len(plan), math.nan)
        for name, rows in plan.rows_by_pattern():
            self._shades[rows] = uniform_shades_at_places(plan.patterns[name], places[rows])

    def complaint_about_reading(self, row: int, value: float) -> str | None:
        """Return a complaint, one a sheet and shade, if the reading of a plan's row contradicts its sheet's pattern."""
        shade = self._shades[row]
        if math.isnan(shade) or math.isnan(value):
            return None
        name, is_white = self._plan.pattern_names[int(self._plan.pattern[row])], bool(shade)
        own, other = self._read[is_white], self._read[not is_white]
        if not (other and self._contradicts(is_white, value)):
            own.append(value)
            return None
        if (name, is_white) in self._reported:
            return None
        self._reported.add((name, is_white))
        place = f"({self._plan.x_mm[row]:g}, {self._plan.y_mm[row]:g}) mm"
        here, there = (_COLOURS[shade] for shade in (is_white, not is_white))
        wrong = f"reads {value:g}, where {there} read {np.median(other):g}"
        wrong += f" and {here} {np.median(own):g}" if own else ""
        return f"sheet {name!r} contradicts its pattern: at {place} it is {here}, and {wrong}"

    def _contradicts(self, is_white: bool, value: float) -> bool:
        """Return whether a reading over one shade is far from earlier ones of it, or on the wrong side of the other."""
        own, opposite = self._read[is_white], float(np.median(self._read[not is_white]))
        if own:
            level = float(np.median(own))
            least = max(_OFF * abs(opposite - level), _SHARE * max(abs(level), abs(opposite)))
            return abs(value - level) > least
        return self._bright and (value - opposite) * (1 if is_white else -1) < _SHARE * max(abs(value), abs(opposite))


def uniform_shades_at_places(pattern: Pattern, places_mm: FloatArray) -> FloatArray:
    """Return the shade that the sensor sees at each place, (n, 2), as (n,): 1 all white, 0 all black, else NaN."""
    seen = (places_mm[:, None, :] + _AROUND_MM).reshape(-1, 2)
    albedo = region_of(pattern).albedo(seen)[0].reshape(len(places_mm), len(_AROUND_MM))
    low, high = albedo.min(axis=1), albedo.max(axis=1)
    return np.where((low == high) & ((low >= 1) | (high <= 0)), np.clip(low, 0.0, 1.0), math.nan)
