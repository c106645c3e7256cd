"""Move the arm: a joint by some degrees, the sensor to a place, all joints home."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from probewise.cli._arm import enable_confirmed_lowering, parse_place, warn_if_clearance_doubtful
from probewise.cli._arm_tasks.opening import open_lego_arm, print_position, prompter_unless_dry_run
from probewise.errors import ParameterError

if TYPE_CHECKING:
    from probewise.arm import Geometry


def jog_joint_or_sensor(arguments: argparse.Namespace, geometry: Geometry) -> None:
    from probewise.arm.geometry import JOINTS

    match arguments.where:
        case [place]:
            x_mm, y_mm = parse_place("WHERE", place)
            if arguments.steps and not arguments.down:
                raise ParameterError("--steps", True, "with --down: the sensor is lowered in steps")
            if arguments.down and not arguments.dry_run and not arguments.steps:
                warn_if_clearance_doubtful(geometry)
            with open_lego_arm(arguments, geometry) as arm:
                if arguments.steps and not arguments.dry_run:
                    enable_confirmed_lowering(arm)
                (arm.go_down if arguments.down else arm.go_over)(x_mm, y_mm)
                print_position(arm, quiet=arguments.quiet)
                if arguments.down:
                    prompter_unless_dry_run(arguments, arm)("check the sensor's position; it will be raised again")
        case [joint, text] if joint in JOINTS:
            by_rad = math.radians(_parse_degrees(text))
            with open_lego_arm(arguments, geometry) as arm:
                arm.turn_joint(JOINTS.index(joint), by_rad)
                print_position(arm, quiet=arguments.quiet)
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


def bring_home(arguments: argparse.Namespace, geometry: Geometry) -> None:
    from probewise.arm.geometry import JOINTS

    with open_lego_arm(arguments, geometry) as arm:
        if arguments.here:
            angles = [f"{name} {math.degrees(j.home_rad):g}" for name, j in zip(JOINTS, geometry.joints, strict=True)]
            arm.release()
            prompter_unless_dry_run(arguments, arm)(f"bring the arm home by hand, {', '.join(angles)} degrees")
            arm.set_home()
        else:
            arm.home()
        print_position(arm, quiet=arguments.quiet)
