"""`probewise arm fit-geometry`: a person brings the sensor to marks, and the geometry is fitted to them."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from probewise._signals import reporting_what_is_kept
from probewise._writing import checked_output_file, is_device_or_pipe
from probewise.arm import Geometry, LegoArm, read_geometry, shipped_geometry_path
from probewise.arm.fitting import fit_geometry, read_turns_and_places, spread_mark_places, write_marks
from probewise.arm.geometry_file import text_with_fitted_values
from probewise.cli._bench import parse_arm, prompter, prompter_for_answer
from probewise.cli._common import CommandError, message_to_resume, print_result, say
from probewise.cli.arm import open_instrument
from probewise.errors import FileError, ParameterError, ReachError, require
from probewise.recordings import write_text_atomically

STEP_MM = 5.0
_MOST_MM = 60.0  # largest step
_HELP = (
    "Enter: 5 mm down; 'down 2', 'up 2', 'x 4', 'y -2.5' or several of them: mm; 'ok': it is over the cross and just "
    "touches; 'seen': it is over the cross, its height is not known; 'skip'"
)
_MOVES = {"x": (1, 0, 0), "y": (0, 1, 0), "up": (0, 0, 1), "down": (0, 0, -1)}


def fit_geometry_to_marks(arguments: argparse.Namespace, geometry: Geometry) -> None:
    """Bring the sensor to marks, unless there is no --arm; fit the geometry to them, and write it."""
    source = arguments.geometry or shipped_geometry_path()
    out = checked_output_file(arguments.out, arguments.geometry)
    require(not arguments.dry_run, "--dry-run", True, "none with fit-geometry: a person directs its moves")
    if arguments.arm is None and arguments.marks is None:
        raise CommandError(
            "--arm is missing: name the brick, such as --arm nxt:/dev/rfcomm0; or fit existing marks, --marks MARKS.csv"
        )
    if arguments.marks is None and is_device_or_pipe(out):
        raise ParameterError("--out", str(out), "a file, beside which the marks are kept; or name them with --marks")
    kept = out.with_suffix(".marks.csv") if arguments.marks is None else arguments.marks
    if arguments.arm is not None:
        _touch_and_save_marks(arguments, geometry, checked_output_file(kept, arguments.geometry, option="--marks"))
    turned, marks = read_turns_and_places(kept)
    fitted = fit_geometry(geometry, turned, marks, touch_mm=arguments.touch_mm)
    say(arguments, fitted.summary())
    write_text_atomically(out, text_with_fitted_values(source.read_text(encoding="utf-8-sig"), fitted.geometry))
    if not is_device_or_pipe(out):
        read_geometry(out)  # check that edits by hand have not hidden a number
    say(arguments, f"written      {out}; give it as --geometry from now on")


def _touch_and_save_marks(arguments: argparse.Namespace, geometry: Geometry, kept: Path) -> None:
    """Bring the sensor to one mark after another as a person directs; save each at once to the file `kept`."""
    if not parse_arm(arguments.arm).is_lego:
        raise ParameterError("--arm", arguments.arm, "nxt:PORT or emulator:TRUE.toml: the arm whose geometry is fitted")
    if kept.exists() and not arguments.resume:
        raise FileError(kept, "the file exists already", "--resume to continue it, or another --marks")
    taken = np.concatenate(read_turns_and_places(kept), axis=1).tolist() if kept.exists() else []
    done = {(x, y) for *_, x, y, _ in taken}
    marks = [(x, y) for x, y in spread_mark_places(geometry).tolist()]
    instrument, bench = open_instrument(arguments, geometry, watched=True)
    assert isinstance(instrument, LegoArm)

    def kept_message() -> str:
        resume = partial(message_to_resume, kept, len(taken), "mark", arguments, "--resume")
        return resume() if kept.exists() else "no mark was kept"

    with reporting_what_is_kept(kept_message), instrument as arm:
        answer, tell = prompter_for_answer(arm), print_result if bench is None else lambda text: None
        if bench is None:
            prompter(arm)(
                "lay the sheet of marks (probewise sheets marks) on the field, and on each cross in its turn a "
                f"block {arguments.block_mm:g} mm high"
            )
        for number, mark in enumerate(marks, 1):
            if mark in done:
                continue
            ask = partial(answer, f"mark {number} of {len(marks)} ({mark[0]:g}, {mark[1]:g}): ")
            if bench is not None:
                ask = partial(bench.answer_at_mark, mark, arguments.block_mm)
            met = bring_to_mark(arm, mark, arguments.block_mm, ask, tell)
            if met is not None:
                taken.append(met)
                write_marks(taken, kept)
                say(arguments, f"mark {number} kept: {kept}")


def bring_to_mark(
    arm: LegoArm, mark_mm: tuple[float, float], block_mm: float, ask: Callable[[], str], tell: Callable[[str], None]
) -> list[float] | None:
    """Bring the sensor over a mark and down to the block on it, as a person directs.

    Return the joints' angles from home (rad), x, y and height of the mark (mm; NaN: not known), None if it is skipped.

    Every move turns the base first and then lowers, as in a reading. `ask` returns the person's answer, "ok", "seen",
    "skip" or a move such as "x 5"; `tell` says what can be answered, and why a move was refused.
    """
    at = (*mark_mm, arm.geometry.travel_height_mm)
    arm.go_down(*at)
    tell(_HELP)
    while True:
        answer = ask().lower()
        if answer == "skip":
            return None
        if answer in ("ok", "seen"):
            homes = np.array([joint.home_rad for joint in arm.geometry.joints])
            return [*(arm.angles_rad - homes).tolist(), *mark_mm, block_mm if answer == "ok" else math.nan]
        moved = place_after_moves(at, answer)
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


def place_after_moves(at_mm: tuple[float, float, float], answer: str) -> tuple[float, float, float] | None:
    """Return the place (x, y, height in mm) after an answer's moves, such as "x 5 down 2"; None if it is none."""
    words = answer.split() or ["down", str(STEP_MM)]
    x, y, height = at_mm
    if len(words) % 2:
        return None
    for way, text in zip(words[::2], words[1::2], strict=True):
        try:
            by_x, by_y, by_height = (float(text) * share for share in _MOVES[way])
        except (KeyError, ValueError):
            return None
        if not abs(float(text)) <= _MOST_MM:
            return None
        x, y, height = x + by_x, y + by_y, height + by_height
    return x, y, height
