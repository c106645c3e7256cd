"""`probewise arm`: tasks at the bench with the arm."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from probewise.cli._arm import (
    ARMS,
    SCENE,
    add_geometry,
    enable_confirmed_lowering,
    open_brick,
    open_nxt_arm,
    parse_arm,
    parse_place,
    prompter,
    prompter_for_answer,
    read_or_shipped_geometry,
    warn_and_confirm_lowering,
    warn_if_clearance_doubtful,
)
from probewise.cli._common import (
    DEFAULT_SEED,
    CommandError,
    OneLineParser,
    Verb,
    add_count_option,
    add_path,
    add_quiet,
    message_to_resume,
    parse_path,
    parse_positive_int,
    parse_seed,
    positive_number_parser,
    print_result,
    print_warning,
)
from probewise.cli._output import checked_output_file
from probewise.cli._plans import (
    SHIPPED,
    plan_for_lego_arm,
    plan_for_own_instrument,
    read_or_shipped_plan,
    without_measured_covariates,
)
from probewise.cli._stopping import reporting_what_is_kept
from probewise.errors import FileError, LinkError, ParameterError

if TYPE_CHECKING:
    from probewise.arm import Geometry, Instrument, LegoArm, OwnInstrument, RequestToPerson, SimulatedArm
    from probewise.cli._bench import SimulatedBench
    from probewise.recordings import Plan

MARKS = "marks"
_COLUMNS = "x_mm,y_mm,orientation_deg,time_s,reading"
_MOST_READINGS = 100_000  # limit of one scan
BLOCK_MM = 32.0
WHITE = "uniform:1"
_HEIGHTS, _APART_MM = 9, 1.0  # at which the light is learnt, from that of reading upwards
_STEP_OF_LIGHT = 0.1  # of a reading in all its steps, 0 to 100
TOUCH_MM = 1.0
UNITS = "LEGO units (1 dark to 100 bright)"
_ALL_ARMS = f"where the readings come from: {ARMS}"
_LEGO_ARMS = (
    "the LEGO arm: nxt:PORT such as nxt:/dev/rfcomm0 or nxt:COM5; or emulator:TRUE.toml, in software, built "
    "differently from --geometry"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise arm` and its tasks."""
    tasks = parser.add_subparsers(dest="task", metavar="TASK", required=True, parser_class=OneLineParser)

    check = _add_task(tasks, "check", "Check a geometry file, and a brick; report and draw the arm's reach.")
    _add_arm(check)
    check.add_argument("--out", type=parse_path, metavar="REACH.png", help="file of the drawing (default: none)")
    check.add_argument("--drawing", type=parse_path, metavar="ARM.png", help="file of a drawing with the arm's lengths")

    jog = _add_task(tasks, "jog", "Turn a joint by some degrees, or bring the sensor over a place.", moves=True)
    jog.add_argument(
        "where", nargs="+", metavar="WHERE", help="base, shoulder or elbow and degrees; or a place X,Y in mm"
    )
    jog.add_argument("--down", action="store_true", help="at a place: lower the sensor to the height of reading")

    jog.add_argument("--steps", action="store_true", help="with --down: in steps, each confirmed with Enter")

    fit = _add_task(
        tasks,
        "fit-geometry",
        "Fit home angles, links and base to marks that the sensor is brought to; writes the geometry.",
        moves=True,
        arms=_LEGO_ARMS,
    )
    fit.add_argument("--out", type=parse_path, required=True, metavar="ARM.toml", help="where the fitted geometry goes")
    add_path(
        fit,
        "--marks",
        "MARKS.csv",
        "where marks are kept (default: beside --out); without --arm they are read from there and only fitted",
    )
    fit.add_argument(
        "--block-mm",
        type=positive_number_parser("mm"),
        default=BLOCK_MM,
        metavar="MM",
        help=f"height of the block on a mark (default {BLOCK_MM:g}: three LEGO bricks and a smooth tile)",
    )
    fit.add_argument(
        "--touch-mm",
        type=positive_number_parser("mm"),
        default=TOUCH_MM,
        metavar="MM",
        help=f"accuracy of a mark, sd of place and height (default {TOUCH_MM:g})",
    )
    fit.add_argument("--resume", action="store_true", help="continue after the marks in MARKS.csv")

    home = _add_task(
        tasks,
        "home",
        "Bring all joints home, where their counters are 0; joints with a stop find it first.",
        moves=True,
    )
    home.add_argument(
        "--here", action="store_true", help="let a person bring the arm home by hand, and set the counters to 0 there"
    )

    heights = _add_task(
        tasks,
        "heights",
        "Check from the light over white whether the sensor hangs as high as its counters say.",
        moves=True,
        arms=_LEGO_ARMS,
    )
    heights.add_argument(
        "places", nargs="*", metavar="X,Y", help="places in mm, two or more (default: the field's middle and the marks)"
    )
    add_count_option(heights, "--readings", "number of readings at each height (default 16)", default=16)

    _add_task(tasks, "read", "Read the sensor where it stands, in LEGO units, and the battery.", moves=True)

    scan = _add_task(
        tasks, "scan", "Read along a line; readings go to standard output as CSV.", moves=True, arms=_ALL_ARMS
    )
    scan.add_argument("start", metavar="X,Y", help="first place of the line, mm")
    scan.add_argument("end", metavar="X,Y", help="last place of the line, mm")
    scan.add_argument(
        "--readings", type=parse_positive_int, default=21, metavar="N", help="number of readings (default 21)"
    )

    record = _add_task(
        tasks,
        "record",
        "Carry out a plan and write the recording; asks a person to lay sheets and turn the sensor.",
        moves=True,
        arms=_ALL_ARMS,
    )
    record.add_argument(
        "plan",
        metavar="PLAN.csv",
        help=f"plan or recording, its JSON beside it; or {' or '.join(SHIPPED)}, which ship",
    )
    record.add_argument("--out", type=parse_path, required=True, metavar="REC.csv", help="where the recording goes")
    record.add_argument(
        "--origin-mm",
        metavar="X,Y",
        help="where on the field the plan's origin lies (default: the field's middle; with FILE.py 0,0)",
    )
    own = record.add_argument_group("with FILE.py", "properties of the readings, if not in the plan's JSON")
    own.add_argument("--unit", metavar="UNIT", help="unit of a reading, such as V or counts")
    own.add_argument("--range", metavar="LOW,HIGH", help="smallest and largest possible reading, such as 0,1023")
    own.add_argument("--step", metavar="STEP", help="rounding step of the readings, such as 1")
    for task, scene in ((scan, True), (record, False)):
        simulated = task.add_argument_group("with simulated and emulator")
        add_path(simulated, "--sensor", "S.json", "its sensor (default: that of the shipped recordings)")
        simulated.add_argument("--seed", type=parse_seed, metavar="N", help=f"seed of noise (default {DEFAULT_SEED})")
        if scene:
            simulated.add_argument("--scene", metavar="X,Y,R", help="target on the field, as for emulate-nxt")
    record.set_defaults(scene=None)
    record.add_argument("--resume", action="store_true", help="continue after the readings in REC.csv")


def _add_task(
    tasks: argparse._SubParsersAction[OneLineParser],
    name: str,
    summary: str,
    *,
    moves: bool = False,
    arms: str | None = None,
) -> OneLineParser:
    """Add the parser of a task, with --geometry and --quiet; if it `moves`, also --arm (help: `arms`) and --dry-run."""
    parser = tasks.add_parser(name, help=summary, description=summary)
    if moves:
        _add_arm(parser, arms)
        parser.add_argument("--dry-run", action="store_true", help="only print the moves, from home")
    add_geometry(parser)
    add_quiet(parser)
    return parser


def _add_arm(parser: argparse.ArgumentParser, arms: str | None = None) -> None:
    """Add --arm; `arms` is its help, by default that of a real brick."""
    if arms is None:
        parser.add_argument("--arm", metavar="nxt:PORT", help="the brick, such as nxt:/dev/rfcomm0 or nxt:COM5")
    else:
        parser.add_argument("--arm", metavar="ARM", help=arms)


def run(arguments: argparse.Namespace) -> int:
    """Run one task of `probewise arm`; return the exit status."""
    TASKS[arguments.task](arguments, read_or_shipped_geometry(arguments))
    return 0


def _report_geometry_and_reach(arguments: argparse.Namespace, geometry: Geometry) -> None:
    import numpy as np

    from probewise.arm.geometry import JOINTS
    from probewise.recordings import write_bytes_atomically
    from probewise.report.plots import png, reach_map
    from probewise.report.plots.apparatus import draw_arm_lengths

    out = None if arguments.out is None else checked_output_file(arguments.out)
    drawing = None if arguments.drawing is None else checked_output_file(arguments.drawing)
    port = None if arguments.arm is None else _nxt_port(arguments.arm)
    x_mm, y_mm = (np.linspace(0.0, length, n) for length, n in zip(geometry.field_mm, (131, 65), strict=True))
    places = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
    held = geometry.contains(places)
    print_result(f"reach        {geometry.sentence()}", quiet=arguments.quiet)
    print_result(f"field        {held.mean():.1%} of it within reach", quiet=arguments.quiet)
    for name, joint in zip(JOINTS, geometry.joints, strict=True):
        count_mm = geometry.farthest_mm / abs(joint.counts_per_rad)
        low, high = math.degrees(joint.low_rad), math.degrees(joint.high_rad)
        print_result(
            f"{name:<12} motor {'ABC'[joint.port]}, {low:g} to {high:g} degrees; "
            f"at {geometry.farthest_mm:.0f} mm one count is {count_mm:.2f} mm, "
            f"its play {joint.play_rad * geometry.farthest_mm:.1f} mm",
            quiet=arguments.quiet,
        )
    if geometry.accuracy is None:
        known = "not fitted to marks: with home 2 degrees off on both links the sensor hangs up to"
    else:
        known = f"fitted to {geometry.accuracy.marks} marks; by 2 sds the sensor may hang"
    print_result(
        f"height       reads {geometry.read_height_mm:g} mm up; {known} {geometry.max_height_error_mm:.1f} mm lower",
        quiet=arguments.quiet,
    )
    if not held.any():
        raise ParameterError("reach", "nowhere on the field", "links, heights and limits that reach the field")
    if out is not None:
        standing = np.where(held, geometry.orientation_rad(places), np.nan).reshape(y_mm.size, x_mm.size)
        write_bytes_atomically(out, png(reach_map(standing, x_mm, y_mm, axis_mm=geometry.axis_mm)))
        print_result(f"drawn        {out}", quiet=arguments.quiet)
    if drawing is not None:
        write_bytes_atomically(drawing, png(draw_arm_lengths(geometry)))
        print_result(f"drawn        {drawing}", quiet=arguments.quiet)
    if port is not None:
        _report_brick_state(port, geometry, quiet=arguments.quiet)


def _report_brick_state(port: str, geometry: Geometry, *, quiet: bool) -> None:
    """Print the brick's name, firmware, battery and light; raise LinkError if a program runs on it. Nothing moves."""
    from probewise.arm import percent_to_lego_units

    with open_brick(port) as brick:
        version = brick.version()
        firmware = f"{version.firmware_major}.{version.firmware_minor:02d}"
        battery_v = brick.battery_mv() / 1000
        print_result(f"brick        {brick.name()}, firmware {firmware}, battery {battery_v:.2f} V", quiet=quiet)
        light = brick.light_sensor(geometry.sensor_port).read()
        value = percent_to_lego_units(light.fine_percent, geometry)
        print_result(
            f"light        {value:g} {UNITS} at port {geometry.sensor_port + 1}, {light.raw_counts} raw counts",
            quiet=quiet,
        )
        program = brick.running_program()
        if program is not None:
            raise LinkError(f"the program {program} runs on the brick and may move the motors; stop it on the brick")


def _jog_joint_or_sensor(arguments: argparse.Namespace, geometry: Geometry) -> None:
    from probewise.arm.geometry import JOINTS

    match arguments.where:
        case [place]:
            x_mm, y_mm = parse_place("WHERE", place)
            if arguments.steps and not arguments.down:
                raise ParameterError("--steps", True, "with --down: the sensor is lowered in steps")
            if arguments.down and not arguments.dry_run and not arguments.steps:
                warn_if_clearance_doubtful(geometry)
            with _open_lego_arm(arguments, geometry) as arm:
                if arguments.steps and not arguments.dry_run:
                    enable_confirmed_lowering(arm)
                (arm.go_down if arguments.down else arm.go_over)(x_mm, y_mm)
                _print_position(arm, quiet=arguments.quiet)
                if arguments.down:
                    _prompter(arguments, arm)("check the sensor's position; it will be raised again")
        case [joint, text] if joint in JOINTS:
            by_rad = math.radians(_parse_degrees(text))
            with _open_lego_arm(arguments, geometry) as arm:
                arm.turn_joint(JOINTS.index(joint), by_rad)
                _print_position(arm, quiet=arguments.quiet)
        case _:
            raise ParameterError("WHERE", " ".join(arguments.where), f"X,Y in mm; or {', '.join(JOINTS)}, and degrees")


def _parse_degrees(text: str) -> float:
    """Parse a finite number of degrees; raise ParameterError for anything else."""
    try:
        degrees = float(text)
    except ValueError:
        degrees = math.nan
    if not math.isfinite(degrees):
        raise ParameterError("WHERE", text, "a number of degrees")
    return degrees


def _bring_home(arguments: argparse.Namespace, geometry: Geometry) -> None:
    from probewise.arm.geometry import JOINTS

    with _open_lego_arm(arguments, geometry) as arm:
        if arguments.here:
            angles = [f"{name} {math.degrees(j.home_rad):g}" for name, j in zip(JOINTS, geometry.joints, strict=True)]
            arm.release()
            _prompter(arguments, arm)(f"bring the arm home by hand, {', '.join(angles)} degrees")
            arm.set_home()
        else:
            arm.home()
        _print_position(arm, quiet=arguments.quiet)


def _fit_geometry(arguments: argparse.Namespace, geometry: Geometry) -> None:
    from probewise.arm import shipped_geometry_path
    from probewise.arm.fitting import fit_geometry
    from probewise.arm.geometry_file import read_geometry, text_with_fitted_values
    from probewise.arm.mark_file import read_turns_and_places
    from probewise.recordings import write_text_atomically

    source = arguments.geometry or shipped_geometry_path()
    out = checked_output_file(arguments.out, *([] if arguments.geometry is None else [arguments.geometry]))
    if arguments.dry_run:
        raise ParameterError("--dry-run", True, "none with fit-geometry: a person directs its moves")
    if arguments.arm is None and arguments.marks is None:
        raise CommandError(
            "--arm is missing: name the brick, such as --arm nxt:/dev/rfcomm0; or fit existing marks, --marks MARKS.csv"
        )
    kept = out.with_suffix(".marks.csv") if arguments.marks is None else arguments.marks
    if arguments.arm is not None:
        _touch_and_save_marks(arguments, geometry, checked_output_file(kept))
    turned, marks = read_turns_and_places(kept)
    fitted = fit_geometry(geometry, turned, marks, touch_mm=arguments.touch_mm)
    print_result(fitted.summary(), quiet=arguments.quiet)
    text = text_with_fitted_values(source.read_text(encoding="utf-8-sig"), fitted.geometry)
    write_text_atomically(out, text)
    read_geometry(out)  # check that edits by hand have not hidden a number
    print_result(f"written      {out}; give it as --geometry from now on", quiet=arguments.quiet)


def _touch_and_save_marks(arguments: argparse.Namespace, geometry: Geometry, kept: Path) -> None:
    """Bring the sensor to one mark after another as a person directs; save each at once to the file `kept`."""
    from probewise.arm import LegoArm
    from probewise.arm.mark_file import TouchedMark, read_turns_and_places, write_marks
    from probewise.arm.marks import spread_mark_places
    from probewise.cli._marks import bring_to_mark

    chosen = parse_arm(arguments.arm)
    if not chosen.is_lego:
        raise ParameterError("--arm", arguments.arm, "nxt:PORT or emulator:TRUE.toml: the arm whose geometry is fitted")
    if kept.exists() and not arguments.resume:
        raise FileError(kept, "the file exists already", "--resume to continue it, or another --marks")
    taken: list[TouchedMark] = []
    if kept.exists():
        rows = zip(*(array.tolist() for array in read_turns_and_places(kept)), strict=True)
        taken = [TouchedMark(tuple(turned), tuple(place)) for turned, place in rows]
    done = {mark.place_mm[:2] for mark in taken}
    marks = [(x, y) for x, y in spread_mark_places(geometry).tolist()]
    arguments.scene = arguments.sensor = arguments.seed = None
    instrument, bench = _open_instrument(arguments, geometry)
    assert isinstance(instrument, LegoArm)

    def kept_message() -> str:
        return (
            message_to_resume(kept, len(taken), "mark", arguments, "--resume") if kept.exists() else "no mark was kept"
        )

    with reporting_what_is_kept(kept_message), instrument as arm:
        answer = prompter_for_answer(arm)
        ask = answer if bench is None else bench.answer_at_mark
        tell = partial(print_result, quiet=bench is not None)
        if bench is None:
            prompter(arm)(
                f"lay the sheet of marks (probewise sheets {MARKS}) on the field, and on each cross in its turn a "
                f"block {arguments.block_mm:g} mm high"
            )
        for number, mark in enumerate(marks, 1):
            if mark in done:
                continue
            met = bring_to_mark(arm, mark, arguments.block_mm, ask, tell, named=f"mark {number} of {len(marks)}")
            if met is not None:
                taken.append(met)
                write_marks(taken, kept)
                print_result(f"mark {number} kept: {kept}", quiet=arguments.quiet)


def _compare_heights_by_light(arguments: argparse.Namespace, geometry: Geometry) -> None:
    """Compare by the light over white the sensor's height at each place with that at the first; print differences."""
    import numpy as np

    from probewise.arm import LegoArm, require_within_reach
    from probewise.arm.height_check import HeightReading, check_heights
    from probewise.arm.marks import spread_mark_places

    if arguments.arm is not None and not parse_arm(arguments.arm).is_lego:
        raise ParameterError("--arm", arguments.arm, "nxt:PORT, or emulator:TRUE.toml")
    if arguments.readings > _MOST_READINGS:
        raise ParameterError("--readings", arguments.readings, f"up to {_MOST_READINGS}")
    width, height = geometry.field_mm
    places = [parse_place("X,Y", text) for text in arguments.places]
    places = places or [(width / 2, height / 2), *((x, y) for x, y in spread_mark_places(geometry).tolist())]
    if len(places) < 2:
        raise ParameterError("X,Y", " ".join(arguments.places), "two places or more: heights are compared")
    require_within_reach(geometry, np.array(places), "place")
    arguments.sensor = arguments.seed = arguments.scene = None
    instrument, bench = _open_instrument(arguments, geometry, scene=WHITE)
    assert isinstance(instrument, LegoArm)
    _warn_and_confirm_lowering(arguments, instrument, geometry)
    with instrument as arm:
        if bench is None:
            _prompter(arguments, arm)("lay white matt paper, the same everywhere, over the field, or under each place")

        def height_reading_at(place: tuple[float, float], height_mm: float) -> HeightReading:
            arm.go_down(*place, height_mm)
            values = np.array([arm.brightness() for _ in range(arguments.readings)])
            error = max(float(values.std()), _STEP_OF_LIGHT) / math.sqrt(arguments.readings)
            return HeightReading(float(arm.position_mm[2]), float(values.mean()), error)

        arm.go_over(*places[0])
        lowest_mm = geometry.read_height_mm
        curve = [height_reading_at(places[0], lowest_mm + _APART_MM * k) for k in range(_HEIGHTS)]
        lights = []
        for place in places[1:]:
            lights.append(height_reading_at(place, lowest_mm))
            if not arguments.dry_run:
                found = check_heights(curve, lights)
                print_result(_height_error_in_words(place, found.off_mm[-1], found.sd_mm[-1]), quiet=arguments.quiet)
    if arguments.dry_run:
        return
    print_result(
        f"light        falls by {found.per_mm:.1%} with each mm at {lowest_mm:g} mm (in [sensor] of the geometry: "
        f"light_per_mm = {found.per_mm:.3f}); heights are relative to the first place, "
        f"({places[0][0]:g}, {places[0][1]:g}) mm",
        quiet=arguments.quiet,
    )
    if found.agrees:
        print_result(f"heights      agree with the counters (p = {found.p_value:.2g})", quiet=arguments.quiet)
    else:
        worst = int(np.argmax(np.abs(found.off_mm / found.sd_mm)))
        print_warning(
            f"the light contradicts the heights (p = {found.p_value:.1g}), most at "
            f"{_height_error_in_words(places[1 + worst], found.off_mm[worst], found.sd_mm[worst])}; is the paper the "
            "same everywhere? Then bring the sensor to marks there and fit the geometry again "
            "(probewise arm fit-geometry)"
        )


def _height_error_in_words(place_mm: tuple[float, float], off_mm: float, sd_mm: float) -> str:
    side = "higher" if off_mm > 0 else "lower"
    x_mm, y_mm = place_mm
    return f"({x_mm:g}, {y_mm:g}) mm: it hangs {abs(off_mm):.1f} ± {sd_mm:.1f} mm {side} than its counters say"


def _print_light_and_battery(arguments: argparse.Namespace, geometry: Geometry) -> None:
    with _open_lego_arm(arguments, geometry) as arm:
        value, battery_mv = arm.read_here(), arm.battery_mv()
        if not arguments.dry_run:
            print_result(f"{value:g} {UNITS}, battery {battery_mv:.0f} mV")


def _scan_line(arguments: argparse.Namespace, geometry: Geometry) -> None:
    import numpy as np

    from probewise.arm import LegoArm, Pose, require_within_reach
    from probewise.arm.carry_out import reachable_places_of

    start, end = parse_place("X,Y", arguments.start), parse_place("X,Y", arguments.end)
    if arguments.readings > _MOST_READINGS:
        raise ParameterError("--readings", arguments.readings, f"up to {_MOST_READINGS}")
    places = np.linspace(start, end, arguments.readings)
    if arguments.arm is None or parse_arm(arguments.arm).is_lego:  # before connecting to the brick
        require_within_reach(geometry, places, "reading of the scan")
    names: list[str] = ["battery_mv"]
    instrument, _ = _open_instrument(arguments, geometry)
    _warn_and_confirm_lowering(arguments, instrument, geometry)
    with instrument as arm:
        require_within_reach(reachable_places_of(arm), places, "reading of the scan")
        if isinstance(arm, LegoArm):
            print_result(",".join((_COLUMNS, *names)))
        for k, ((x_mm, y_mm), standing) in enumerate(zip(places, arm.orientation_rad(places), strict=True)):
            reading = arm.measure(Pose(float(x_mm), float(y_mm), float(standing)))
            if k == 0 and not isinstance(arm, LegoArm):
                names = list(reading.covariates)
                print_result(",".join((_COLUMNS, *names)))
            at, more = reading.pose, (f",{reading.covariates.get(name, math.nan):.9g}" for name in names)
            print_result(
                f"{at.x_mm:.3f},{at.y_mm:.3f},{math.degrees(at.orientation_rad):.3f},{reading.time_s:.3f},"
                f"{reading.value:.9g}{''.join(more)}"
            )


def _record_plan(arguments: argparse.Namespace, geometry: Geometry) -> None:
    from probewise._progress import progress_shown
    from probewise.arm import carry_out, recording_of_readings
    from probewise.arm.carry_out import BY_HAND_S, duration_s
    from probewise.cli._earlier_readings import earlier_readings, read_unfinished_recording
    from probewise.cli._person import PersonAtBench, is_pty
    from probewise.cli._sheet_check import SheetCheck
    from probewise.recordings import write_recording

    named = arguments.plan in SHIPPED
    out = checked_output_file(arguments.out, *([] if named else [Path(arguments.plan)]))
    own = _is_own_instrument(arguments)
    asked = read_or_shipped_plan(arguments.plan)
    if own:
        plan = plan_for_own_instrument(asked, unit=arguments.unit, range_=arguments.range, step=arguments.step)
    elif arguments.sensor is not None:
        plan = _plan_for_simulated_sensor(asked, arguments.sensor)
    else:
        _refuse_options(arguments, "the LEGO arm: it is known", "unit", "range", "step")
        plan = plan_for_lego_arm(asked, geometry)
    width, height = (0.0, 0.0) if own else geometry.field_mm
    origin = (width / 2, height / 2) if arguments.origin_mm is None else parse_place("--origin-mm", arguments.origin_mm)
    is_lego = arguments.arm is None or parse_arm(arguments.arm).is_lego
    taken = [] if arguments.dry_run else earlier_readings(out, plan, resume=arguments.resume, is_lego=is_lego)
    start_s = taken[-1].time_s if taken else 0.0

    def kept_message() -> str:
        if not out.exists():
            return "nothing was read"
        return message_to_resume(
            out, len(read_unfinished_recording(out)), "reading", arguments, "--resume", of=len(plan)
        )

    instrument, bench = _open_instrument(arguments, geometry, start_s=start_s, n_taken=len(taken))
    _warn_and_confirm_lowering(arguments, instrument, geometry)
    with reporting_what_is_kept(kept_message), instrument as arm:
        check = SheetCheck(plan, white_is_bright=not own)
        by_person = bench is None and not arguments.dry_run
        ask: Callable[[RequestToPerson], None] = (
            _prompter(arguments, arm) if bench is None else partial(bench.carry_out_request, plan.patterns, origin)
        )
        if by_person:
            arm.mounted_rad = math.nan  # an earlier process may have left the sensor turned
            ask = PersonAtBench(
                arm, plan, origin, check, check_sheets=not own, emulated=not own and is_pty(_nxt_port(arguments.arm))
            )
            seconds = duration_s(arm, plan, origin_mm=origin, first=len(taken))
            print_result(
                f"{len(plan) - len(taken)} readings, about {seconds / 60:.0f} minutes; including {BY_HAND_S:g} s for "
                f"each step by hand",
                quiet=arguments.quiet,
            )
        readings = carry_out(arm, plan, origin_mm=origin, ask=ask, first=len(taken))
        with progress_shown(quiet=arguments.quiet, beat=False) as progress:
            progress("readings", len(taken), len(plan))
            for reading in readings:
                wrong = check.complaint_about_reading(len(taken), reading.value)
                if wrong is not None and not arguments.dry_run:
                    print_warning(f"{wrong}; is the right sheet there, the right way round?")
                taken.append(reading)
                progress("readings", len(taken), len(plan))
                if not arguments.dry_run:
                    write_recording(recording_of_readings(plan, taken), out)
    if not arguments.dry_run:
        print_result(f"{len(taken)} readings: {out}", quiet=arguments.quiet)


def _plan_for_simulated_sensor(plan: Plan, sensor: Path) -> Plan:
    """Return the plan with the instrumentation of a sensor.json, and without measured covariates."""
    import dataclasses

    from probewise.calibration import read_sensor

    return without_measured_covariates(dataclasses.replace(plan, instrumentation=read_sensor(sensor).instrumentation))


def _open_lego_arm(arguments: argparse.Namespace, geometry: Geometry, *, start_s: float = 0.0) -> LegoArm:
    """Open the arm of --arm, or for --dry-run one that only prints its moves."""
    from probewise.arm import DryRun, LegoArm

    if arguments.dry_run:
        return LegoArm(DryRun(geometry, print_result), geometry, start_s=start_s)
    if arguments.arm is None:
        raise CommandError(
            "--arm is missing: name the brick, such as --arm nxt:/dev/rfcomm0; or --dry-run prints the moves only"
        )
    return open_nxt_arm(_nxt_port(arguments.arm), geometry, start_s=start_s)


def _open_instrument(
    arguments: argparse.Namespace,
    geometry: Geometry,
    *,
    start_s: float = 0.0,
    n_taken: int = 0,
    scene: str = SCENE,
) -> tuple[LegoArm | OwnInstrument | SimulatedArm, SimulatedBench | None]:
    """Open the arm for a task that every arm can do; return it with its simulated bench, None for a real arm."""
    chosen = None if arguments.arm is None else parse_arm(arguments.arm)
    if chosen is None or chosen.kind == "nxt":
        _refuse_options(arguments, "a real arm", "sensor", "scene", "seed")
        return _open_lego_arm(arguments, geometry, start_s=start_s), None
    if arguments.dry_run:
        raise ParameterError("--dry-run", True, f"none with {arguments.arm}: it is for the LEGO arm")
    if chosen.kind == "file":
        _refuse_options(arguments, arguments.arm, "geometry", "sensor", "scene", "seed")
    from probewise.cli._bench import open_arm_and_bench

    seed = DEFAULT_SEED if arguments.seed is None else arguments.seed
    opened = open_arm_and_bench(
        chosen,
        geometry,
        arguments.geometry,
        sensor=arguments.sensor,
        scene=scene if arguments.scene is None else arguments.scene,
        seed=seed,
        start_s=start_s,
        n_taken=n_taken,
    )
    print_result(f"seed {seed}", quiet=arguments.quiet or arguments.task == "scan" or opened[1] is None)
    return opened


def _warn_and_confirm_lowering(
    arguments: argparse.Namespace, instrument: LegoArm | OwnInstrument | SimulatedArm, geometry: Geometry
) -> None:
    """Warn if the sensor may hit the table and let a person confirm its first lowering, unless nothing moves."""
    if arguments.arm is not None and not arguments.dry_run:
        warn_and_confirm_lowering(parse_arm(arguments.arm), instrument, geometry)


def _refuse_options(arguments: argparse.Namespace, what: str, *names: str) -> None:
    for name in names:
        value = getattr(arguments, name, None)
        if value is not None:
            raise ParameterError(f"--{name}", str(value), f"none with {what}")


def _is_own_instrument(arguments: argparse.Namespace) -> bool:
    return arguments.arm is not None and parse_arm(arguments.arm).kind == "file"


def _nxt_port(name: str) -> str:
    """Return the port of "nxt:PORT"; raise ParameterError for any other arm."""
    chosen = parse_arm(name)
    if chosen.kind != "nxt":
        own = "; FILE.py is for `arm scan`, `arm record` and `explore`" if chosen.kind == "file" else ""
        without = f"; {name} has no bench, --dry-run prints the moves" if not own else ""
        raise ParameterError("--arm", name, f"nxt:PORT{own}{without}")
    return chosen.where


def _prompter(arguments: argparse.Namespace, arm: Instrument) -> Callable[[str], None]:
    """Return a function that prompts the person; in a dry run, it only prints the request."""
    return (lambda text: print_result(f"ask: {text}")) if arguments.dry_run else prompter(arm)


def _print_position(arm: LegoArm, *, quiet: bool) -> None:
    (x_mm, y_mm, height_mm), angles = arm.position_mm, [math.degrees(angle) for angle in arm.angles_rad]
    print_result(
        f"sensor at ({x_mm:.1f}, {y_mm:.1f}) mm, {height_mm:.1f} mm above the surface; base {angles[0]:.1f}, "
        f"shoulder {angles[1]:.1f}, elbow {angles[2]:.1f} degrees",
        quiet=quiet,
    )


TASKS: dict[str, Callable[[argparse.Namespace, Geometry], None]] = {
    "check": _report_geometry_and_reach,
    "jog": _jog_joint_or_sensor,
    "fit-geometry": _fit_geometry,
    "home": _bring_home,
    "heights": _compare_heights_by_light,
    "read": _print_light_and_battery,
    "scan": _scan_line,
    "record": _record_plan,
}

VERB = Verb("arm", "Check, move and read the LEGO arm; record a plan with it or another arm.", add_arguments, run)
