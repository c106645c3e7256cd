"""The bench of a command: its arm, real or simulated, its table, its plans, and the person at it."""

from __future__ import annotations

import argparse
import dataclasses
import math
import queue
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeAlias

from tqdm import tqdm

from probewise import emulator, recordings
from probewise._signals import raise_if_stopped
from probewise.arm import (
    DryRun,
    Geometry,
    Instrument,
    LegoArm,
    OwnInstrument,
    Pose,
    Reach,
    Reading,
    ReadingScale,
    RequestToPerson,
    SimulatedArm,
    Workspace,
    read_geometry,
    shipped_geometry_path,
)
from probewise.arm.nxt import Brick, BrickMachine, Link
from probewise.cli._common import CommandError, print_result, print_warning, say, write_to_terminal
from probewise.cli._options import ARMS, SCENE, parse_finite_numbers, parse_place, refuse_options
from probewise.errors import ParameterError, did_you_mean, require
from probewise.verbs import DEFAULT_SEED
from probewise.world import Reader

if TYPE_CHECKING:
    from probewise.world import Surface, World

_WAIT_S = 0.5  # longest wait for a person between checks of signals and keep-alives of the brick
_SEEN_MM = 0.5  # least offset of the sensor from a mark, and gap above the block, that a simulated person notices
Opened: TypeAlias = "tuple[LegoArm | OwnInstrument | SimulatedArm, SimulatedBench | None]"
"""An arm with its simulated bench, None for a real arm."""

NO_ARM = "--arm is missing: name the brick, such as --arm nxt:/dev/rfcomm0"


# Opening an arm


@dataclasses.dataclass(frozen=True)
class ArmName:
    """An arm as chosen by --arm: its `kind`, and `where`: its port or file, or an emulated arm's true geometry file.

    A real one is a brick or a user's own instrument; the reach of a LEGO arm, real or emulated, follows from its
    geometry, from which the arm as built may differ.
    """

    kind: str
    where: str = ""

    @property
    def is_real(self) -> bool:
        return self.kind in ("nxt", "file")

    @property
    def is_lego(self) -> bool:
        return self.kind in ("nxt", "emulator")

    @property
    def may_differ_from_geometry(self) -> bool:
        return self.kind == "nxt" or (self.kind == "emulator" and bool(self.where))


def parse_arm(text: str) -> ArmName:
    """Parse the name of an arm: "simulated", "emulator[:TRUE.toml]", "nxt:PORT" or "FILE.py"."""
    if text in ("simulated", "emulator"):
        return ArmName(text)
    kind, _, where = text.partition(":")
    if kind in ("emulator", "nxt") and where:
        return ArmName(kind, where)
    if text.endswith(".py"):
        return ArmName("file", text)
    meant = "; its port is missing" if kind == "nxt" else did_you_mean(kind, ("simulated", "emulator", "nxt"))
    raise ParameterError("--arm", text, ARMS + meant)


def open_brick(port: str) -> Brick:
    return Brick.open(port)


def open_nxt_arm(port: str, geometry: Geometry, *, start_s: float = 0.0) -> LegoArm:
    return LegoArm(BrickMachine(open_brick(port), geometry), geometry, start_s=start_s)


def open_arm(
    chosen: ArmName,
    geometry: Geometry | None,
    built: Path | None = None,
    light: tuple[World, ReadingScale] | None = None,
    surface: Surface | None = None,
    *,
    reach: Workspace | None = None,
    seed: int = DEFAULT_SEED,
    start_s: float = 0.0,
    n_taken: int = 0,
    taken: Sequence[Reading] = (),
) -> Opened:
    """Open an arm; return it with its simulated bench, None for a real arm.

    A user's instrument is connected when it is entered. An emulated arm is built as its name says, or as the file
    `built`; a simulated one has this `reach`, and starts at the last pose of `taken`. Both read with `light`, by
    default the sensor of the shipped recordings, over `surface`, by default the usual target, with noise of this
    `seed`, after the `n_taken` readings of an earlier session, or after those `taken` over this surface.
    """
    if chosen.kind == "file":
        return OwnInstrument.from_file(chosen.where, start_s=start_s), None
    geometry = geometry or read_geometry(shipped_geometry_path())
    if chosen.kind == "nxt":
        return open_nxt_arm(chosen.where, geometry, start_s=start_s), None
    world, scale = light or world_and_scale(None)
    surface = emulator.parse_scene(SCENE) if surface is None else surface
    if chosen.is_lego:
        setting = (geometry, chosen.where or built, world, surface)
        arm, bench = open_emulated_arm_and_bench(*setting, seed=seed + n_taken + len(taken), start_s=start_s)
        return arm, SimulatedBench(bench.table, bench.arm.sensor_pose)
    table, reader = emulator.Tabletop(surface), Reader(world, seed=(seed,), first=n_taken)

    def read_world(pose: Pose, time_s: float, height_mm: float) -> float:
        place = (pose.x_mm, pose.y_mm, pose.orientation_rad)
        return table.read(reader, *place, time_s=time_s, height_mm=height_mm)

    for earlier in taken:
        read_world(earlier.pose, earlier.time_s, earlier.covariates.get("height_mm", world.height_mm))
    reach = reach or Reach()
    last = taken[-1] if taken else Reading(math.nan, Pose(*reach.rest_mm), start_s)
    simulated = SimulatedArm(read_world, reach=reach, scale=scale, height_mm=world.height_mm, last=last)
    return simulated, SimulatedBench(table)


def open_lego_arm(arguments: argparse.Namespace, geometry: Geometry, *, start_s: float = 0.0) -> LegoArm:
    """Open the arm of --arm, or for --dry-run one that only prints its moves."""
    if arguments.dry_run:
        return LegoArm(DryRun(geometry, print_result), geometry, start_s=start_s)
    if arguments.arm is None:
        raise CommandError(f"{NO_ARM}; or --dry-run prints the moves only")
    return open_nxt_arm(nxt_port(arguments.arm), geometry, start_s=start_s)


def open_instrument(
    arguments: argparse.Namespace, geometry: Geometry, *, scene: str = SCENE, watched: bool = False, **taken: Any
) -> Opened:
    """Open the arm for a task that every arm can do; return it with its simulated bench, None for a real arm.

    Unless a person watches all its moves, its first lowering is confirmed. `taken` says, by `start_s` and `n_taken`,
    what an earlier session has read.
    """
    chosen = None if arguments.arm is None else parse_arm(arguments.arm)
    if chosen is None or chosen.kind == "nxt":
        refuse_options(arguments, "a real arm", "sensor", "scene", "seed")
        opened: Opened = open_lego_arm(arguments, geometry, start_s=taken.get("start_s", 0.0)), None
    else:
        require(not arguments.dry_run, "--dry-run", True, f"none with {arguments.arm}: it is for the LEGO arm")
        if chosen.kind == "file":
            refuse_options(arguments, arguments.arm, "geometry", "sensor", "scene", "seed")
        sensor, seed = getattr(arguments, "sensor", None), getattr(arguments, "seed", None)
        surface = emulator.parse_scene(getattr(arguments, "scene", None) or scene)
        light = None if chosen.kind == "file" else world_and_scale(sensor, lego=chosen.is_lego)
        seed = DEFAULT_SEED if seed is None else seed
        reach = None if arguments.geometry is None else geometry
        opened = open_arm(chosen, geometry, arguments.geometry, light, surface, reach=reach, seed=seed, **taken)
        if opened[1] is not None and arguments.task != "scan":
            say(arguments, f"seed {seed}")
    if chosen is not None and not arguments.dry_run and not watched:
        confirm_lowering(chosen, opened[0], geometry)
    return opened


def nxt_port(name: str) -> str:
    """Return the port of "nxt:PORT"; raise ParameterError for any other arm."""
    chosen = parse_arm(name)
    require(chosen.kind != "file", "--arm", name, "nxt:PORT; FILE.py is for `arm scan`, `arm record` and `explore`")
    if chosen.kind != "nxt":
        allowed = "nxt:PORT, also that of `probewise emulate-nxt`, a brick in software; --dry-run prints the moves"
        raise ParameterError("--arm", name, allowed)
    return chosen.where


def prompter_unless_dry_run(arguments: argparse.Namespace, arm: Instrument) -> Callable[[object], None]:
    """Return a function that prompts the person; in a dry run, it only prints the request."""
    return (lambda text: print_result(f"ask: {text}")) if arguments.dry_run else prompter(arm)


def open_emulated_arm_and_bench(
    geometry: Geometry,
    geometry_file: str | Path | None,
    world: World,
    surface: Surface,
    *,
    seed: int,
    start_s: float = 0.0,
) -> tuple[LegoArm, emulator.EmulatedBench]:
    """Open the LEGO arm on an emulated brick, built as `geometry_file` says, over a simulated table; and its bench.

    The clock runs as fast as possible. When the arm's `with` block ends, it warns if the sensor hit the table.
    """
    clock = emulator.VirtualClock()
    built = Path(geometry_file or shipped_geometry_path())
    read_geometry(built)  # the emulator takes numbers from a file without a fault
    bench = emulator.set_up_bench(emulator.read_geometry(built), world, surface, clock, seed=seed, sleep_min=0)
    brick = Brick(Link(emulator.VirtualLine(bench.radio, clock), clock=clock), clock=clock)

    class TableContactReporter(LegoArm):
        def __exit__(
            self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
        ) -> None:
            super().__exit__(kind, error, trace)
            lowest = bench.arm.lowest
            if lowest.height_mm < 0:
                print_warning(
                    f"the emulated arm's sensor went {-lowest.height_mm:.1f} mm through the table, at "
                    f"({lowest.x_mm:.0f}, {lowest.y_mm:.0f}) mm"
                )

    return TableContactReporter(BrickMachine(brick, geometry), geometry, clock=clock, start_s=start_s), bench


def world_and_scale(sensor: Path | None, *, lego: bool = False) -> tuple[World, ReadingScale]:
    """Return the world of a sensor.json and the scale of its readings; for None those of the shipped recordings.

    Raises ParameterError if the sensor of a LEGO arm reads in another unit.
    """
    if sensor is None:
        from probewise.world.shipped import true_world

        return true_world("paper"), ReadingScale()
    from probewise.calibration import read_sensor
    from probewise.experiment import scale_of, world_like

    fitted = read_sensor(sensor)
    if lego and fitted.instrumentation.unit not in ("", "LEGO"):
        raise ParameterError("--sensor", str(sensor), "one that reads in LEGO units, as the brick does")
    return world_like(fitted), scale_of(fitted.instrumentation)


@dataclasses.dataclass(frozen=True)
class SimulatedBench:
    """The table under a simulated or an emulated arm, on which the program itself lays the patterns.

    `stand` returns where an emulated arm's sensor truly is; a simulated one (None) is where it was commanded.
    """

    table: emulator.Tabletop
    stand: Callable[[], emulator.SensorPose] | None = None

    def answer_at_mark(self, mark_mm: tuple[float, float], block_mm: float) -> str:
        """Answer like a person who watches an emulated arm's sensor over a mark: "ok", or moves, "x 5 down 2"."""
        if self.stand is None:
            raise ParameterError("--arm", "simulated", "emulator: the simulated arm has no position error to see")
        stand = self.stand()
        across = (mark_mm[0] - stand.x_mm, mark_mm[1] - stand.y_mm)
        gap_mm = stand.height_mm - block_mm
        off_mm = [(axis, off) for axis, off in zip("xy", across, strict=True) if abs(off) > _SEEN_MM]
        words = [f"{axis} {round(2 * off) / 2:g}" for axis, off in off_mm]
        if not words and gap_mm <= _SEEN_MM:
            return "ok"
        if gap_mm < -_SEEN_MM:
            words.append(f"up {round(-2 * gap_mm) / 2 + _SEEN_MM:g}")
        elif not words:
            words.append(f"down {max(min(gap_mm - _SEEN_MM / 2, gap_mm / 2 if gap_mm > 8 else gap_mm), 0.2):.1f}")
        return " ".join(words)

    def carry_out_request(
        self, patterns: Mapping[str, recordings.Pattern], origin_mm: tuple[float, float], request: RequestToPerson
    ) -> None:
        """Carry out a request of `carry_out`: lay a pattern with its origin at `origin_mm`, or turn the sensor."""
        if request.pattern is not None:
            self.table.surface, self.table.origin_mm = patterns[request.pattern], origin_mm
        if request.turned_rad is not None:
            self.table.turned_rad = request.turned_rad


# Adapting a plan to an arm: unit, range and step of its readings, and the columns that can be commanded


def plan_for_own_instrument(
    plan: recordings.Plan, *, unit: str | None = None, range_: str | None = None, step: str | None = None
) -> recordings.Plan:
    """Return the plan for a user's instrument; a given range, step, or unit, which drops both, is the readings' own."""
    declared: dict[str, object] = {}
    if unit is not None:  # the values declared in the plan have another unit
        declared = {"unit": unit, "min": None, "max": None, "step": None, "sensor": ""}
    if range_ is not None:
        declared["min"], declared["max"] = parse_finite_numbers("--range", range_, 2, "LOW,HIGH such as 0,1023")
    if step is not None:
        (declared["step"],) = parse_finite_numbers("--step", step, 1, "a number such as 1")
    return without_measured_covariates(plan, dataclasses.replace(plan.instrumentation, **declared))  # type: ignore[arg-type]


def plan_for_lego_arm(plan: recordings.Plan, geometry: Geometry) -> recordings.Plan:
    """Return the plan for the LEGO arm: in LEGO units, 1 to 100, at its reading height; no measured covariates."""
    instrumentation = dataclasses.replace(
        plan.instrumentation,
        unit="LEGO",
        min=1.0,
        max=100.0,
        step=1.0 if geometry.whole_percent else None,
        sensor=plan.instrumentation.sensor or "LEGO 9844 light sensor",
        height_mm=geometry.read_height_mm,
    )
    return without_measured_covariates(plan, instrumentation)


def without_measured_covariates(plan: recordings.Plan, instrumentation: recordings.Instrumentation) -> recordings.Plan:
    """Return the plan by an instrumentation, with the covariates that can be commanded: controls, LED and height."""
    plan = dataclasses.replace(plan, instrumentation=instrumentation)
    can = {*plan.instrumentation.controls, "led", "height_mm"}
    return dataclasses.replace(plan, covariates={name: v for name, v in plan.covariates.items() if name in can})


def origin_of_plan(arguments: argparse.Namespace, geometry: Geometry, *, is_own: bool) -> tuple[float, float]:
    """Return where on the field a plan's origin lies: as --origin-mm says, else the middle of a LEGO arm's field."""
    if arguments.origin_mm is not None:
        return parse_place("--origin-mm", arguments.origin_mm)
    width, height = (0.0, 0.0) if is_own else geometry.field_mm
    return width / 2, height / 2


# The person at the bench


def prompter(arm: Instrument) -> Callable[[object], None]:
    """Return a function that prompts a person for something to do and waits for Enter, while keeping the arm awake."""
    ask = prompter_for_answer(arm)

    def press_enter(request: object) -> None:
        text = str(request)
        ask(f"{text[0].upper()}{text[1:]}, then press Enter: ")

    return press_enter


def prompter_for_answer(arm: Instrument) -> Callable[[str], str]:
    """Return a function that asks a person and returns the line typed, while keeping the arm awake."""
    keep_awake: Callable[[], None] = getattr(arm, "keep_awake", lambda: None)

    def ask(text: str) -> str:
        raise_if_stopped()  # an arm may have held the stop back until its reading was kept
        answers: queue.Queue[str] = queue.Queue()

        def read_line() -> None:
            try:
                answers.put("" if sys.stdin is None else sys.stdin.readline())
            except (OSError, ValueError):
                answers.put("")

        with tqdm.external_write_mode(file=sys.stderr):  # a progress bar would overwrite the question
            write_to_terminal(sys.stderr, text)
            # Reading a line cannot be interrupted, so it runs in a daemon thread.
            threading.Thread(target=read_line, daemon=True).start()
            answer = None
            while answer is None:
                try:
                    answer = answers.get(timeout=_WAIT_S)
                except queue.Empty:
                    keep_awake()
        if not answer:
            raise CommandError("nobody is there to press Enter: standard input has ended; run it in a terminal")
        return answer.strip()

    return ask


def confirm_lowering(chosen: ArmName, arm: Instrument, geometry: Geometry | None) -> None:
    """Warn if the sensor may hit the table; let a person who can watch confirm each step of the first lowering."""
    if geometry is None or not chosen.may_differ_from_geometry or not isinstance(arm, LegoArm):
        return
    warn_if_clearance_doubtful(geometry)
    if chosen.kind == "nxt" and geometry.accuracy is None and sys.stdin is not None and sys.stdin.isatty():
        confirm_each_step_down(arm)


def confirm_each_step_down(arm: LegoArm) -> None:
    ask, free = prompter(arm), "above the table, and free to be lowered further"
    arm.first_down = lambda height_mm: ask(f"check that the sensor is {height_mm:.0f} mm {free}")


def warn_if_clearance_doubtful(geometry: Geometry) -> None:
    """Warn if the sensor may touch the table: if its height may be wrong by the reading height or more."""
    doubt_mm = geometry.max_height_error_mm
    if doubt_mm < geometry.read_height_mm:
        return
    known = "by its [accuracy] the arm may hang lower by"
    if geometry.accuracy is None:
        known = "home angles of both links that are 2 degrees off cost up to"
    print_warning(
        f"the sensor may touch the table: it reads {geometry.read_height_mm:g} mm above it, and {known} "
        f"{doubt_mm:.0f} mm; fit the geometry (probewise arm fit-geometry), or look how it comes down "
        "(probewise arm jog X,Y --down --steps)"
    )


def warn_if_place_sd_large(geometry: Geometry, stop_sd_mm: float) -> None:
    """Warn if the sd of the arm's position, as fitted to marks, is no smaller than the sd at which a run stops."""
    accuracy = geometry.accuracy
    if accuracy is None or accuracy.place_sd_mm < stop_sd_mm:
        return
    print_warning(
        f"lengths will not be known to {stop_sd_mm:g} mm: the arm knows its place to {accuracy.place_sd_mm:.1f} mm, "
        "which no reading lowers; `probewise arm fit-geometry` does, with more marks or with marks met more closely"
    )
