"""Options and helpers of the verbs that use an arm: its name, geometry, opening, prompts to a person."""

from __future__ import annotations

import argparse
import math
import queue
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Literal, Self

from probewise._kinds import did_you_mean
from probewise.cli._common import CommandError, add_path, print_warning, write_to_terminal
from probewise.cli._stopping import raise_if_stopped
from probewise.errors import ParameterError

if TYPE_CHECKING:
    from probewise.arm import Geometry, Instrument, LegoArm, Machine, OwnInstrument, Pose, Reading
    from probewise.arm.basics import Clock
    from probewise.arm.nxt import Brick
    from probewise.emulator import EmulatedBench
    from probewise.world import Surface, World

ARMS = (
    "simulated; emulator, the LEGO arm in software, or emulator:TRUE.toml, built differently from --geometry; "
    "nxt:PORT such as nxt:/dev/rfcomm0 or nxt:COM5; or FILE.py, an instrument of your own (a "
    "program: run only those that you trust)"
)
"""Names of arms, the same in every verb."""

SCENE = "600,250,80"
"""Default target on the field of an emulated or simulated bench: a circle, in mm."""

WAIT_S = 0.5  # longest wait for a person between checks of signals and keep-alives of the brick


def add_geometry(parser: argparse.ArgumentParser, default: str = "the file that ships") -> None:
    """Add --geometry; `default` says in its help which geometry it has otherwise."""
    add_path(parser, "--geometry", "ARM.toml", f"the arm as built: lengths, gears, ports, limits (default: {default})")


def read_or_shipped_geometry(arguments: argparse.Namespace) -> Geometry:
    """Read the geometry of --geometry, or the shipped one."""
    from probewise.arm import read_geometry, shipped_geometry_path

    return read_geometry(arguments.geometry or shipped_geometry_path())


@dataclass(frozen=True)
class ArmName:
    """An arm as chosen by --arm: its kind, and `where`: its port or file, or an emulated arm's true geometry file."""

    kind: Literal["simulated", "emulator", "nxt", "file"]
    where: str = ""

    @property
    def is_lego(self) -> bool:
        """Whether it is a LEGO arm, real or emulated, whose reach follows from its geometry."""
        return self.kind in ("nxt", "emulator")

    @property
    def may_differ_from_geometry(self) -> bool:
        """Whether the arm as built may differ from the geometry of --geometry."""
        return self.kind == "nxt" or (self.kind == "emulator" and bool(self.where))

    def true_geometry_file(self, geometry_file: Path | None) -> Path | None:
        """Return the file of an emulated arm's true geometry, by default the given one; None: the shipped one."""
        return Path(self.where) if self.where else geometry_file


def parse_arm(text: str) -> ArmName:
    """Parse the name of an arm: "simulated", "emulator[:TRUE.toml]", "nxt:PORT" or "FILE.py".

    Raises ParameterError if it is none of these.
    """
    if text == "simulated":
        return ArmName("simulated")
    if text == "emulator":
        return ArmName("emulator")
    kind, _, port = text.partition(":")
    if kind == "emulator" and port:
        return ArmName("emulator", port)
    if kind == "nxt" and port:
        return ArmName("nxt", port)
    if text.endswith(".py"):
        return ArmName("file", text)
    raise ParameterError("--arm", text, ARMS + did_you_mean(kind, ("simulated", "emulator", "nxt")))


def open_own_instrument(path: str, *, start_s: float = 0.0) -> OwnInstrument:
    """Return the instrument of a user's file; its `connect()` is called when the instrument is entered."""
    from probewise.arm import OwnInstrument

    return OwnInstrument.from_file(path, start_s=start_s)


def open_emulated_arm_and_bench(
    geometry: Geometry,
    geometry_file: Path | None,
    world: World,
    surface: Surface,
    *,
    seed: int,
    start_s: float = 0.0,
) -> tuple[LegoArm, EmulatedBench]:
    """Open the LEGO arm on an emulated brick over a simulated table; return the arm and the bench.

    The clock runs as fast as possible. The emulator reads its own true geometry: `geometry_file`, or the shipped one.
    """
    from probewise.arm.nxt import Brick, BrickMachine, Link
    from probewise.emulator import VirtualClock, VirtualLine, read_geometry, set_up_bench, shipped_geometry_path

    clock = VirtualClock()
    numbers = read_geometry(geometry_file or shipped_geometry_path())
    bench = set_up_bench(numbers, world, surface, clock, seed=seed, sleep_min=0)
    brick = Brick(Link(VirtualLine(bench.radio, clock), clock=clock), clock=clock)
    machine = BrickMachine(brick, geometry)
    return arm_reporting_table_contact(machine, geometry, bench, clock=clock, start_s=start_s), bench


def arm_reporting_table_contact(
    machine: Machine, geometry: Geometry, bench: EmulatedBench, *, clock: Clock, start_s: float
) -> LegoArm:
    """Return the arm on an emulated bench; when its `with` block ends, it warns if the sensor hit the table."""
    from probewise.arm import LegoArm

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

    return TableContactReporter(machine, geometry, clock=clock, start_s=start_s)


def warn_if_clearance_doubtful(geometry: Geometry) -> None:
    """Warn if the sensor may touch the table: if its height may be wrong by the reading height or more."""
    doubt_mm = geometry.max_height_error_mm
    if doubt_mm < geometry.read_height_mm:
        return
    known = (
        "home angles of both links that are 2 degrees off cost up to"
        if geometry.accuracy is None
        else "by its [accuracy] the arm may hang lower by"
    )
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


def enable_confirmed_lowering(arm: LegoArm) -> LegoArm:
    """Make the arm ask a person, at its first lowering, to confirm each step; return the same arm."""
    ask = prompter(arm)

    def confirm(height_mm: float) -> None:
        ask(f"the sensor should be {height_mm:.0f} mm above the table; if so, and it may be lowered further")

    arm.first_down = confirm
    return arm


def warn_and_confirm_lowering(chosen: ArmName, instrument: Instrument, geometry: Geometry | None) -> None:
    """Warn if the sensor may hit the table; let a person who can watch confirm each step of the first lowering."""
    from probewise.arm import LegoArm

    if geometry is None or not chosen.may_differ_from_geometry or not isinstance(instrument, LegoArm):
        return
    warn_if_clearance_doubtful(geometry)
    if chosen.kind == "nxt" and geometry.accuracy is None and sys.stdin is not None and sys.stdin.isatty():
        enable_confirmed_lowering(instrument)


def parse_place(name: str, text: str) -> tuple[float, float]:
    """Parse "X,Y" in mm; raise ParameterError, with the option's name, for anything else."""
    try:
        x_mm, y_mm = (float(cell) for cell in text.split(","))
    except ValueError:
        x_mm = y_mm = math.nan
    if not (math.isfinite(x_mm) and math.isfinite(y_mm)):
        raise ParameterError(name, text, "X,Y in mm, such as 524,260")
    return x_mm, y_mm


def open_nxt_arm(port: str, geometry: Geometry, *, start_s: float = 0.0) -> LegoArm:
    """Connect to the LEGO brick at a port; return its arm."""
    from probewise.arm import LegoArm
    from probewise.arm.nxt import BrickMachine

    return LegoArm(BrickMachine(open_brick(port), geometry), geometry, start_s=start_s)


def open_brick(port: str) -> Brick:
    """Connect to the LEGO brick at a port; return the brick."""
    from probewise.arm.nxt import Brick

    return Brick.open(port)


class InstrumentWithCallbacks:
    """An instrument that calls `moving` with the pose before each move, and `read` with each reading."""

    def __init__(self, instrument: Instrument, moving: Callable[[Pose], None], read: Callable[[Reading], None]) -> None:
        self._instrument, self._moving, self._read = instrument, moving, read
        self.reachable, self.orientation_rad = instrument.reachable, instrument.orientation_rad
        self.travel_s = instrument.travel_s

    @property
    def read_height_mm(self) -> float | None:
        """The instrument's height above the surface when it reads, in mm, if it declares one."""
        height_mm: float | None = getattr(self._instrument, "read_height_mm", None)
        return height_mm

    @property
    def turns(self) -> bool:
        """Whether the instrument declares that it can turn its sensor."""
        return bool(getattr(self._instrument, "turns", False))

    @property
    def lifts(self) -> bool:
        """Whether the instrument declares that it can read at other heights."""
        return bool(getattr(self._instrument, "lifts", False))

    def __enter__(self) -> Self:
        self._instrument.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Bring the instrument to rest."""
        self._instrument.__exit__(kind, error, trace)

    def measure(self, pose: Pose) -> Reading:
        """Call `moving`, measure, call `read`, and return the reading."""
        self._moving(pose)
        reading = self._instrument.measure(pose)
        self._read(reading)
        return reading


def prompter(arm: Instrument) -> Callable[[str], None]:
    """Return a function that prompts a person and waits for Enter, while keeping the arm awake."""
    answer_to = prompter_for_answer(arm)

    def ask(text: str) -> None:
        answer_to(f"{text[0].upper()}{text[1:]}, then press Enter: ")

    return ask


def _read_line() -> str:
    """Read a line of standard input; "" if it has ended or cannot be read."""
    try:
        return "" if sys.stdin is None else sys.stdin.readline()
    except (OSError, ValueError):
        return ""


def prompter_for_answer(arm: Instrument) -> Callable[[str], str]:
    """Return a function that asks a person and returns the line typed, while keeping the arm awake.

    It raises CommandError if standard input has ended.
    """
    keep_awake: Callable[[], None] = getattr(arm, "keep_awake", lambda: None)

    def ask(text: str) -> str:
        from tqdm import tqdm

        raise_if_stopped()  # an arm may have held the stop back until its reading was kept
        answers: queue.Queue[str] = queue.Queue()
        with tqdm.external_write_mode(file=sys.stderr):  # a progress bar would overwrite the question
            write_to_terminal(sys.stderr, text)
            # Reading a line cannot be interrupted, so it runs in a daemon thread.
            threading.Thread(target=lambda: answers.put(_read_line()), daemon=True).start()
            while True:
                try:
                    answer = answers.get(timeout=WAIT_S)
                except queue.Empty:
                    keep_awake()
                else:
                    break
        if not answer:
            raise CommandError("nobody is there to press Enter: standard input has ended; run it in a terminal")
        return answer.strip()

    return ask
