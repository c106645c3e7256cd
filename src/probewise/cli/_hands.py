"""A person at the bench who lays sheets and turns the sensor, and a look at each sheet once it lies."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

import numpy as np

from probewise.arm import Pose
from probewise.arm.carry_out import Request, bounds_of
from probewise.cli._arm import questioner
from probewise.cli._bench import moved
from probewise.cli._common import caution
from probewise.emulator.scenes import scene_text
from probewise.errors import ParameterError

if TYPE_CHECKING:
    from probewise.arm import LegoArm, OwnInstrument, SimulatedArm
    from probewise.cli._sheet_watch import SheetWatch
    from probewise.recordings import Plan

__all__ = ["Hands", "is_pty"]


class Hands:
    """Ask a person for what `carry_out` wants; look over the white and the black of a sheet before it is scanned.

    Parameters
    ----------
    arm
        The arm, entered.
    plan, origin_mm
        What is carried out, and where its origin lies.
    watch
        What judges readings.
    looks
        Whether a sheet is looked at before it is scanned. An instrument of one's own takes the plan's readings alone.
    typed
        Whether the bench is an emulator's, so that what is to be done is typed in its terminal.
    """

    def __init__(
        self,
        arm: LegoArm | OwnInstrument | SimulatedArm,
        plan: Plan,
        origin_mm: tuple[float, float],
        watch: SheetWatch,
        *,
        looks: bool,
        typed: bool,
    ) -> None:
        self._arm, self._plan, self._origin, self._watch, self._typed = arm, plan, origin_mm, watch, typed
        self._looks = looks
        self._answer = questioner(arm)

    def __call__(self, request: Request) -> None:
        """Ask, and look at what was laid until it is right or the person goes on all the same."""
        text = f"{request[0].upper()}{request[1:]}{self._to_type(request)}"
        self._answer(f"{text}, then press Enter: ")
        if request.pattern is None or not self._looks:
            return
        while (wrong := self._look(request.pattern)) is not None:
            if sys.stdin is None or not sys.stdin.isatty():  # whoever answers from a file lays nothing right
                caution(f"{wrong}; is the right sheet there, the right way round?")
                break
            said = self._answer(f"{wrong}. Lay it right and press Enter, or type go to go on all the same: ")
            if said.lower() == "go":
                break

    def _to_type(self, request: Request) -> str:
        """Say what to type in the emulator's terminal."""
        if not self._typed:
            return ""
        if request.turned_rad is not None:
            return f" (in the emulator's terminal: turn {np.degrees(request.turned_rad):g})"
        if request.pattern is None:
            return ""
        try:
            scene = scene_text(moved(self._plan.patterns[request.pattern], self._origin))
        except ParameterError:
            return " (the emulator's terminal knows no such pattern; --arm emulator lays it by itself)"
        return f" (in the emulator's terminal: {scene})"

    def _look(self, name: str) -> str | None:
        bounds, origin = bounds_of(self._arm), np.array(self._origin)
        values = {}
        for is_white, place in self._watch.places(name, lambda places: bounds.holds(places + origin)).items():
            x_mm, y_mm = (np.array(place) + origin).tolist()
            standing = float(self._arm.orientation_rad(np.array([[x_mm, y_mm]]))[0])
            values[is_white] = self._arm.measure(Pose(x_mm, y_mm, standing)).value
        return self._watch.looked(name, values)


def is_pty(port: str) -> bool:
    """Tell a pseudo-terminal, behind which there is an emulator, from a serial line."""
    return os.path.realpath(port).startswith(("/dev/pts/", "/dev/ttys"))
