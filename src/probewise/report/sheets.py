"""Sheets to print and lay under the arm: their content, and the pages into which large ones are split."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.arm import Geometry
from probewise.arm.fitting import spread_mark_places
from probewise.effects.reference import orientation_deg
from probewise.errors import ParameterError, require
from probewise.recordings import Disc, HalfPlane, Image, Pattern, Plan, Polygon, Quadrant, Ramp, Stripes, Uniform
from probewise.recordings.patterns import where_white_in_words

PAPERS_MM: Mapping[str, tuple[float, float]] = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}
"""Width and height of the papers, upright."""

LEFT_MM, RIGHT_MM, TOP_MM, BOTTOM_MM = 16.0, 12.0, 10.5, 20.0
"""Margins of a page: printers leave some 6 mm blank; the rest holds text."""

OVERLAP_MM = 6.0
"""Width of the strip printed beyond the cut, on which the next page is glued."""
CROSS_MM = 15.0  # half of a cross: long enough to show beyond a block of two LEGO studs

AROUND_MM = 40.0  # margin beyond the outermost reading, which the sensor still sees
PATTERN_FRAME = "the pattern's origin"
_MOST_PAGES = 400
_FINEST_MM = 0.1  # period of stripes of two dots, of a printer with 600 in an inch
_ROUND_MM = 5.0
_JIG_MM = 20.0


@dataclass(frozen=True, eq=False)
class Sheet:
    """A rectangle to be printed at true scale: a pattern in its own frame, or a part of the field; lengths in mm."""

    name: str  # of the pattern, as prompts call it
    pattern: Pattern  # albedo 0 is black, 1 white
    low_mm: tuple[float, float]  # lower left corner, in the pattern's frame
    high_mm: tuple[float, float]  # upper right corner
    lines: tuple[str, ...] = ()  # instructions for the user
    outline_mm: FloatArray | None = None  # line to cut along, (n, 2)
    crosses_mm: FloatArray | None = None  # to bring the sensor or a joint to, (n, 2)
    cross_names: tuple[str, ...] = ()  # text beside each cross; empty: its number and place
    strokes_mm: tuple[FloatArray, ...] = ()  # further lines, (n, 2) each
    frame: str = PATTERN_FRAME  # origin of x and y, in words
    orientations_rad: tuple[float, ...] = ()  # of the sensor over the sheet

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height, in mm."""
        return self.high_mm[0] - self.low_mm[0], self.high_mm[1] - self.low_mm[1]


@dataclass(frozen=True)
class Tile:
    """The part of a sheet on one page."""

    column: int  # from 0 at the left
    row: int  # from 0 at the bottom
    low_mm: tuple[float, float]  # corners in the sheet's frame, where the page is cut
    high_mm: tuple[float, float]
    page_mm: tuple[float, float]
    beyond_mm: tuple[float, float]  # strips beyond the cut, on the right and at the top, for gluing the neighbours

    def on_page_mm(self, points_mm: FloatArray) -> FloatArray:
        """Convert points, (n, 2), from the sheet's frame to the page's, whose origin is its lower left corner."""
        return np.asarray(points_mm - np.array(self.low_mm) + [LEFT_MM, BOTTOM_MM])


def tiles_of(sheet: Sheet, paper: str) -> tuple[Tile, ...]:
    """Split a sheet into pages, portrait or landscape, whichever needs fewer; `paper` is "a4" or "letter".

    Return the tiles row by row from below, each row from the left. ParameterError if it needs more than 400 pages, has
    stripes finer than a printer's dots, or the paper is unknown.
    """
    require(paper in PAPERS_MM, "paper", paper, " or ".join(PAPERS_MM))
    if isinstance(sheet.pattern, Stripes):
        period_mm, allowed = sheet.pattern.period_mm, f"{_FINEST_MM} or more, which a printer can draw"
        require(period_mm >= _FINEST_MM, f"period_mm of {sheet.name}", period_mm, allowed)
    ways = []
    for page in (PAPERS_MM[paper], PAPERS_MM[paper][::-1]):
        rooms_mm = page[0] - LEFT_MM - RIGHT_MM, page[1] - BOTTOM_MM - TOP_MM
        counts = [
            1 if length_mm <= room_mm else math.ceil(length_mm / (room_mm - OVERLAP_MM))
            for length_mm, room_mm in zip(sheet.size_mm, rooms_mm, strict=True)
        ]
        ways.append((counts, page))
    (n_columns, n_rows), page = min(ways, key=lambda way: way[0][0] * way[0][1])
    if n_columns * n_rows > _MOST_PAGES:
        found = f"{sheet.size_mm[0]:g} x {sheet.size_mm[1]:g} mm, {n_columns * n_rows} pages"
        raise ParameterError(sheet.name, found, f"a sheet of {_MOST_PAGES} pages at most")
    x_mm = np.linspace(sheet.low_mm[0], sheet.high_mm[0], n_columns + 1).tolist()
    y_mm = np.linspace(sheet.low_mm[1], sheet.high_mm[1], n_rows + 1).tolist()
    tiles = []
    for row, column in itertools.product(range(n_rows), range(n_columns)):
        low, high = (x_mm[column], y_mm[row]), (x_mm[column + 1], y_mm[row + 1])
        beyond = (OVERLAP_MM * (column < n_columns - 1), OVERLAP_MM * (row < n_rows - 1))
        tiles.append(Tile(column, row, low, high, page, beyond))
    return tuple(tiles)


def lines_of_crosses(sheet: Sheet) -> FloatArray:
    """Return both lines of each cross, (2 n, 2 ends, 2)."""
    arms = CROSS_MM * np.array([[[-1.0, 0.0], [1.0, 0.0]], [[0.0, -1.0], [0.0, 1.0]]])
    marks = np.empty((0, 2)) if sheet.crosses_mm is None else np.asarray(sheet.crosses_mm)
    return (marks[:, None, None, :] + arms).reshape(-1, 2, 2)


def pattern_sheets(patterns: Mapping[str, Pattern], plan: Plan | None = None) -> tuple[Sheet, ...]:
    """Make one sheet per pattern used, 40 mm or more beyond the plan's readings; without a plan, of its own extent."""
    sheets = []
    for name, pattern in patterns.items():
        places, turns = np.concatenate([np.zeros((1, 2)), _points_sheet_must_show(pattern)]), ()
        if plan is not None:
            used = [index for index, own in enumerate(plan.pattern_names) if own == name]
            rows = np.flatnonzero(np.isin(plan.pattern, used))
            if not rows.size:
                continue
            places = np.stack([plan.x_mm[rows], plan.y_mm[rows]], axis=-1)
            turns = tuple(dict.fromkeys(np.radians(orientation_deg(plan)[rows]).tolist()))
        lines = (where_white_in_words(pattern),)
        sheets.append(Sheet(name, pattern, *_sheet_corners_around(places, AROUND_MM), lines, orientations_rad=turns))
    return tuple(sheets)


def field_sheet(field_mm: tuple[float, float], outline_mm: FloatArray | None) -> Sheet:
    """Make the sheet of the field: black, with the target white inside its closed outline, (n, 2); None: all black."""
    pattern: Pattern = Uniform(0.0)
    if outline_mm is not None:
        pattern = Polygon(tuple((x, y) for x, y in outline_mm[:-1].tolist()))
    said = "all black" if outline_mm is None else "black, the target white at its place"
    return Sheet("field", pattern, (0.0, 0.0), field_mm, (said,), frame="the field's lower left corner")


def target_sheet(name: str, outline_mm: FloatArray) -> Sheet:
    """Make the sheet of a white target of the given closed outline, (n, 2), to cut out and lay on a black field."""
    lines, frame = ("white: cut it out along the line and lay it on the black field",), "the field's lower left corner"
    corners = _sheet_corners_around(outline_mm, _ROUND_MM)
    return Sheet(name, Uniform(1.0), *corners, lines, outline_mm=outline_mm, frame=frame)


def marks_sheet(geometry: Geometry) -> Sheet:
    """Make the sheet, as large as the field, of numbered crosses at which `arm fit-geometry` measures the arm."""
    marks = spread_mark_places(geometry)
    lines = (
        f"{len(marks)} crosses for `probewise arm fit-geometry`, numbered",
        "its lower left corner is the field's; its long sides run along the field's x axis; the base turns about "
        f"x = {geometry.axis_mm[0]:g}, y = {geometry.axis_mm[1]:g}",
    )
    frame = "the field's lower left corner"
    return Sheet("marks", Uniform(1.0), (0.0, 0.0), geometry.field_mm, lines, crosses_mm=marks, frame=frame)


def arm_home_jig_sheet(geometry: Geometry) -> Sheet:
    """Make the sheet of an arm's links at their home angles, from the side: places from the base's axis and height."""
    base, shoulder, elbow = (joint.home_rad for joint in geometry.joints)
    joints = np.array(geometry.joints_from_side_mm(shoulder, elbow))
    low, high = _sheet_corners_around(np.concatenate([joints, np.zeros((1, 2))]), _JIG_MM)
    if joints[:, 1].min() >= 0:
        low = low[0], 0.0  # cut there, the sheet stands on the table
    lines = (
        "the links at home, from the side, outwards to the right",
        "glue it on card, cut it at y = 0, stand it on the table beside the",
        "links, the base's axis at x = 0; bring the joints' axles to the crosses;",
        "pages without a cross carry the others",
        f"the base is at {math.degrees(base):.4g} degrees from the field's x axis (-90: straight over the field)",
    )
    axis, table = [[0.0, max(low[1], 0.0)], [0.0, high[1]]], [[low[0], 0.0], [high[0], 0.0]]
    return Sheet(
        "jig",
        Uniform(1.0),
        low,
        high,
        lines,
        crosses_mm=joints,
        cross_names=("shoulder", "elbow", "wrist", f"sensor's face, {joints[-1, 1]:.1f} mm up"),
        strokes_mm=(joints[:-1], np.array(axis), np.array(table)),
        frame="where the base's axis meets the table; y is the height",
    )


def _sheet_corners_around(points_mm: FloatArray, margin_mm: float) -> tuple[tuple[float, float], tuple[float, float]]:
    low = np.floor((points_mm.min(axis=0) - margin_mm) / _ROUND_MM) * _ROUND_MM
    high = np.ceil((points_mm.max(axis=0) + margin_mm) / _ROUND_MM) * _ROUND_MM
    (x_low, y_low), (x_high, y_high) = low.tolist(), high.tolist()
    return (x_low, y_low), (x_high, y_high)


def _points_sheet_must_show(pattern: Pattern) -> FloatArray:
    """Return places, (n, 2), in mm that a pattern's sheet must show when there is no plan."""
    match pattern:
        case Disc((x, y), radius):
            return np.array([[x - radius, y - radius], [x + radius, y + radius]])
        case Polygon(vertices):
            return np.array(vertices)
        case Quadrant((x, y)):
            return np.array([[x, y]])
        case HalfPlane(normal, offset):
            return offset * np.array([[math.cos(normal), math.sin(normal)]])
        case Stripes(_, period):
            return np.array([[-1.5 * period] * 2, [1.5 * period] * 2])
        case Image(albedo, pixel, (x, y)):
            return np.array([[x, y], [x + albedo.shape[1] * pixel, y + albedo.shape[0] * pixel]])
        case Ramp() | Uniform():
            return np.array([[-AROUND_MM, 0.0], [AROUND_MM, 0.0]])
