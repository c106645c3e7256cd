"""Bring the sensor to marks on the field, guided by a person who watches it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from probewise.errors import ReachError

if TYPE_CHECKING:
    from probewise.arm import LegoArm
    from probewise.arm.mark_file import TouchedMark

STEP_MM = 5.0
_MOST_MM = 60.0  # largest step
_HELP = (
    "Enter: 5 mm down; 'down 2', 'up 2', 'x 4', 'y -2.5' or several of them: mm; 'ok': it is over the cross and just "
    "touches; 'seen': it is over the cross, its height is not known; 'skip'"
)


class MarkQuestion(str):
    """A question about a mark to the person who watches the sensor: the sentence, with the mark's place.

    Attributes
    ----------
    mark_mm
        Place of the mark.
    block_mm
        Height of the block on it.
    """

    __slots__ = ("block_mm", "mark_mm")

    mark_mm: tuple[float, float]
    block_mm: float

    def __new__(cls, text: str, mark_mm: tuple[float, float], block_mm: float) -> MarkQuestion:
        """Build a question from its sentence."""
        question = super().__new__(cls, text)
        question.mark_mm, question.block_mm = mark_mm, block_mm
        return question


def bring_to_mark(
    arm: LegoArm,
    mark_mm: tuple[float, float],
    block_mm: float,
    ask: Callable[[MarkQuestion], str],
    tell: Callable[[str], None],
    *,
    named: str,
) -> TouchedMark | None:
    """Bring the sensor over a mark and down to the block on it, as a person directs; return the mark as touched.

    That is the joints' turns from home (radians), and the mark's x, y and height in mm, NaN if the answer is "seen".
    None if the mark is skipped. Every move turns the base first and then lowers, as in a reading.

    Parameters
    ----------
    arm
        The arm, entered.
    mark_mm, block_mm
        Place of the mark on the field, and height of the block.
    ask
        Function that asks the person and returns "ok", "seen", "skip", or a move such as "x 5".
    tell
        Function that tells the person what can be answered, and why a move was refused.
    named
        Name of the mark.
    """
    from probewise.arm.mark_file import TouchedMark

    at = (*mark_mm, arm.geometry.travel_height_mm)
    arm.go_down(*at)
    tell(_HELP)
    while True:
        answer = ask(MarkQuestion(f"{named} ({mark_mm[0]:g}, {mark_mm[1]:g}): ", mark_mm, block_mm)).lower()
        if answer == "skip":
            return None
        if answer in ("ok", "seen"):
            homes = np.array([joint.home_rad for joint in arm.geometry.joints])
            base, shoulder, elbow = (arm.angles_rad - homes).tolist()
            height_mm = block_mm if answer == "ok" else math.nan
            return TouchedMark((base, shoulder, elbow), (*mark_mm, height_mm))
        moved = _place_after_moves(at, answer)
        if moved is None:
            tell(f"{answer!r} says nothing that can be done. {_HELP}")
            continue
        try:
            arm.go_down(*moved)
        except ReachError as error:
            tell(str(error))
            arm.go_down(*at)
        else:
            at = moved


def _place_after_moves(at_mm: tuple[float, float, float], answer: str) -> tuple[float, float, float] | None:
    """Return the sensor's place (x, y, height in mm) after the moves in an answer; None if it is no list of moves.

    An answer is pairs such as "x 5 down 2", of at most 60 mm each; an empty one means one step of 5 mm down.
    """
    words = answer.split() or ["down", str(STEP_MM)]
    x, y, height = at_mm
    if len(words) % 2:
        return None
    for way, text in zip(words[::2], words[1::2], strict=True):
        try:
            by = float(text)
        except ValueError:
            return None
        if not abs(by) <= _MOST_MM:
            return None
        match way:
            case "x":
                x += by
            case "y":
                y += by
            case "up":
                height += by
            case "down":
                height -= by
            case _:
                return None
    return x, y, height
