"""Fit a geometry to marks that a person brings the sensor to."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from probewise.cli._arm import parse_arm, prompter, prompter_for_answer
from probewise.cli._arm_tasks.opening import open_instrument
from probewise.cli._common import CommandError, message_to_resume, print_result
from probewise.cli._output import checked_output_file
from probewise.cli._stopping import reporting_what_is_kept
from probewise.errors import FileError, ParameterError

if TYPE_CHECKING:
    from probewise.arm import Geometry

MARKS = "marks"


def fit_geometry_to_marks(arguments: argparse.Namespace, geometry: Geometry) -> None:
    from probewise.arm import shipped_geometry_path
    from probewise.arm.fitting import fit_geometry
    from probewise.arm.geometry_file import read_geometry, text_with_fitted_values
    from probewise.arm.mark_file import read_turns_and_places
    from probewise.recordings import write_text_atomically
    from probewise.recordings.atomic import is_device_or_pipe

    source = arguments.geometry or shipped_geometry_path()
    out = checked_output_file(arguments.out, *([] if arguments.geometry is None else [arguments.geometry]))
    if arguments.dry_run:
        raise ParameterError("--dry-run", True, "none with fit-geometry: a person directs its moves")
    if arguments.arm is None and arguments.marks is None:
        raise CommandError(
            "--arm is missing: name the brick, such as --arm nxt:/dev/rfcomm0; or fit existing marks, --marks MARKS.csv"
        )
    if arguments.marks is None and is_device_or_pipe(out):
        raise ParameterError("--out", str(out), "a file, beside which the marks are kept; or name them with --marks")
    kept = out.with_suffix(".marks.csv") if arguments.marks is None else arguments.marks
    if arguments.arm is not None:
        _touch_and_save_marks(arguments, geometry, checked_output_file(kept))
    turned, marks = read_turns_and_places(kept)
    fitted = fit_geometry(geometry, turned, marks, touch_mm=arguments.touch_mm)
    print_result(fitted.summary(), quiet=arguments.quiet)
    text = text_with_fitted_values(source.read_text(encoding="utf-8-sig"), fitted.geometry)
    write_text_atomically(out, text)
    if not is_device_or_pipe(out):
        read_geometry(out)  # check that edits by hand have not hidden a number
    print_result(f"written      {out}; give it as --geometry from now on", quiet=arguments.quiet)


def _touch_and_save_marks(arguments: argparse.Namespace, geometry: Geometry, kept: Path) -> None:
    """Bring the sensor to one mark after another as a person directs; save each at once to the file `kept`."""
    from probewise.arm import LegoArm
    from probewise.arm.mark_file import TouchedMark, read_turns_and_places, write_marks
    from probewise.arm.marks import spread_mark_places
    from probewise.cli._marks import bring_to_mark

    chosen = parse_arm(arguments.arm)
    if not chosen.is_lego:
        raise ParameterError("--arm", arguments.arm, "nxt:PORT or emulator:TRUE.toml: the arm whose geometry is fitted")
    if kept.exists() and not arguments.resume:
        raise FileError(kept, "the file exists already", "--resume to continue it, or another --marks")
    taken: list[TouchedMark] = []
    if kept.exists():
        rows = zip(*(array.tolist() for array in read_turns_and_places(kept)), strict=True)
        taken = [TouchedMark(tuple(turned), tuple(place)) for turned, place in rows]
    done = {mark.place_mm[:2] for mark in taken}
    marks = [(x, y) for x, y in spread_mark_places(geometry).tolist()]
    arguments.scene = arguments.sensor = arguments.seed = None
    instrument, bench = open_instrument(arguments, geometry)
    assert isinstance(instrument, LegoArm)

    def kept_message() -> str:
        return (
            message_to_resume(kept, len(taken), "mark", arguments, "--resume") if kept.exists() else "no mark was kept"
        )

    with reporting_what_is_kept(kept_message), instrument as arm:
        answer = prompter_for_answer(arm)
        ask = answer if bench is None else bench.answer_at_mark
        tell = partial(print_result, quiet=bench is not None)
        if bench is None:
            prompter(arm)(
                f"lay the sheet of marks (probewise sheets {MARKS}) on the field, and on each cross in its turn a "
                f"block {arguments.block_mm:g} mm high"
            )
        for number, mark in enumerate(marks, 1):
            if mark in done:
                continue
            met = bring_to_mark(arm, mark, arguments.block_mm, ask, tell, named=f"mark {number} of {len(marks)}")
            if met is not None:
                taken.append(met)
                write_marks(taken, kept)
                print_result(f"mark {number} kept: {kept}", quiet=arguments.quiet)
