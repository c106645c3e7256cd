"""Read the sensor where it stands, or along a line."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from probewise.cli._arm import parse_arm, parse_place
from probewise.cli._arm_tasks.opening import UNITS, confirm_lowering, open_instrument, open_lego_arm
from probewise.cli._common import print_result

if TYPE_CHECKING:
    from probewise.arm import Geometry

_COLUMNS = "x_mm,y_mm,orientation_deg,time_s,reading"


def print_light_and_battery(arguments: argparse.Namespace, geometry: Geometry) -> None:
    with open_lego_arm(arguments, geometry) as arm:
        value, battery_mv = arm.read_here(), arm.battery_mv()
        if not arguments.dry_run:
            print_result(f"{value:g} {UNITS}, battery {battery_mv:.0f} mV")


def scan_line(arguments: argparse.Namespace, geometry: Geometry) -> None:
    import numpy as np

    from probewise.arm import LegoArm, Pose, require_within_reach
    from probewise.arm.carry_out import reachable_places_of

    start, end = parse_place("X,Y", arguments.start), parse_place("X,Y", arguments.end)
    places = np.linspace(start, end, arguments.readings)
    if arguments.arm is None or parse_arm(arguments.arm).is_lego:  # before connecting to the brick
        require_within_reach(geometry, places, "reading of the scan")
    names: list[str] = ["battery_mv"]
    instrument, _ = open_instrument(arguments, geometry)
    confirm_lowering(arguments, instrument, geometry)
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
