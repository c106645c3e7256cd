"""`probewise sheets`: print the patterns for a bench at true scale."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from probewise._writing import checked_output_file
from probewise.cli._arm import add_geometry, read_or_shipped_geometry, read_or_shipped_plan
from probewise.cli._common import (
    CommandError,
    add,
    add_quiet,
    note_if_replaced,
    parse_path,
    print_result,
    refuse_options,
)
from probewise.errors import ParameterError, require

if TYPE_CHECKING:
    from probewise._arrays import FloatArray
    from probewise.report.sheets import Sheet

FIELD, TARGET, MARKS, JIG = "field", "target", "marks", "jig"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise sheets`."""
    add(
        parser,
        "what WHAT",
        "paper or two_way, the plans that ship; PLAN.csv, its JSON beside it, or such a JSON alone; field, the "
        "black field; target, a white shape to cut out; marks, the crosses of `arm fit-geometry`; jig, the "
        "arm's links and base at their home angles, for `arm home --here`",
    )
    add(parser, "--out SHEETS.pdf", "where the pages go", type=parse_path, required=True)
    add(parser, "--paper PAPER", "a4 (default) or letter", type=str.lower, default="a4")
    about = "of field and target: a white shape as --truth of explore takes it, a circle as X,Y,R in mm of the field"
    add(parser, "--target [SHAPE:]V,V,...", about)
    add_geometry(parser)
    add_quiet(parser)


def run(arguments: argparse.Namespace) -> int:
    """Draw the sheets asked for, write them as a PDF, and print the size of each; return the exit status."""
    from probewise.recordings import write_bytes_atomically
    from probewise.report.plots.sheets import sheets_pdf
    from probewise.report.sheets import PAPERS_MM, tiles_of

    require(arguments.paper in PAPERS_MM, "--paper", arguments.paper, " or ".join(PAPERS_MM))
    named = Path(arguments.what)
    out = checked_output_file(arguments.out, *([named] if named.is_file() else []))
    sheets = _sheets_to_draw(arguments)
    drawn = sheets_pdf(sheets, paper=arguments.paper, title=f"probewise sheets: {named.name}")
    earlier = note_if_replaced(out)
    write_bytes_atomically(out, drawn)
    for sheet in sheets:
        n = len(tiles_of(sheet, arguments.paper))
        width, height = sheet.size_mm
        pages = f"{n} page{'s' if n > 1 else ''}"
        print_result(f"{sheet.name:<12} {width:g} x {height:g} mm, {pages}: {sheet.lines[0]}", quiet=arguments.quiet)
    for note in earlier:
        print_result(note, quiet=arguments.quiet)
    print_result(f"print at 100 % on {arguments.paper}, and measure the ruler: {out}", quiet=arguments.quiet)
    return 0


def _sheets_to_draw(arguments: argparse.Namespace) -> tuple[Sheet, ...]:
    from probewise.recordings.files import read_description
    from probewise.report.sheets import arm_home_jig_sheets, field_sheet, marks_sheet, pattern_sheets, target_sheet

    what = arguments.what
    if what not in (FIELD, TARGET):
        refuse_options(arguments, f"{what}: it is for {FIELD} and {TARGET}", "target")
    if what == MARKS:
        return (marks_sheet(read_or_shipped_geometry(arguments)),)
    if what == JIG:
        return arm_home_jig_sheets(read_or_shipped_geometry(arguments))
    if what in (FIELD, TARGET):
        field_mm = read_or_shipped_geometry(arguments).field_mm
        if arguments.target is None and what == TARGET:
            raise CommandError("--target is missing: give a shape, such as --target circle:524,260,80")
        outline = None if arguments.target is None else _target_outline_mm(arguments.target, field_mm)
        if what == FIELD:
            return (field_sheet(field_mm, outline),)
        assert outline is not None
        return (target_sheet(arguments.target, outline),)
    refuse_options(arguments, f"a plan: it is for {FIELD}, {MARKS} and {JIG}", "geometry")
    path = Path(what)
    if path.suffix.lower() == ".json":
        beside = path.with_suffix(".csv")
        if not beside.exists():
            _, patterns, _ = read_description(path)
            return pattern_sheets(patterns)
        what = str(beside)
    plan = read_or_shipped_plan(what)
    return pattern_sheets(plan.patterns, plan)


def _target_outline_mm(text: str, field_mm: tuple[float, float]) -> FloatArray:
    """Return the outline of --target, (n, 2); ParameterError if it is no shape, or is not wholly on the field."""
    import numpy as np

    from probewise.cli._explore import parse_truth
    from probewise.scene import Field, outlines

    try:
        hidden = parse_truth(text, ("circle",), Field(*field_mm), rng=np.random.default_rng(0))
    except ParameterError as error:
        raise ParameterError(error.name.replace("--truth", "--target"), error.value, error.allowed) from error
    outline = outlines(hidden.shape.region(hidden.theta[None, :]), n_vertices=720)[0]
    if (outline < 0).any() or (outline > field_mm).any():
        raise ParameterError("--target", text, f"a shape that lies on the field, {field_mm[0]:g} x {field_mm[1]:g} mm")
    return outline
