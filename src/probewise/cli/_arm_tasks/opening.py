"""Open the arm of a task, and speak to the person at it."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from probewise.cli._arm import SCENE, open_nxt_arm, parse_arm, prompter, warn_and_confirm_lowering
from probewise.cli._common import DEFAULT_SEED, CommandError, print_result
from probewise.errors import ParameterError

if TYPE_CHECKING:
    from probewise.arm import Geometry, Instrument, LegoArm, OwnInstrument, SimulatedArm
    from probewise.cli._bench import SimulatedBench

UNITS = "LEGO units (1 dark to 100 bright)"


def open_lego_arm(arguments: argparse.Namespace, geometry: Geometry, *, start_s: float = 0.0) -> LegoArm:
    """Open the arm of --arm, or for --dry-run one that only prints its moves."""
    from probewise.arm import DryRun, LegoArm

    if arguments.dry_run:
        return LegoArm(DryRun(geometry, print_result), geometry, start_s=start_s)
    if arguments.arm is None:
        raise CommandError(
            "--arm is missing: name the brick, such as --arm nxt:/dev/rfcomm0; or --dry-run prints the moves only"
        )
    return open_nxt_arm(nxt_port(arguments.arm), geometry, start_s=start_s)


def open_instrument(
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
        refuse_options(arguments, "a real arm", "sensor", "scene", "seed")
        return open_lego_arm(arguments, geometry, start_s=start_s), None
    if arguments.dry_run:
        raise ParameterError("--dry-run", True, f"none with {arguments.arm}: it is for the LEGO arm")
    if chosen.kind == "file":
        refuse_options(arguments, arguments.arm, "geometry", "sensor", "scene", "seed")
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


def confirm_lowering(
    arguments: argparse.Namespace, instrument: LegoArm | OwnInstrument | SimulatedArm, geometry: Geometry
) -> None:
    """Warn if the sensor may hit the table and let a person confirm its first lowering, unless nothing moves."""
    if arguments.arm is not None and not arguments.dry_run:
        warn_and_confirm_lowering(parse_arm(arguments.arm), instrument, geometry)


def refuse_options(arguments: argparse.Namespace, what: str, *names: str) -> None:
    for name in names:
        value = getattr(arguments, name, None)
        if value is not None:
            raise ParameterError(f"--{name}", str(value), f"none with {what}")


def is_own_instrument(arguments: argparse.Namespace) -> bool:
    return arguments.arm is not None and parse_arm(arguments.arm).kind == "file"


def nxt_port(name: str) -> str:
    """Return the port of "nxt:PORT"; raise ParameterError for any other arm."""
    chosen = parse_arm(name)
    if chosen.kind != "nxt":
        own = "; FILE.py is for `arm scan`, `arm record` and `explore`" if chosen.kind == "file" else ""
        without = f"; {name} has no bench, --dry-run prints the moves" if not own else ""
        raise ParameterError("--arm", name, f"nxt:PORT{own}{without}")
    return chosen.where


def prompter_unless_dry_run(arguments: argparse.Namespace, arm: Instrument) -> Callable[[str], None]:
    """Return a function that prompts the person; in a dry run, it only prints the request."""
    return (lambda text: print_result(f"ask: {text}")) if arguments.dry_run else prompter(arm)


def print_position(arm: LegoArm, *, quiet: bool) -> None:
    (x_mm, y_mm, height_mm), angles = arm.position_mm, [math.degrees(angle) for angle in arm.angles_rad]
    print_result(
        f"sensor at ({x_mm:.1f}, {y_mm:.1f}) mm, {height_mm:.1f} mm above the surface; base {angles[0]:.1f}, "
        f"shoulder {angles[1]:.1f}, elbow {angles[2]:.1f} degrees",
        quiet=quiet,
    )
