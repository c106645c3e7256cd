"""The options that name an arm: --arm, --geometry, places, plans that ship."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from probewise.cli._common import add, parse_finite_numbers, parse_path
from probewise.errors import ParameterError, did_you_mean
from probewise.progress import Progress, silent

if TYPE_CHECKING:
    from probewise.arm import Geometry
    from probewise.recordings import Plan

ARMS = (
    "simulated; emulator, the LEGO arm in software, or emulator:TRUE.toml, built differently from --geometry; "
    "nxt:PORT such as nxt:/dev/rfcomm0 or nxt:COM5; or FILE.py, an instrument of your own (a "
    "program: run only those that you trust)"
)
"""Names of arms, the same in every verb."""

SCENE = "600,250,80"
"""Default target on the field of an emulated or simulated bench: a circle, in mm."""

SHIPPED = ("paper", "two_way")
"""Names of the plans that ship."""


def add_arm(parser: argparse.ArgumentParser) -> None:
    """Add --arm, the simulated one by default."""
    add(parser, "--arm ARM", f"where the readings come from: {ARMS} (default simulated)", default="simulated")


def add_geometry(parser: argparse.ArgumentParser, default: str = "the file that ships") -> None:
    """Add --geometry; `default` says in its help which geometry it has otherwise."""
    about = f"the arm as built: lengths, gears, ports, limits (default: {default})"
    add(parser, "--geometry ARM.toml", about, type=parse_path)


def read_or_shipped_geometry(arguments: argparse.Namespace) -> Geometry:
    """Read the geometry of --geometry, or the shipped one."""
    from probewise.arm import read_geometry, shipped_geometry_path

    return read_geometry(arguments.geometry or shipped_geometry_path())


def read_or_shipped_plan(text: str, *, progress: Progress = silent) -> Plan:
    """Read the plan of a file, or take the one of that name that ships, unless a file has the name."""
    from probewise.recordings import paper_plan, read_plan, two_way_plan

    if text in SHIPPED and not Path(text).exists():
        return paper_plan() if text == "paper" else two_way_plan()
    return read_plan(text, progress=progress)


@dataclass(frozen=True)
class ArmName:
    """An arm as chosen by --arm: its `kind`, and `where`: its port or file, or an emulated arm's true geometry file."""

    kind: str
    where: str = ""

    @property
    def is_real(self) -> bool:
        """Whether it is a brick or a user's own instrument."""
        return self.kind in ("nxt", "file")

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


def parse_place(name: str, text: str) -> tuple[float, float]:
    """Parse "X,Y" in mm; raise ParameterError, with the option's name, for anything else."""
    x_mm, y_mm = parse_finite_numbers(name, text, 2, "X,Y in mm, such as 524,260")
    return x_mm, y_mm
