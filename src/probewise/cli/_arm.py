"""What the verbs that use a real arm share: which arm, its geometry, a person to ask."""

from __future__ import annotations

import argparse
import math
import queue
import sys
import threading
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Self

from probewise.cli._common import CommandError, a_path
from probewise.errors import ParameterError

if TYPE_CHECKING:
    from probewise.arm import Geometry, Instrument, LegoArm, Pose, Reading
    from probewise.arm.nxt import Brick

__all__ = [
    "Telling",
    "add_geometry",
    "asker",
    "geometry_of",
    "open_brick",
    "open_nxt",
    "parse_arm",
    "parse_place",
]

WAIT_S = 0.5  # where a wait for a person hears no signal, it lasts so long; the brick is then kept awake


def add_geometry(parser: argparse.ArgumentParser, default: str = "the file that ships") -> None:
    """Add --geometry, and say what stands for it where it is not given."""
    parser.add_argument(
        "--geometry",
        type=a_path,
        metavar="ARM.toml",
        help=f"the arm as built: lengths, gears, ports, limits (default: {default})",
    )


def geometry_of(arguments: argparse.Namespace) -> Geometry:
    """Read the geometry that was asked for, or the shipped one."""
    from probewise.arm import read_geometry, shipped_geometry

    return read_geometry(arguments.geometry or shipped_geometry())


def parse_arm(text: str) -> str | None:
    """Read "simulated" (None) or "nxt:PORT" (the port)."""
    kind, _, port = text.partition(":")
    if text == "simulated":
        return None
    if kind != "nxt" or not port:
        raise ParameterError("--arm", text, "simulated, or nxt:PORT such as nxt:/dev/rfcomm0 or nxt:COM5")
    return port


def parse_place(name: str, text: str) -> tuple[float, float]:
    """Read "X,Y" in mm."""
    try:
        x_mm, y_mm = (float(cell) for cell in text.split(","))
    except ValueError:
        x_mm = y_mm = math.nan
    if not (math.isfinite(x_mm) and math.isfinite(y_mm)):
        raise ParameterError(name, text, "X,Y in mm, such as 524,260")
    return x_mm, y_mm


def open_nxt(port: str, geometry: Geometry, *, start_s: float = 0.0) -> LegoArm:
    """Open the line to a brick, with the arm that hangs on it."""
    from probewise.arm import LegoArm
    from probewise.arm.nxt import BrickMachine

    return LegoArm(BrickMachine(open_brick(port), geometry), geometry, start_s=start_s)


def open_brick(port: str) -> Brick:
    """Open the line to a brick."""
    from probewise.arm.nxt import Brick

    return Brick.open(port)


class Telling:
    """An instrument that says where it moves before it does, and what it read: seconds pass on a real arm."""

    def __init__(self, instrument: Instrument, moving: Callable[[Pose], None], read: Callable[[Reading], None]) -> None:
        self._instrument, self._moving, self._read = instrument, moving, read
        self.reachable, self.orientation_rad = instrument.reachable, instrument.orientation_rad
        self.travel_s = instrument.travel_s

    def __enter__(self) -> Self:
        self._instrument.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Bring the instrument to rest."""
        self._instrument.__exit__(kind, error, trace)

    def measure(self, pose: Pose) -> Reading:
        """Say it, measure, say what was read."""
        self._moving(pose)
        reading = self._instrument.measure(pose)
        self._read(reading)
        return reading


def asker(arm: LegoArm) -> Callable[[str], None]:
    """Make what asks a person and waits for Enter, while the arm is kept awake."""

    def ask(text: str) -> None:
        sys.stderr.write(f"{text[0].upper()}{text[1:]}, then press Enter: ")
        sys.stderr.flush()
        answers: queue.Queue[str] = queue.Queue()
        # Reading a line cannot be cut short, so that it waits in a thread that the program need not wait for.
        threading.Thread(target=lambda: answers.put(sys.stdin.readline()), daemon=True).start()
        while True:
            try:
                answer = answers.get(timeout=WAIT_S)
            except queue.Empty:
                arm.keep_awake()
            else:
                break
        if not answer:
            raise CommandError("nobody is there to press Enter: standard input has ended; run it in a terminal")

    return ask
