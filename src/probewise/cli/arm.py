"""`probewise arm`: tasks at the bench with the arm."""

from __future__ import annotations

import argparse

from probewise.cli._arm import ARMS, SHIPPED, add_geometry, read_or_shipped_geometry
from probewise.cli._common import (
    DEFAULT_SEED,
    OneLineParser,
    add,
    add_quiet,
    parse_count,
    parse_path,
    parse_seed,
    positive_number_parser,
)

_BRICK = "the brick, such as nxt:/dev/rfcomm0 or nxt:COM5"
_ALL_ARMS = f"where the readings come from: {ARMS}"
_LEGO_ARMS = (
    "the LEGO arm: nxt:PORT such as nxt:/dev/rfcomm0 or nxt:COM5; or emulator:TRUE.toml, in software, built "
    "differently from --geometry"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise arm` and its tasks."""
    tasks = parser.add_subparsers(dest="task", metavar="TASK", required=True, parser_class=OneLineParser)

    def task(name: str, summary: str, *, arms: str = _BRICK, moves: bool = True) -> OneLineParser:
        """Add a task's parser, with --geometry and --quiet; if it `moves`, also --arm (help: `arms`) and --dry-run."""
        own = tasks.add_parser(name, help=summary, description=summary)
        if moves:
            add(own, "--arm nxt:PORT" if arms is _BRICK else "--arm ARM", arms)
            add(own, "--dry-run", "only print the moves, from home")
        add_geometry(own)
        add_quiet(own)
        return own

    check = task("check", "Check a geometry file, and a brick; report and draw the arm's reach.", moves=False)
    add(check, "--arm nxt:PORT", _BRICK)
    add(check, "--out REACH.png", "file of the drawing (default: none)", type=parse_path)
    add(check, "--drawing ARM.png", "file of a drawing with the arm's lengths", type=parse_path)

    jog = task("jog", "Turn a joint by some degrees, or bring the sensor over a place.")
    add(jog, "where WHERE", "base, shoulder or elbow and degrees; or a place X,Y in mm", nargs="+")
    add(jog, "--down", "at a place: lower the sensor to the height of reading")
    add(jog, "--steps", "with --down: in steps, each confirmed with Enter")

    summary = "Fit home angles, links and base to marks that the sensor is brought to; writes the geometry."
    fit = task("fit-geometry", summary, arms=_LEGO_ARMS)
    add(fit, "--out ARM.toml", "where the fitted geometry goes", type=parse_path, required=True)
    about = "where marks are kept (default: beside --out); without --arm they are read from there and only fitted"
    add(fit, "--marks MARKS.csv", about, type=parse_path)
    for usage, default, about in (
        ("--block-mm MM", 32.0, "height of the block on a mark (default 32: three LEGO bricks and a smooth tile)"),
        ("--touch-mm MM", 1.0, "accuracy of a mark, sd of place and height (default 1)"),
    ):
        add(fit, usage, about, type=positive_number_parser("mm"), default=default)
    add(fit, "--resume", "continue after the marks in MARKS.csv")

    home = task("home", "Bring all joints home, where their counters are 0; joints with a stop find it first.")
    add(home, "--here", "let a person bring the arm home by hand, and set the counters to 0 there")

    summary = "Check from the light over white whether the sensor hangs as high as its counters say."
    heights = task("heights", summary, arms=_LEGO_ARMS)
    add(heights, "places X,Y", "places in mm, two or more (default: the field's middle and the marks)", nargs="*")
    add(heights, "--readings N", "number of readings at each height (default 16)", type=parse_count, default=16)

    task("read", "Read the sensor where it stands, in LEGO units, and the battery.")

    scan = task("scan", "Read along a line; readings go to standard output as CSV.", arms=_ALL_ARMS)
    add(scan, "start X,Y", "first place of the line, mm")
    add(scan, "end X,Y", "last place of the line, mm")
    add(scan, "--readings N", "number of readings (default 21)", type=parse_count, default=21)

    summary = "Carry out a plan and write the recording; asks a person to lay sheets and turn the sensor."
    record = task("record", summary, arms=_ALL_ARMS)
    add(record, "plan PLAN.csv", f"plan or recording, its JSON beside it; or {' or '.join(SHIPPED)}, which ship")
    add(record, "--out REC.csv", "where the recording goes", type=parse_path, required=True)
    about = "where on the field the plan's origin lies (default: the field's middle; with FILE.py 0,0)"
    add(record, "--origin-mm X,Y", about)
    own = record.add_argument_group("with FILE.py", "properties of the readings, if not in the plan's JSON")
    add(own, "--unit UNIT", "unit of a reading, such as V or counts")
    add(own, "--range LOW,HIGH", "smallest and largest possible reading, such as 0,1023")
    add(own, "--step STEP", "rounding step of the readings, such as 1")
    for each in (scan, record):
        simulated = each.add_argument_group("with simulated and emulator")
        add(simulated, "--sensor S.json", "its sensor (default: that of the shipped recordings)", type=parse_path)
        add(simulated, "--seed N", f"seed of noise (default {DEFAULT_SEED})", type=parse_seed)
        if each is scan:
            add(simulated, "--scene X,Y,R", "target on the field, as for emulate-nxt")
    add(record, "--resume", "continue after the readings in REC.csv")


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
