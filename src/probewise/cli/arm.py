"""`probewise arm`: tasks at the bench with the arm."""

from __future__ import annotations

import argparse

from probewise.cli._arm import ARMS, SHIPPED, add_geometry, read_or_shipped_geometry
from probewise.cli._common import (
    DEFAULT_SEED,
    OneLineParser,
    add_count_option,
    add_path,
    add_quiet,
    parse_seed,
    positive_number_parser,
)

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
    add_path(check, "--out", "REACH.png", "file of the drawing (default: none)")
    add_path(check, "--drawing", "ARM.png", "file of a drawing with the arm's lengths")

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
    add_path(fit, "--out", "ARM.toml", "where the fitted geometry goes", required=True)
    add_path(
        fit,
        "--marks",
        "MARKS.csv",
        "where marks are kept (default: beside --out); without --arm they are read from there and only fitted",
    )
    for name, default, about in (
        ("--block-mm", 32.0, "height of the block on a mark (default 32: three LEGO bricks and a smooth tile)"),
        ("--touch-mm", 1.0, "accuracy of a mark, sd of place and height (default 1)"),
    ):
        fit.add_argument(name, type=positive_number_parser("mm"), default=default, metavar="MM", help=about)
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
    add_count_option(scan, "--readings", "number of readings (default 21)", default=21)

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
    add_path(record, "--out", "REC.csv", "where the recording goes", required=True)
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
    metavar, usual = "nxt:PORT" if arms is None else "ARM", "the brick, such as nxt:/dev/rfcomm0 or nxt:COM5"
    parser.add_argument("--arm", metavar=metavar, help=arms or usual)


def run(arguments: argparse.Namespace) -> int:
    """Run one task of `probewise arm`; return the exit status."""
    from probewise.cli import _arm_tasks, _fit_geometry, _record

    tasks = {
        "check": _arm_tasks.report_geometry_and_reach,
        "jog": _arm_tasks.jog_joint_or_sensor,
        "fit-geometry": _fit_geometry.fit_geometry_to_marks,
        "home": _arm_tasks.bring_home,
        "heights": _arm_tasks.compare_heights_by_light,
        "read": _arm_tasks.print_light_and_battery,
        "scan": _arm_tasks.scan_line,
        "record": _record.record_plan,
    }
    tasks[arguments.task](arguments, read_or_shipped_geometry(arguments))
    return 0
