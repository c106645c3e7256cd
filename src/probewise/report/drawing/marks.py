"""What can be drawn on axes: each mark knows how far it reaches, its SVG, and its sample in the legend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol, TypeAlias

import numpy as np

from probewise._arrays import FloatArray
from probewise.report.drawing.frame import Frame, points, text
from probewise.report.palette import BLACK, GREY, SKY

__all__ = ["Band", "Bars", "Boxes", "Dots", "Line", "Mark", "Rule", "Sample", "Span"]

Extent: TypeAlias = tuple[FloatArray, FloatArray]
"""Values of x and of y that must have room on the axes, any number of each."""

Sample: TypeAlias = Literal["line", "area", "dot"]

_NOTHING = np.empty(0)


class Mark(Protocol):
    """One thing drawn; without a name it has no place in the legend."""

    @property
    def name(self) -> str:
        """Its name in the legend."""
        ...

    @property
    def colour(self) -> str:
        """Its colour there."""
        ...

    @property
    def opacity(self) -> float:
        """How much of what is below it covers."""
        ...

    @property
    def sample(self) -> Sample:
        """What stands for it in the legend."""
        ...

    @property
    def extent(self) -> Extent:
        """What must have room."""
        ...

    def svg(self, frame: Frame) -> str:
        """Draw."""
        ...


@dataclass(frozen=True, eq=False)
class Band:
    """An area between two curves, (n_points,) each."""

    x: FloatArray
    low: FloatArray
    high: FloatArray
    name: str = ""
    colour: str = GREY
    opacity: float = 0.3
    sample: ClassVar[Sample] = "area"

    @property
    def extent(self) -> Extent:
        """Reach as far as both curves."""
        return self.x, np.concatenate([self.low, self.high])

    def svg(self, frame: Frame) -> str:
        """Go along the one curve and back along the other."""
        x, y = np.concatenate([self.x, self.x[::-1]]), np.concatenate([self.low, self.high[::-1]])
        return f'<path d="M{points(frame, x, y)}z" fill="{self.colour}" fill-opacity="{self.opacity}"/>'


@dataclass(frozen=True, eq=False)
class Line:
    """A line through points, (n_points,), with a knot at each if `knots`; gone where y is NaN."""

    x: FloatArray
    y: FloatArray
    name: str = ""
    colour: str = BLACK
    width: float = 1.7
    knots: bool = False
    joined: bool = True
    opacity: ClassVar[float] = 1.0
    sample: ClassVar[Sample] = "line"

    @property
    def extent(self) -> Extent:
        """Reach as far as the points."""
        return self.x, self.y

    def svg(self, frame: Frame) -> str:
        """Draw the line, then its knots."""
        ok = np.isfinite(self.x) & np.isfinite(self.y)
        if not ok.any():
            return ""
        at = points(frame, self.x[ok], self.y[ok])
        drawn = (
            f'<path d="M{at}" fill="none" stroke="{self.colour}" stroke-width="{self.width}"/>' if self.joined else ""
        )
        return drawn + (_spots(at, self.colour, 6.0, 1.0) if self.knots else "")


@dataclass(frozen=True, eq=False)
class Dots:
    """Points by themselves, (n_points,); those that fall on one pixel are drawn once."""

    x: FloatArray
    y: FloatArray
    name: str = ""
    colour: str = BLACK
    size: float = 3.0
    opacity: float = 0.5
    sample: ClassVar[Sample] = "dot"

    @property
    def extent(self) -> Extent:
        """Reach as far as the points."""
        return self.x, self.y

    def svg(self, frame: Frame) -> str:
        """Draw all dots as one path of strokes without length."""
        ok = np.isfinite(self.x) & np.isfinite(self.y)
        at = np.stack([frame.px_of_x(self.x[ok]), frame.px_of_y(self.y[ok])], axis=1)
        at = np.unique(np.round(at), axis=0) if len(at) > _MANY else np.round(at, 1)
        return _spots(" ".join(f"{x:g},{y:g}" for x, y in at.tolist()), self.colour, self.size, self.opacity)


@dataclass(frozen=True, eq=False)
class Boxes:
    """Upright boxes about places x, (n_boxes,), from low to high."""

    x: FloatArray
    low: FloatArray
    high: FloatArray
    name: str = ""
    colour: str = GREY
    opacity: float = 0.3
    half_width: float = 0.42
    sample: ClassVar[Sample] = "area"

    @property
    def extent(self) -> Extent:
        """Reach beyond the outermost boxes by a little."""
        ends = np.array([self.x.min() - 0.6, self.x.max() + 0.6]) if self.x.size else _NOTHING
        return ends, np.concatenate([self.low, self.high])

    def svg(self, frame: Frame) -> str:
        """Draw each box."""
        left, right = frame.px_of_x(self.x - self.half_width), frame.px_of_x(self.x + self.half_width)
        top, bottom = frame.px_of_y(self.high), frame.px_of_y(self.low)
        sides = zip(left, top, right - left, bottom - top, strict=True)
        return "".join(_box(*side, self.colour, self.opacity) for side in sides)


@dataclass(frozen=True, eq=False)
class Bars:
    """Bars that lie, from 0 to `length` (n_bars,), the first on top at y = 0, the next at -1; `said` behind each."""

    length: FloatArray
    colours: Sequence[str]
    said: Sequence[str] = ()
    name: str = ""
    colour: str = GREY
    opacity: ClassVar[float] = 1.0
    sample: ClassVar[Sample] = "area"

    @property
    def extent(self) -> Extent:
        """Reach from 0 to the longest; there is room for four bars at least, so that one alone is no wall."""
        return np.append(self.length, 0.0), np.array([0.6, -max(len(self.length), 4) + 0.4])

    def svg(self, frame: Frame) -> str:
        """Draw each bar with what is said behind it."""
        zero, out = float(frame.px_of_x(np.zeros(1))[0]), []
        ends = frame.px_of_x(self.length)
        for k, (end, colour) in enumerate(zip(ends.tolist(), self.colours, strict=True)):
            top, bottom = frame.px_of_y(np.array([0.32, -0.32]) - k)
            out.append(_box(min(zero, end), top, abs(end - zero), bottom - top, colour, 1.0))
            if self.said:
                out.append(text(end + 5, (top + bottom) / 2, self.said[k], small=True))
        return "".join(out)


@dataclass(frozen=True, eq=False)
class Rule:
    """A thin line right across: at a height, or upright at a place."""

    at: float
    upright: bool = False
    name: str = ""
    colour: str = BLACK
    width: float = 0.8
    opacity: ClassVar[float] = 1.0
    sample: ClassVar[Sample] = "line"

    @property
    def extent(self) -> Extent:
        """Its own place must have room."""
        own = np.array([self.at])
        return (own, _NOTHING) if self.upright else (_NOTHING, own)

    def svg(self, frame: Frame) -> str:
        """Draw from side to side."""
        if self.upright:
            x = float(frame.px_of_x(np.array([self.at]))[0])
            path = f"M{x:.1f},{frame.top}v{frame.height}"
        else:
            y = float(frame.px_of_y(np.array([self.at]))[0])
            path = f"M{frame.left},{y:.1f}h{frame.width}"
        return f'<path d="{path}" stroke="{self.colour}" stroke-width="{self.width}"/>'


@dataclass(frozen=True, eq=False)
class Span:
    """A part of the x axis, shaded from bottom to top."""

    start: float
    end: float
    name: str = ""
    colour: str = SKY
    opacity: float = 0.3
    sample: ClassVar[Sample] = "area"

    @property
    def extent(self) -> Extent:
        """Both ends must have room."""
        return np.array([self.start, self.end]), _NOTHING

    def svg(self, frame: Frame) -> str:
        """Shade; what is narrower than it could be seen is drawn wider."""
        start, end = frame.px_of_x(np.array([self.start, self.end])).tolist()
        middle, half = (start + end) / 2, max((end - start) / 2, _LEAST_SPAN / 2)
        return _box(middle - half, frame.top, 2 * half, frame.height, self.colour, self.opacity)


_LEAST_SPAN = 6.0  # px, of what is as pale as a shade
_MANY = 3000  # dots from which those on one pixel are drawn once


def _box(left: float, top: float, width: float, height: float, colour: str, opacity: float) -> str:
    return (
        f'<rect x="{left:.1f}" y="{top:.1f}" width="{max(width, 0.5):.1f}" height="{max(height, 0.5):.1f}" '
        f'fill="{colour}" fill-opacity="{opacity}"/>'
    )


def _spots(at: str, colour: str, size: float, opacity: float) -> str:
    path = "".join(f"M{place}h0" for place in at.split())
    return (
        f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="{size}" stroke-linecap="round" '
        f'stroke-opacity="{opacity}"/>'
    )
