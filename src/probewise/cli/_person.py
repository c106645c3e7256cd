"""Prompts to a person who lays sheets and turns the sensor, and a check of each sheet once it is laid."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

import numpy as np

from probewise.arm import Pose
from probewise.arm.carry_out import RequestToPerson, reachable_places_of
from probewise.cli._arm import prompter_for_answer
from probewise.cli._bench import shifted_pattern
from probewise.cli._common import print_warning
from probewise.emulator.scenes import scene_text
from probewise.errors import ParameterError

if TYPE_CHECKING:
    from probewise.arm import LegoArm, OwnInstrument, SimulatedArm
    from probewise.cli._sheet_check import SheetCheck
    from probewise.recordings import Plan


class PersonAtBench:
    """A function that prompts a person to carry out a request of `carry_out`, and then checks the sheet that was laid.

    Parameters
    ----------
    arm
        The arm, entered.
    plan, origin_mm
        The plan, and the place of its origin.
    sheet_check
        The check of readings against the patterns.
    check_sheets
        Whether a sheet is checked before it is scanned; a user's own instrument takes only the plan's readings.
    emulated
        Whether the bench is an emulator, so that requests are carried out by typing in its terminal.
    """

    def __init__(
        self,
        arm: LegoArm | OwnInstrument | SimulatedArm,
        plan: Plan,
        origin_mm: tuple[float, float],
        sheet_check: SheetCheck,
        *,
        check_sheets: bool,
        emulated: bool,
    ) -> None:
        self._arm, self._plan, self._origin, self._sheet_check, self._emulated = (
            arm,
            plan,
            origin_mm,
            sheet_check,
            emulated,
        )
        self._check_sheets = check_sheets
        self._answer = prompter_for_answer(arm)

    def __call__(self, request: RequestToPerson) -> None:
        """Prompt, and check the sheet until it is right or the person overrides the check."""
        text = f"{request[0].upper()}{request[1:]}{self._hint_for_emulator_terminal(request)}"
        self._answer(f"{text}, then press Enter: ")
        if request.pattern is None or not self._check_sheets:
            return
        while (wrong := self._complaint_after_reading_sheet(request.pattern)) is not None:
            if sys.stdin is None or not sys.stdin.isatty():  # input from a file cannot correct a sheet
                print_warning(f"{wrong}; is the right sheet there, the right way round?")
                break
            said = self._answer(f"{wrong}. Correct it and press Enter, or type go to continue anyway:  ")
            if said.lower() == "go":
                break

    def _hint_for_emulator_terminal(self, request: RequestToPerson) -> str:
        """Return a hint on what to type in the emulator's terminal to carry out the request; "" without an emulator."""
        if not self._emulated:
            return ""
        if request.turned_rad is not None:
            return f" (in the emulator's terminal: turn {np.degrees(request.turned_rad):g})"
        if request.pattern is None:
            return ""
        try:
            scene = scene_text(shifted_pattern(self._plan.patterns[request.pattern], self._origin))
        except ParameterError:
            return " (the emulator's terminal knows no such pattern; --arm emulator lays it by itself)"
        return f" (in the emulator's terminal: {scene})"

    def _complaint_after_reading_sheet(self, name: str) -> str | None:
        """Read over a sheet's white and over its black; return a complaint if a reading is wrong, else None."""
        bounds, origin = reachable_places_of(self._arm), np.array(self._origin)
        values = {}
        for is_white, place in self._sheet_check.white_and_black_places(
            name, lambda places: bounds.contains(places + origin)
        ).items():
            x_mm, y_mm = (np.array(place) + origin).tolist()
            standing = float(self._arm.orientation_rad(np.array([[x_mm, y_mm]]))[0])
            values[is_white] = self._arm.measure(Pose(x_mm, y_mm, standing)).value
        return self._sheet_check.complaint_about_levels(name, values)


def is_pty(port: str) -> bool:
    """Return whether a port is a pseudo-terminal, and hence an emulator."""
    return os.path.realpath(port).startswith(("/dev/pts/", "/dev/ttys"))
