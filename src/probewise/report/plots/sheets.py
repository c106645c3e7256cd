"""Printable sheets as a PDF at true scale: one drawing unit is one millimetre on paper."""

from __future__ import annotations

import io
import itertools
import textwrap
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import Polygon as Outline
from matplotlib.patches import Rectangle

from probewise._arrays import FloatArray
from probewise.recordings.patterns import Disc, HalfPlane, Pattern, Polygon, Quadrant, Stripes, Uniform
from probewise.report.plots.canvas import BLACK, VERMILLION, draw_map, text_as_it_is
from probewise.report.sheets import (
    BOTTOM_MM,
    LEFT_MM,
    OVERLAP_MM,
    PAPERS_MM,
    PATTERN_FRAME,
    Sheet,
    Tile,
    lines_of_crosses,
    tiles_of,
)
from probewise.scene import region_of

_MM_PER_IN = 25.4
_RULER_MM = 100
_SHEETS_PER_COVER = 5
_PIXEL_MM = 0.25  # pixel size for patterns that have no outline
_ROUND = np.linspace(0.0, 2 * np.pi, 721)[:-1]
_SMALL, _USUAL, _LARGE = 7.5, 9.0, 14.0
_LETTER_MM, _COVER_LETTERS = 1.6, 90  # of small print; letters on a line of a cover
_APART_MM = 25.0  # from an origin, whose text would touch another

_PRINT = ("Print at 100 % (actual size; no 'fit to page'), on matt paper, and measure the ruler: it is 100 mm long.",)
_GLUE = (
    "A sheet of several pages: cut each page along the corner marks at its left and lower side, and glue it, mark",
    "on mark, on the strip that its neighbour prints beyond the marks. Each strip says which page lies there.",
)
_LAY = (
    "Ticks in the margins show x = 0 and y = 0. All is seen from above, x to the right, y up (away from you).",
    "Lay a sheet so that these ticks are where `arm record` says that the origin is, the sheet's x axis along",
    "the field's. At orientation 0 the sensor's x' axis is along x, the photodiode on the side of y; it turns",
    "anticlockwise.",
)
_PLACES = ("Numbers are mm from the origin that each sheet names, x to the right, y up.",)


def sheets_pdf(sheets: Sequence[Sheet], *, paper: str, title: str) -> bytes:
    """Draw cover pages with instructions, one per five sheets, then every sheet at true scale on "a4" or "letter".

    Return the PDF, reproducible byte for byte. ParameterError for more than 400 pages of a sheet, or another paper.
    """
    cut = [(sheet, tiles_of(sheet, paper)) for sheet in sheets]
    n_covers = -(-len(cut) // _SHEETS_PER_COVER)
    firsts = list(itertools.accumulate((len(tiles) for _, tiles in cut), initial=1 + n_covers))
    n_pages = firsts.pop() - 1
    listed = list(zip(cut, firsts, strict=True))
    buffer = io.BytesIO()
    about = {"Title": title, "Creator": "probewise", "Producer": None, "CreationDate": None}
    with mpl.rc_context({"path.simplify": False}), PdfPages(buffer, metadata=about) as pdf:

        def add(page: Figure) -> None:
            with text_as_it_is(page):
                pdf.savefig(page)

        for k in range(n_covers):
            batch = listed[k * _SHEETS_PER_COVER : (k + 1) * _SHEETS_PER_COVER]
            add(_draw_cover_page(batch, paper, title, f"page {k + 1} of {n_pages}"))
        for (sheet, tiles), first in listed:
            for k, tile in enumerate(tiles):
                add(_draw_page(sheet, tiles, tile, first, f"page {first + k} of {n_pages}"))
    return buffer.getvalue()


def _new_page_axes(page_mm: tuple[float, float]) -> Axes:
    """Return axes that fill a new page, with coordinates in mm from its lower left corner."""
    figure = Figure(figsize=(page_mm[0] / _MM_PER_IN, page_mm[1] / _MM_PER_IN), facecolor="none")
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set(xlim=(0.0, page_mm[0]), ylim=(0.0, page_mm[1]))
    ax.set_axis_off()
    return ax


def _draw_cover_page(batch: Sequence[Any], paper: str, title: str, number: str) -> Figure:
    page = PAPERS_MM[paper]
    ax = _new_page_axes(page)
    lines = [*_PRINT, *(_GLUE if any(len(tiles) > 1 for (_, tiles), _ in batch) else ())]
    lines += _LAY if any(sheet.frame == PATTERN_FRAME for (sheet, _), _ in batch) else _PLACES
    for (sheet, tiles), first in batch:
        (width, height), last = sheet.size_mm, first + len(tiles) - 1
        pages = f"page {first}"
        if last > first:
            columns, rows = (1 + max(getattr(tile, name) for tile in tiles) for name in ("column", "row"))
            pages = f"pages {first} to {last}, {columns} side by side, {rows} one above the other, from the lower left"
        said = [line for text in sheet.lines for line in textwrap.wrap(text, _COVER_LETTERS)]
        lines += ["", sheet.name, f"{width:g} x {height:g} mm; {pages}", *said, f"origin: {sheet.frame}"]
        if sheet.orientations_rad:
            turns = ", ".join(f"{np.degrees(turn):.4g}" for turn in sheet.orientations_rad)
            lines.append(f"the sensor stands at {turns} degrees")
    ax.text(LEFT_MM, page[1] - 18.0, title, fontsize=_LARGE)
    ax.text(LEFT_MM, page[1] - 26.0, "\n".join(lines), fontsize=_USUAL, va="top", linespacing=1.4)
    _draw_ruler(ax, 11.0)
    ax.text(page[0] - 12.0, 8.5, number, fontsize=_SMALL, ha="right")
    return ax.figure  # type: ignore[return-value]


def _draw_page(sheet: Sheet, tiles: Sequence[Tile], tile: Tile, first: int, number: str) -> Figure:
    ax = _new_page_axes(tile.page_mm)
    low, high, beyond = np.array(tile.low_mm), np.array(tile.high_mm), np.array(tile.beyond_mm)
    near = np.array([LEFT_MM, BOTTOM_MM])
    far = near + (high - low)
    clip = ax.add_patch(Rectangle((LEFT_MM, BOTTOM_MM), *(high - low + beyond), fc="none", ec="none"))
    _draw_sheet_part(ax, sheet, tuple(low), tuple(high + beyond), tile.on_page_mm, clip)

    def mark(axis: int, at: float, text: str, gap: float = 1.0, **style: Any) -> None:
        """Mark a place along x (axis 0) or y in both margins, and write a text beside the mark before the sheet."""
        begin, end, (before, after) = near[1 - axis], (far + beyond)[1 - axis], ((4.0, 4.0), (8.0, 5.0))[axis]
        for ends in ([begin - before, begin - gap], [end + gap, end + after]):
            places = ([at, at], ends) if axis == 0 else (ends, [at, at])
            ax.plot(*places, **{"color": BLACK, "lw": 0.4, "solid_capstyle": "butt", **style})
        x, y = (at, near[1] - 6.0) if axis == 0 else (near[0] - 10.0, at)
        ax.text(x, y, text, rotation=90 * axis, fontsize=_SMALL, va="center", ha="center")

    for axis, name in enumerate("xy"):
        for at, value in ((near[axis], low[axis]), (far[axis], high[axis])):
            mark(axis, at, f"{value:.4g} mm" if abs(value) > _APART_MM else "")  # else two texts would touch
        if low[axis] <= 0 <= high[axis]:
            mark(axis, near[axis] - low[axis], f"{name} = 0", gap=0.5, lw=1.2, color=VERMILLION)
    _draw_ruler(ax, 6.5)
    place = f", {number}, column {tile.column + 1}, row {tile.row + 1}" if len(tiles) > 1 else ""
    title = f"{sheet.name}{place}: {sheet.lines[0]}"
    ax.text(LEFT_MM + 3.0, tile.page_mm[1] - 6.0, title, fontsize=_USUAL, va="center")
    ax.text(tile.page_mm[0] - 10.0, 6.0, number, fontsize=_SMALL, ha="right", va="center")
    numbers = {(t.column, t.row): first + k for k, t in enumerate(tiles)}
    white = {"boxstyle": "square,pad=0.2", "fc": "white", "ec": "none"}  # legible on black
    for axis, there in enumerate(((tile.column + 1, tile.row), (tile.column, tile.row + 1))):
        if there in numbers:  # on the strip that the neighbour covers
            x, y = (near + 3 * far) / 4  # beside what is drawn in the middle
            x, y = (far[0] + OVERLAP_MM / 2, y) if axis == 0 else (x, far[1] + OVERLAP_MM / 2)
            style: dict[str, Any] = {"fontsize": _SMALL, "ha": "center", "va": "center", "bbox": white, "zorder": 5}
            ax.text(x, y, f"page {numbers[there]} lies here", rotation=90 * (1 - axis), **style)
    return ax.figure  # type: ignore[return-value]


def _draw_ruler(ax: Axes, y_mm: float) -> None:
    ax.plot([LEFT_MM, LEFT_MM + _RULER_MM], [y_mm, y_mm], color=BLACK, lw=0.5, solid_capstyle="butt", gid="ruler")
    for mm in range(0, _RULER_MM + 1, 5):
        length = 3.0 if mm % 50 == 0 else 2.0 if mm % 10 == 0 else 1.2
        ax.plot([LEFT_MM + mm] * 2, [y_mm, y_mm + length], color=BLACK, lw=0.4, solid_capstyle="butt")
    ax.text(LEFT_MM + _RULER_MM + 3.0, y_mm + 1.0, "100 mm", fontsize=_SMALL, va="center")


def _draw_sheet_part(ax: Axes, sheet: Sheet, low_mm: Any, high_mm: Any, place: Any, clip: Any) -> None:
    """Draw the part of a sheet between two corners: pattern, lines, crosses and texts.

    `place` maps points, (n, 2), from the sheet to the page; nothing is drawn beyond the patch `clip`.
    """
    for corners, albedo in _outlines_with_albedo(sheet.pattern, low_mm, high_mm):
        ink = str(round(float(np.clip(albedo, 0.0, 1.0)), 4))
        patch = ax.add_patch(Outline(place(corners), closed=True, fc=ink, ec="none", lw=0, zorder=1))
        patch.set_clip_path(clip)
    if not isinstance(sheet.pattern, Uniform | HalfPlane | Quadrant | Disc | Polygon | Stripes):
        _draw_raster(ax, sheet.pattern, low_mm, high_mm, place)
    outline = [] if sheet.outline_mm is None else [np.concatenate([sheet.outline_mm, sheet.outline_mm[:1]])]
    thin = [(line, 0.4) for line in (*outline, *lines_of_crosses(sheet))]
    for line, width in (*thin, *((line, 1.2) for line in sheet.strokes_mm)):
        (drawn,) = ax.plot(*place(line).T, color=BLACK, lw=width, solid_capstyle="butt", zorder=2)
        drawn.set_clip_path(clip)
    crosses = [] if sheet.crosses_mm is None else sheet.crosses_mm.tolist()
    names = sheet.cross_names or [f"{k}: ({x:g}, {y:g})" for k, (x, y) in enumerate(crosses, start=1)]
    for (x, y), words in zip((np.array(crosses) + 10.0).tolist(), names, strict=True):
        if (low_mm[0] <= x < high_mm[0]) and (low_mm[1] <= y < high_mm[1]):
            at_x, at_y = place(np.array([[x, y]]))[0].tolist()
            fits = at_x + _LETTER_MM * len(words) < place(np.array([high_mm]))[0, 0]
            at_x, ha = (at_x, "left") if fits else (at_x - 20.0, "right")  # on the other side of the cross
            written = ax.text(at_x, at_y, words, fontsize=_SMALL, zorder=2, ha=ha)
            written.set_clip_path(clip)


def _outlines_with_albedo(pattern: Pattern, low_mm: Any, high_mm: Any) -> list[tuple[FloatArray, float]]:
    """Return closed outlines (n, 2) with the albedo inside, in the order of painting; none for an image or a ramp."""
    (x0, y0), (x1, y1) = low_mm, high_mm
    whole = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    match pattern:
        case Uniform(albedo):
            return [(whole, albedo)]
        case HalfPlane(normal, offset, inside, outside):
            return [(whole, outside), (_clipped_to_half_plane(whole, normal, offset), inside)]
        case Quadrant((x, y), (dx, dy), inside, outside):
            across = _clipped_to_half_plane(whole, 0.0 if dx > 0 else np.pi, x * dx)
            return [(whole, outside), (_clipped_to_half_plane(across, dy * np.pi / 2, y * dy), inside)]
        case Disc(center, radius, inside, outside):
            circle = np.array(center) + radius * np.stack([np.cos(_ROUND), np.sin(_ROUND)], axis=-1)
            return [(whole, outside), (circle, inside)]
        case Polygon(vertices, inside, outside):
            return [(whole, outside), (np.array(vertices), inside)]
        case Stripes(normal, period, duty, phase, inside, outside):
            along = whole @ [np.cos(normal), np.sin(normal)] - phase
            first, last = int(np.floor(along.min() / period)), int(np.ceil(along.max() / period))
            painted = [(whole, outside)]
            for k in range(first, last + 1):
                begin = _clipped_to_half_plane(whole, normal, phase + k * period)
                painted.append((_clipped_to_half_plane(begin, normal + np.pi, -(phase + (k + duty) * period)), inside))
            return [(corners, albedo) for corners, albedo in painted if len(corners)]
        case _:
            return []


def _clipped_to_half_plane(corners_mm: FloatArray, normal_rad: float, offset_mm: float) -> FloatArray:
    """Clip a convex outline, (n, 2), to the half-plane x cos(normal) + y sin(normal) >= offset."""
    if not len(corners_mm):
        return corners_mm
    away = corners_mm @ [np.cos(normal_rad), np.sin(normal_rad)] - offset_mm
    kept = []
    for here, there, a, b in zip(corners_mm, np.roll(corners_mm, -1, axis=0), away, np.roll(away, -1), strict=True):
        if a >= 0:
            kept.append(here)
        if (a > 0) != (b > 0) and a != b:
            kept.append(here + (there - here) * a / (a - b))
    return np.array(kept).reshape(-1, 2)


def _draw_raster(ax: Axes, pattern: Pattern, low_mm: Any, high_mm: Any, place: Any) -> None:
    n_x, n_y = (max(round((high - low) / _PIXEL_MM), 1) for low, high in zip(low_mm, high_mm, strict=True))
    x = low_mm[0] + (np.arange(n_x) + 0.5) * (high_mm[0] - low_mm[0]) / n_x
    y = low_mm[1] + (np.arange(n_y) + 0.5) * (high_mm[1] - low_mm[1]) / n_y
    shades = region_of(pattern).albedo(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))[0].reshape(n_y, n_x)
    off_x, off_y = place(np.zeros((1, 2)))[0]
    draw_map(ax, shades, x + off_x, y + off_y, cmap="gray", vmin=0.0, vmax=1.0, aspect="auto", zorder=1)
