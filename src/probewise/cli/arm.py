"""`probewise arm`: tasks at the bench: check, move and read the arm, fit its geometry, carry out a plan."""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise._signals import reporting_what_is_kept
from probewise._writing import checked_output_file, content_if_there, hold_lock_as_read, is_device_or_pipe
from probewise.arm import (
    Geometry,
    LegoArm,
    Pose,
    Reading,
    carry_out,
    percent_to_lego_units,
    read_geometry,
    recording_of_readings,
    require_within_reach,
    shipped_geometry_path,
)
from probewise.arm.carry_out import BY_HAND_S, duration_s, read_unfinished_recording, readings_begun_with
from probewise.arm.fitting import (
    LEAST_P,
    check_heights,
    fit_geometry,
    read_turns_and_places,
    spread_mark_places,
    write_marks,
)
from probewise.arm.geometry import JOINTS
from probewise.arm.geometry_file import text_with_fitted_values
from probewise.arm.nxt import percent_from_counts
from probewise.calibration import read_sensor
from probewise.cli import _bench
from probewise.cli._common import CommandError, message_to_resume, print_result, print_warning, progress_of, say
from probewise.cli._inputs import read_or_shipped_geometry, read_or_shipped_plan
from probewise.cli._options import SHIPPED, parse_finite_numbers, parse_place, refuse_options
from probewise.errors import FileError, LinkError, ParameterError, ReachError, require
from probewise.recordings import (
    Pattern,
    Plan,
    write_bytes_atomically,
    write_recording,
    write_text_atomically,
)
from probewise.recordings.files import description_text, pictures_to_write
from probewise.scene import region_of

_UNITS = "LEGO units (1 dark to 100 bright)"
_COLUMNS = "x_mm,y_mm,orientation_deg,time_s,reading"
_HEIGHTS, _APART_MM = 9, 1.0  # at which the light is learnt, from that of reading upwards
_STEP_OF_LIGHT = 0.1  # of a reading in all its steps, 0 to 100
STEP_MM = 5.0
_MOST_MM = 60.0  # largest step

_SEES_MM = 14.0  # radius of the sensor's view
_LEAST_CONTRAST = 0.05  # least contrast of white and black, as a share of the larger
_OFF_LEVEL = 0.35  # largest deviation from a level, as a share of the contrast; beyond any noise
_AROUND_MM = np.stack(
    [
        radius * np.array([math.cos(turn), math.sin(turn)])
        for radius in (0.0, _SEES_MM / 2, _SEES_MM)
        for turn in np.arange(8) * math.pi / 4
    ]
)
_HELP = (
    "Enter: 5 mm down; 'down 2', 'up 2', 'x 4', 'y -2.5' or several of them: mm; 'ok': it is over the cross and just "
    "touches; 'seen': it is over the cross, its height is not known; 'skip'"
)
_MOVES = {"x": (1, 0, 0), "y": (0, 1, 0), "up": (0, 0, 1), "down": (0, 0, -1)}


def run(arguments: argparse.Namespace) -> int:
    """Run one task of `probewise arm`; return the exit status."""
    tasks = {
        "check": _report_geometry_and_reach,
        "jog": _jog_joint_or_sensor,
        "fit-geometry": _fit_geometry_to_marks,
        "home": _bring_home,
        "heights": _compare_heights_by_light,
        "read": _print_light_and_battery,
        "scan": _scan_line,
        "record": _record_plan,
    }
    tasks[arguments.task](arguments, read_or_shipped_geometry(arguments))
    return 0


# The tasks


def _report_geometry_and_reach(arguments: argparse.Namespace, geometry: Geometry) -> None:
    """Check a geometry, and a brick: where the arm reaches, and what the brick says."""
    from probewise.report.plots.apparatus import draw_arm_lengths, reach_map
    from probewise.report.plots.canvas import png

    tell = partial(say, arguments)
    out, drawing, own = arguments.out, arguments.drawing, arguments.geometry
    out = out and checked_output_file(out, own)
    drawing = drawing and checked_output_file(drawing, own, out, option="--drawing")
    port = None if arguments.arm is None else _bench.nxt_port(arguments.arm)
    x_mm, y_mm = (np.linspace(0.0, length, n) for length, n in zip(geometry.field_mm, (131, 65), strict=True))
    places = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
    reached = geometry.contains(places)
    require(reached.any(), "reach", "nowhere on the field", "links, heights and limits that reach the field")
    tell(f"reach        {geometry.sentence()}")
    tell(f"field        {reached.mean():.1%} of it within reach")
    _, farthest_mm = geometry.radii_in_reach_mm()
    for name, joint in zip(JOINTS, geometry.joints, strict=True):
        count_mm = farthest_mm / abs(joint.counts_per_rad)
        low, high = math.degrees(joint.low_rad), math.degrees(joint.high_rad)
        of_motor = f"motor {'ABC'[joint.port]}, {low:g} to {high:g} degrees"
        play = f"its play {joint.play_rad * farthest_mm:.1f} mm"
        tell(f"{name:<12} {of_motor}; at {farthest_mm:.0f} mm one count is {count_mm:.2f} mm, {play}")
    known = "not fitted to marks: with home 2 degrees off on both links the sensor hangs up to"
    if geometry.accuracy is not None:
        known = f"fitted to {geometry.accuracy.marks} marks; by 2 sds the sensor may hang"
    tell(f"height       reads {geometry.read_height_mm:g} mm up; {known} {geometry.max_height_error_mm:.1f} mm lower")
    if out is not None:
        standing = np.where(reached, geometry.orientation_rad(places), np.nan).reshape(y_mm.size, x_mm.size)
        write_bytes_atomically(out, png(reach_map(standing, x_mm, y_mm, axis_mm=geometry.axis_mm)))
        tell(f"drawn        {out}")
    if drawing is not None:
        write_bytes_atomically(drawing, png(draw_arm_lengths(geometry)))
        tell(f"drawn        {drawing}")
    if port is None:
        return
    with _bench.open_brick(port) as brick:  # nothing moves
        version, battery_v = brick.version(), brick.battery_mv() / 1000
        firmware = f"{version.firmware_major}.{version.firmware_minor:02d}"
        tell(f"brick        {brick.name()}, firmware {firmware}, battery {battery_v:.2f} V")
        raw_counts = brick.light_sensor(geometry.sensor_port).read()
        value = percent_to_lego_units(percent_from_counts(raw_counts), geometry)
        tell(f"light        {value:g} {_UNITS} at port {geometry.sensor_port + 1}, {raw_counts} raw counts")
        program = brick.running_program()
        if program is not None:
            raise LinkError(f"the program {program} runs on the brick and may move the motors; stop it on the brick")


def _jog_joint_or_sensor(arguments: argparse.Namespace, geometry: Geometry) -> None:
    match arguments.where:
        case [place]:
            x_mm, y_mm = parse_place("WHERE", place)
            if arguments.steps and not arguments.down:
                raise ParameterError("--steps", True, "with --down: the sensor is lowered in steps")
            if arguments.down and not arguments.dry_run and not arguments.steps:
                _bench.warn_if_clearance_doubtful(geometry)
            with _bench.open_lego_arm(arguments, geometry) as arm:
                if arguments.steps and not arguments.dry_run:
                    _bench.confirm_each_step_down(arm)
                (arm.go_down if arguments.down else arm.go_over)(x_mm, y_mm)
                if arguments.down:
                    _print_position(arguments, arm)
                    _bench.prompter_unless_dry_run(arguments, arm)("check place and height before the sensor rises")
                    arm.raise_sensor()
                _print_position(arguments, arm)
        case [joint, text] if joint in JOINTS:
            (degrees,) = parse_finite_numbers("WHERE", text, 1, "a number of degrees")
            with _bench.open_lego_arm(arguments, geometry) as arm:
                arm.turn_joint(JOINTS.index(joint), math.radians(degrees))
                _print_position(arguments, arm)
        case _:
            raise ParameterError("WHERE", " ".join(arguments.where), f"X,Y in mm; or {', '.join(JOINTS)}, and degrees")


def _bring_home(arguments: argparse.Namespace, geometry: Geometry) -> None:
    """Bring all joints home, by themselves or by hand."""
    with _bench.open_lego_arm(arguments, geometry) as arm:
        if arguments.here:
            angles = [f"{name} {math.degrees(j.home_rad):g}" for name, j in zip(JOINTS, geometry.joints, strict=True)]
            arm.release()
            _bench.prompter_unless_dry_run(arguments, arm)(f"bring the arm home by hand, {', '.join(angles)} degrees")
            arm.set_home()
        else:
            arm.home()
        _print_position(arguments, arm)


def _print_position(arguments: argparse.Namespace, arm: LegoArm) -> None:
    (x_mm, y_mm, height_mm), (base, shoulder, elbow) = arm.position_mm, np.degrees(arm.angles_rad)
    angles = f"base {base:.1f}, shoulder {shoulder:.1f}, elbow {elbow:.1f} degrees"
    say(arguments, f"sensor at ({x_mm:.1f}, {y_mm:.1f}) mm, {height_mm:.1f} mm above the surface; {angles}")


def _print_light_and_battery(arguments: argparse.Namespace, geometry: Geometry) -> None:
    with _bench.open_lego_arm(arguments, geometry) as arm:
        value, battery_mv = arm.read_here(), arm.machine.battery_mv()
        if not arguments.dry_run:
            print_result(f"{value:g} {_UNITS}, battery {battery_mv:.0f} mV")


def _scan_line(arguments: argparse.Namespace, geometry: Geometry) -> None:
    """Read along a line; the readings go to standard output as CSV."""
    start, end = parse_place("X,Y", arguments.start), parse_place("X,Y", arguments.end)
    places = np.linspace(start, end, arguments.readings)
    if arguments.arm is None or _bench.parse_arm(arguments.arm).is_lego:  # before connecting to the brick
        require_within_reach(geometry, places, "reading of the scan")
    instrument, _ = _bench.open_instrument(arguments, geometry)
    with instrument as arm:
        require_within_reach(arm.reach, places, "reading of the scan")
        names = ["battery_mv"] if isinstance(arm, LegoArm) else None  # an own instrument's are those of its readings
        if names is not None:
            print_result(",".join((_COLUMNS, *names)))
        for (x_mm, y_mm), standing in zip(places, arm.orientation_rad(places), strict=True):
            reading = arm.measure(Pose(float(x_mm), float(y_mm), float(standing)))
            if names is None:
                names = list(reading.covariates)
                print_result(",".join((_COLUMNS, *names)))
            at, more = reading.pose, (f",{reading.covariates.get(name, math.nan):.9g}" for name in names)
            print_result(
                f"{at.x_mm:.3f},{at.y_mm:.3f},{math.degrees(at.orientation_rad):.3f},{reading.time_s:.3f},"
                f"{reading.value:.9g}{''.join(more)}"
            )


def _compare_heights_by_light(arguments: argparse.Namespace, geometry: Geometry) -> None:
    """Compare by the light over white the sensor's height at each place with that at the first; print differences."""
    if arguments.arm is not None and not _bench.parse_arm(arguments.arm).is_lego:
        raise ParameterError("--arm", arguments.arm, "nxt:PORT, or emulator:TRUE.toml")
    width, height = geometry.field_mm
    places = [parse_place("X,Y", text) for text in arguments.places]
    places = places or [(width / 2, height / 2), *((x, y) for x, y in spread_mark_places(geometry).tolist())]
    require(len(places) >= 2, "X,Y", " ".join(arguments.places), "two places or more: heights are compared")
    require_within_reach(geometry, np.array(places), "place")
    instrument, bench = _bench.open_instrument(arguments, geometry, scene="uniform:1")
    assert isinstance(instrument, LegoArm)
    with instrument as arm:
        if bench is None:
            paper = "lay white matt paper, the same everywhere, over the field, or under each place"
            _bench.prompter_unless_dry_run(arguments, arm)(paper)

        def height_reading_at(place: tuple[float, float], height_mm: float) -> tuple[float, float, float]:
            arm.go_down(*place, height_mm)
            values = np.array([arm.machine.read_percent() for _ in range(arguments.readings)])
            error = max(float(values.std()), _STEP_OF_LIGHT) / math.sqrt(arguments.readings)
            return float(arm.position_mm[2]), float(values.mean()), error

        arm.go_over(*places[0])
        lowest_mm = geometry.read_height_mm
        curve = np.array([height_reading_at(places[0], lowest_mm + _APART_MM * k) for k in range(_HEIGHTS)])
        lights = []
        for place in places[1:]:
            lights.append(height_reading_at(place, lowest_mm))
            if not arguments.dry_run:
                check = check_heights(curve, np.array(lights))
                say(arguments, _height_error_in_words(place, check.off_mm[-1], check.sd_mm[-1]))
    if arguments.dry_run:
        return
    say(
        arguments,
        f"light        falls by {check.per_mm:.1%} with each mm at {lowest_mm:g} mm (in [sensor] of the geometry: "
        f"light_per_mm = {check.per_mm:.3f}); heights are relative to the first place, "
        f"({places[0][0]:g}, {places[0][1]:g}) mm",
    )
    if check.p_value >= LEAST_P:
        say(arguments, f"heights      agree with the counters (p = {check.p_value:.2g})")
        return
    worst = int(np.argmax(np.abs(check.off_mm / check.sd_mm)))
    print_warning(
        f"the light contradicts the heights (p = {check.p_value:.1g}), most at "
        f"{_height_error_in_words(places[1 + worst], check.off_mm[worst], check.sd_mm[worst])}; is the paper the "
        "same everywhere? Then bring the sensor to marks there and fit the geometry again "
        "(probewise arm fit-geometry)"
    )


def _height_error_in_words(place_mm: tuple[float, float], off_mm: float, sd_mm: float) -> str:
    side = "higher" if off_mm > 0 else "lower"
    x_mm, y_mm = place_mm
    return f"({x_mm:g}, {y_mm:g}) mm: it hangs {abs(off_mm):.1f} ± {sd_mm:.1f} mm {side} than its counters say"


# fit-geometry: a person brings the sensor to marks, and the geometry is fitted to them


def _fit_geometry_to_marks(arguments: argparse.Namespace, geometry: Geometry) -> None:
    """Bring the sensor to marks, unless there is no --arm; fit the geometry to them, and write it."""
    source = arguments.geometry or shipped_geometry_path()
    built = None if arguments.arm is None else Path(_bench.parse_arm(arguments.arm).where)
    out = checked_output_file(arguments.out, arguments.geometry, built, arguments.marks)
    require(not arguments.dry_run, "--dry-run", True, "none with fit-geometry: a person directs its moves")
    if arguments.arm is None and arguments.marks is None:
        raise CommandError(f"{_bench.NO_ARM}; or fit existing marks, --marks MARKS.csv")
    if arguments.marks is None and is_device_or_pipe(out):
        raise ParameterError("--out", str(out), "a file, beside which the marks are kept; or name them with --marks")
    kept = out.with_suffix(".marks.csv") if arguments.marks is None else arguments.marks
    if arguments.arm is not None:
        _touch_and_save_marks(
            arguments, geometry, checked_output_file(kept, arguments.geometry, built, option="--marks")
        )
    turned, marks = read_turns_and_places(kept)
    fitted = fit_geometry(geometry, turned, marks, touch_mm=arguments.touch_mm)
    say(arguments, fitted.summary())
    write_text_atomically(out, text_with_fitted_values(source.read_text(encoding="utf-8-sig"), fitted.geometry))
    if not is_device_or_pipe(out):
        read_geometry(out)  # check that edits by hand have not hidden a number
    say(arguments, f"written      {out}; give it as --geometry from now on")


def _touch_and_save_marks(arguments: argparse.Namespace, geometry: Geometry, kept: Path) -> None:
    """Bring the sensor to one mark after another as a person directs; save each at once to the file `kept`."""
    allowed = "nxt:PORT or emulator:TRUE.toml: the arm whose geometry is fitted"
    require(_bench.parse_arm(arguments.arm).is_lego, "--arm", arguments.arm, allowed)
    if kept.exists() and not arguments.resume:
        raise FileError(kept, "the file exists already", "--resume to continue it, or another --marks")
    read = content_if_there(kept)
    taken = np.concatenate(read_turns_and_places(kept), axis=1).tolist() if kept.exists() else []
    done = {(x, y) for *_, x, y, _ in taken}
    marks = [(x, y) for x, y in spread_mark_places(geometry).tolist()]
    instrument, bench = _bench.open_instrument(arguments, geometry, watched=True)
    assert isinstance(instrument, LegoArm)

    kept_message = partial(message_to_resume, kept, taken.__len__, "mark", arguments, "--resume")
    with reporting_what_is_kept(kept_message), hold_lock_as_read(kept, read), instrument as arm:
        answer, tell = _bench.prompter_for_answer(arm), print_result if bench is None else lambda text: None

        def ask_for_move(mark: str) -> str:
            return answer(f"{mark}, sensor {arm.position_mm[2]:.1f} mm up: ")

        if bench is None:
            _bench.prompter(arm)(
                "lay the sheet of marks (probewise sheets marks) on the field, and on each cross in its turn a "
                f"block {arguments.block_mm:g} mm high"
            )
        for number, mark in enumerate(marks, 1):
            if mark in done:
                continue
            ask = partial(ask_for_move, f"mark {number} of {len(marks)} ({mark[0]:g}, {mark[1]:g})")
            if bench is not None:
                ask = partial(bench.answer_at_mark, mark, arguments.block_mm)
            met = bring_to_mark(arm, mark, arguments.block_mm, ask, tell)
            if met is not None:
                taken.append(met)
                write_marks(taken, kept)
                say(arguments, f"mark {number} kept: {kept}")


def bring_to_mark(
    arm: LegoArm, mark_mm: tuple[float, float], block_mm: float, ask: Callable[[], str], tell: Callable[[str], None]
) -> list[float] | None:
    """Bring the sensor over a mark and down to the block on it, as a person directs.

    Return the joints' angles from home (rad), x, y and height of the mark (mm; NaN: not known), None if it is skipped.

    Every move turns the base first and then lowers, as in a reading. `ask` returns the person's answer, "ok", "seen",
    "skip" or a move such as "x 5"; `tell` says what can be answered, and why a move was refused.
    """
    at = (*mark_mm, arm.geometry.travel_height_mm)
    arm.go_down(*at)
    tell(_HELP)
    while True:
        answer = ask().lower()
        if answer == "skip":
            return None
        if answer in ("ok", "seen"):
            homes = np.array([joint.home_rad for joint in arm.geometry.joints])
            return [*(arm.angles_rad - homes).tolist(), *mark_mm, block_mm if answer == "ok" else math.nan]
        moved = place_after_moves(at, answer)
        if moved is None:
            tell(f"{answer!r} says nothing that can be done. {_HELP}")
            continue
        try:
            arm.go_down(*moved)
        except ReachError as error:
            tell(str(error))
            arm.go_down(*at)
        else:
            at = moved


def place_after_moves(at_mm: tuple[float, float, float], answer: str) -> tuple[float, float, float] | None:
    """Return the place (x, y, height in mm) after an answer's moves, such as "x 5 down 2"; None if it is none."""
    words = answer.split() or ["down", str(STEP_MM)]
    x, y, height = at_mm
    if len(words) % 2:
        return None
    for way, text in zip(words[::2], words[1::2], strict=True):
        try:
            by_x, by_y, by_height = (float(text) * share for share in _MOVES[way])
        except (KeyError, ValueError):
            return None
        if not abs(float(text)) <= _MOST_MM:
            return None
        x, y, height = x + by_x, y + by_y, height + by_height
    return x, y, height


# record: a plan is carried out; a person or the bench lays the sheets, and each is checked by its readings


def _record_plan(arguments: argparse.Namespace, geometry: Geometry) -> None:
    """Take the plan's readings, each kept on disk at once; a person or the bench lays the sheets."""
    out = checked_output_file(arguments.out, *([] if arguments.plan in SHIPPED else [Path(arguments.plan)]))
    chosen = None if arguments.arm is None else _bench.parse_arm(arguments.arm)
    is_own = chosen is not None and chosen.kind == "file"
    plan = _plan_for_arm(arguments, geometry, is_own=is_own)
    origin = _bench.origin_of_plan(arguments, geometry, is_own=is_own)
    at_end = is_device_or_pipe(out)  # which takes the recording once
    taken: list[Reading] = []
    unshared: AbstractContextManager[None] = contextlib.nullcontext()
    if not arguments.dry_run and not at_end:
        read = content_if_there(out)
        taken = _earlier_readings(out, plan, resume=arguments.resume, is_lego=chosen is None or chosen.is_lego)
        out.parent.mkdir(parents=True, exist_ok=True)
        unshared = hold_lock_as_read(out, read)

    def kept_message() -> str:
        if at_end:
            return f"nothing was kept: {out} takes whole recordings"
        resume = partial(message_to_resume, out, lambda: len(read_unfinished_recording(out)), "reading")
        return resume(arguments, "--resume", of=len(plan))

    start_s = taken[-1].time_s if taken else 0.0
    instrument, bench = _bench.open_instrument(arguments, geometry, start_s=start_s, n_taken=len(taken))
    with reporting_what_is_kept(kept_message), unshared, instrument as arm:
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


def _earlier_readings(out: Path, plan: Plan, *, resume: bool, is_lego: bool) -> list[Reading]:
    """List the readings of an earlier session, from `out`, which was begun with this plan; none without `resume`.

    The description that a session left which ended before its first reading is in nobody's way.
    """
    if resume and out.exists():
        return readings_begun_with(plan, out, is_lego=is_lego)
    if resume:
        raise FileError(out, "no such file", "a recording to resume; omit --resume to begin a new one")
    described = out.with_suffix(".json")
    left = content_if_there(described) == description_text(plan.instrumentation, plan.patterns).encode()
    for path in (out, *[described] * (not left), *pictures_to_write(plan.patterns, out.parent)):
        if path.exists():
            raise FileError(path, "the file exists already", "--resume to continue it, or another --out")
    return []


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
        here, there = ("white", "black") if is_white else ("black", "white")
        wrong = f"reads {value:g}, where {there} read {np.median(other):g}"
        wrong += f" and {here} {np.median(own):g}" if own else ""
        return f"sheet {name!r} contradicts its pattern: at {place} it is {here}, and {wrong}"

    def _contradicts(self, is_white: bool, value: float) -> bool:
        """Return whether a reading over one shade is far from earlier ones of it, or on the wrong side of the other."""
        own, opposite = self._read[is_white], float(np.median(self._read[not is_white]))
        if own:
            level = float(np.median(own))
            least = _LEAST_CONTRAST * max(abs(level), abs(opposite))
            return abs(value - level) > max(_OFF_LEVEL * abs(opposite - level), least)
        brighter = (value - opposite) * (1 if is_white else -1)
        return self._bright and brighter < _LEAST_CONTRAST * max(abs(value), abs(opposite))


def uniform_shades_at_places(pattern: Pattern, places_mm: FloatArray) -> FloatArray:
    """Return the shade that the sensor sees at each place, (n, 2), as (n,): 1 all white, 0 all black, else NaN."""
    seen = (places_mm[:, None, :] + _AROUND_MM).reshape(-1, 2)
    albedo = region_of(pattern).albedo(seen)[0].reshape(len(places_mm), len(_AROUND_MM))
    low, high = albedo.min(axis=1), albedo.max(axis=1)
    return np.where((low == high) & ((low >= 1) | (high <= 0)), np.clip(low, 0.0, 1.0), math.nan)
