"""`probewise sheets`: print the patterns for a bench at true scale."""

import argparse
from pathlib import Path

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import count_with_noun
from probewise._writing import checked_output_file
from probewise.cli._common import CommandError, note_if_replaced, say
from probewise.cli._inputs import read_or_shipped_geometry, read_or_shipped_plan, tables_and_descriptions
from probewise.cli._options import refuse_options
from probewise.errors import require
from probewise.recordings import write_bytes_atomically
from probewise.recordings.files import read_description
from probewise.report import sheets
from probewise.report.plots.sheets import sheets_pdf
from probewise.scene import Field, outlines

FIELD, TARGET, MARKS, JIG = "field", "target", "marks", "jig"


def run(arguments: argparse.Namespace) -> int:
    """Draw the sheets asked for, write them as a PDF, and print the size of each; return the exit status."""
    paper = arguments.paper
    require(paper in sheets.PAPERS_MM, "--paper", paper, " or ".join(sheets.PAPERS_MM))
    named = Path(arguments.what)
    read = tables_and_descriptions([named, named.with_suffix(".csv")] if named.is_file() else [])
    out = checked_output_file(arguments.out, arguments.geometry, *read)
    to_draw = _sheets_to_draw(arguments)
    drawn = sheets_pdf(to_draw, paper=paper, title=f"probewise sheets: {named.name}")
    earlier = note_if_replaced(out)
    write_bytes_atomically(out, drawn)
    for sheet in to_draw:
        pages, (width, height) = count_with_noun(len(sheets.tiles_of(sheet, paper)), "page"), sheet.size_mm
        say(arguments, f"{sheet.name:<12} {width:g} x {height:g} mm, {pages}: {sheet.lines[0]}")
    say(arguments, *earlier, f"print at 100 % on {paper}, and measure the ruler: {out}")
    return 0


def _sheets_to_draw(arguments: argparse.Namespace) -> tuple[sheets.Sheet, ...]:
    what, target = arguments.what, arguments.target
    if what not in (FIELD, TARGET):
        refuse_options(arguments, f"{what}: it is for {FIELD} and {TARGET}", "target")
    if what in (FIELD, TARGET, MARKS, JIG):
        geometry = read_or_shipped_geometry(arguments)
        if what == MARKS:
            return (sheets.marks_sheet(geometry),)
        if what == JIG:
            return (sheets.arm_home_jig_sheet(geometry),)
        outline = None if target is None else _target_outline_mm(target, geometry.field_mm)
        if what == FIELD:
            return (sheets.field_sheet(geometry.field_mm, outline),)
        if outline is None:
            raise CommandError("--target is missing: give a shape, such as --target circle:524,260,80")
        return (sheets.target_sheet(target, outline),)
    refuse_options(arguments, f"a plan: it is for {FIELD}, {MARKS} and {JIG}", "geometry")
    path = Path(what)
    if path.suffix.lower() == ".json":
        beside = path.with_suffix(".csv")
        if not beside.exists():
            _, patterns, _ = read_description(path)
            return sheets.pattern_sheets(patterns)
        what = str(beside)
    plan = read_or_shipped_plan(what)
    return sheets.pattern_sheets(plan.patterns, plan)


def _target_outline_mm(text: str, field_mm: tuple[float, float]) -> FloatArray:
    """Return the outline of --target, (n, 2); ParameterError if it is no shape, or is not wholly on the field."""
    from probewise.cli.explore import parse_truth

    hidden = parse_truth(text, ("circle",), Field(*field_mm), rng=np.random.default_rng(0), option="--target")
    outline = outlines(hidden.shape.region(hidden.theta[None, :]), n_vertices=720)[0]
    allowed = f"a shape that lies on the field, {field_mm[0]:g} x {field_mm[1]:g} mm"
    require(((outline >= 0) & (outline <= field_mm)).all(), "--target", text, allowed)
    return outline
