"""Axes with marks on them, and drawings of several: SVG written straight, in a thousandth of a second or two.

A page of fifteen figures costs a plotting library two seconds of a whole diagnosis' five; these need none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.report.drawing.frame import FONT, SMALL, Frame, text, text_width, ticks
from probewise.report.drawing.marks import Mark

__all__ = ["Panel", "drawing"]

WIDTH = 900  # px of a drawing: that of a page's column
_PAD, _TICK, _LINE = 8.0, 5.0, 20.0
_LEGEND = 22.0  # px from the sample of one mark to its name
_ROUNDING = 1e-6  # of values: what is no further apart is the same
_SLANT = 35.0  # degrees, of names that do not fit side by side


@dataclass(frozen=True, eq=False)
class Panel:
    """Marks on one pair of axes.

    Parameters
    ----------
    marks
        In the order of drawing.
    x, y
        What the axes carry, with units.
    title
        Above, in a word or two.
    x_names, y_names
        Names of values, where an axis has no scale: value and name.
    x_ends
        Ends of the x axis, where the marks are not to set them.
    height
        Of the frame, px.
    """

    marks: Sequence[Mark]
    x: str = ""
    y: str = ""
    title: str = ""
    x_names: Sequence[tuple[float, str]] | None = None
    y_names: Sequence[tuple[float, str]] | None = None
    x_ends: tuple[float, float] | None = None
    height: float = 230.0


def drawing(rows: Sequence[Sequence[Panel]], *, shares: Sequence[float] = (1.0,), width: int = WIDTH) -> bytes:
    """Write panels as one SVG file.

    Parameters
    ----------
    rows
        Panels side by side in each row, rows from top to bottom.
    shares
        Share of the width that each column gets.
    width
        Of the whole, px.
    """
    total, top, parts = sum(shares), 0.0, []
    lefts = [max(_left_margin(row[k]) for row in rows if k < len(row)) for k in range(len(shares))]
    for row in rows:
        left, bottom = 0.0, top
        for panel, margin, share in zip(row, lefts, shares, strict=False):
            across = width * share / total
            svg, needed = _panel(panel, left, top, across, margin)
            parts.append(svg)
            left, bottom = left + across, max(bottom, top + needed)
        top = bottom + _PAD
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {top:.0f}" width="{width}" height="{top:.0f}" '
        f'font-family="system-ui, Roboto, Arial, sans-serif" font-size="{FONT}" fill="#1b1b1b" '
        'stroke-linejoin="round">'
    )
    return f'{head}<rect width="100%" height="100%" fill="#fff"/>{"".join(parts)}</svg>\n'.encode()


def _left_margin(panel: Panel) -> float:
    labels = [name for _, name in panel.y_names] if panel.y_names else [label for _, label in _y_ticks(panel)]
    lines = [line for label in labels for line in label.split("\n")]
    widest = max((text_width(line) for line in lines), default=0.0)
    return _PAD + (_LINE if panel.y else 0.0) + widest + _TICK + 3


def _ends(values: Sequence[FloatArray], room: float) -> tuple[float, float]:
    joined = np.concatenate([np.ravel(v) for v in values]) if values else np.empty(0)
    joined = joined[np.isfinite(joined)]
    low, high = (float(joined.min()), float(joined.max())) if joined.size else (0.0, 1.0)
    apart = high - low > _ROUNDING * max(abs(low), abs(high))
    more = room * (high - low) if apart else 0.5 * max(abs(low), 1.0)
    return low - more, high + more


def _x_ends(panel: Panel) -> tuple[float, float]:
    return panel.x_ends or _ends([mark.extent[0] for mark in panel.marks], 0.015)


def _y_ends(panel: Panel) -> tuple[float, float]:
    return _ends([mark.extent[1] for mark in panel.marks], 0.0 if panel.y_names else 0.05)


def _y_ticks(panel: Panel) -> list[tuple[float, str]]:
    return ticks(*_y_ends(panel), max(int(panel.height / 36), 3))


def _panel(panel: Panel, left: float, top: float, across: float, margin: float) -> tuple[str, float]:
    """Draw one panel in its part of the width: SVG and the height that it needs."""
    width = across - margin - 2 * _PAD
    legend, needed = _legend(panel, left + margin, top + _PAD + (_LINE if panel.title else 0.0), width)
    above = _PAD + (_LINE if panel.title else 0.0) + needed
    frame = Frame(left + margin, top + above, width, panel.height, _x_ends(panel), _y_ends(panel))
    below, under = _x_axis(panel, frame)
    parts = [
        *(mark.svg(frame) for mark in panel.marks),
        f'<path d="M{frame.left:.1f},{frame.top:.1f}v{frame.height:.1f}h{frame.width:.1f}" fill="none" stroke="#444"/>',
        below,
        _y_axis(panel, frame, left),
        legend,
    ]
    if panel.title:
        parts.append(f'<g font-weight="600">{text(left + margin, top + _PAD + _LINE / 2, panel.title)}</g>')
    return "".join(parts), above + panel.height + under


def _legend(panel: Panel, left: float, top: float, width: float) -> tuple[str, float]:
    """Set the names of the marks in lines above the frame: SVG and the height that it needs."""
    x, y, parts = left, top + _LINE / 2, []
    named = [mark for mark in panel.marks if mark.name]
    for mark in named:
        needed = _LEGEND + text_width(mark.name) + 16
        if x > left and x + needed > left + width:
            x, y = left, y + _LINE
        parts.append(_sample(mark, x, y))
        parts.append(text(x + _LEGEND, y, mark.name, small=True))
        x += needed
    return "".join(parts), (y + _LINE / 2 - top + 2) if named else 0.0


def _sample(mark: Mark, x: float, y: float) -> str:
    match mark.sample:
        case "line":
            return f'<path d="M{x:.1f},{y:.1f}h16" stroke="{mark.colour}" stroke-width="2.2"/>'
        case "dot":
            return f'<circle cx="{x + 10:.1f}" cy="{y:.1f}" r="2.5" fill="{mark.colour}"/>'
        case "area":
            return (
                f'<rect x="{x:.1f}" y="{y - 5:.1f}" width="16" height="10" fill="{mark.colour}" '
                f'fill-opacity="{mark.opacity}"/>'
            )


def _x_axis(panel: Panel, frame: Frame) -> tuple[str, float]:
    """Draw ticks, their labels and what the axis carries: SVG and the height below the frame."""
    floor = frame.top + frame.height
    marks = list(panel.x_names) if panel.x_names else ticks(*frame.x, max(int(frame.width / 60), 2))
    places = frame.px_of_x(np.array([value for value, _ in marks], dtype=np.float64)).tolist()
    each = frame.width / max(len(marks), 1)
    widest = max((text_width(label) for _, label in marks), default=0.0)
    slanted = bool(panel.x_names) and widest > each - 6
    skip = max(1, int(np.ceil((SMALL + 3) / each))) if slanted else 1
    parts = []
    for k, (px, (_, label)) in enumerate(zip(places, marks, strict=True)):
        parts.append(f'<path d="M{px:.1f},{floor:.1f}v{_TICK}" stroke="#444"/>')
        if k % skip == 0:
            how = ("end", _SLANT) if slanted else ("middle", 0.0)
            parts.append(text(px, floor + _TICK + 10, label, anchor=how[0], small=True, turned=how[1]))
    under = _TICK + 20 + (widest * np.sin(np.radians(_SLANT)) if slanted else 0.0)
    if panel.x:
        parts.append(text(frame.left + frame.width / 2, floor + under + 8, panel.x, anchor="middle"))
        under += _LINE
    return "".join(parts), under


def _y_axis(panel: Panel, frame: Frame, left: float) -> str:
    marks = list(panel.y_names) if panel.y_names else _y_ticks(panel)
    places = frame.px_of_y(np.array([value for value, _ in marks], dtype=np.float64)).tolist()
    parts = []
    for py, (_, label) in zip(places, marks, strict=True):
        parts.append(f'<path d="M{frame.left:.1f},{py:.1f}h{-_TICK}" stroke="#444"/>')
        lines = label.split("\n")
        for k, line in enumerate(lines):
            y = py + (k - (len(lines) - 1) / 2) * (SMALL + 2)
            parts.append(text(frame.left - _TICK - 3, y, line, anchor="end", small=True))
    if panel.y:
        parts.append(text(left + _PAD + 6, frame.top + frame.height / 2, panel.y, anchor="middle", turned=90))
    return "".join(parts)
