"""The map from values to pixels, and the smallest pieces of SVG."""

from __future__ import annotations

import html
import math
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray

__all__ = ["FONT", "SMALL", "Frame", "points", "text", "text_width", "ticks"]

FONT, SMALL = 13, 12  # px


@dataclass(frozen=True)
class Frame:
    """The part of a drawing between the axes, in pixels, and the values at its ends."""

    left: float
    top: float
    width: float
    height: float
    x: tuple[float, float]
    y: tuple[float, float]

    def px_of_x(self, values: FloatArray) -> FloatArray:
        """Map values to pixels from the left."""
        return np.asarray(self.left + self.width * (values - self.x[0]) / (self.x[1] - self.x[0]))

    def px_of_y(self, values: FloatArray) -> FloatArray:
        """Map values to pixels from the top."""
        return np.asarray(self.top + self.height * (self.y[1] - values) / (self.y[1] - self.y[0]))


def points(frame: Frame, x: FloatArray, y: FloatArray) -> str:
    """Write points as an SVG path has them, to a tenth of a pixel."""
    pairs = zip(frame.px_of_x(x).tolist(), frame.px_of_y(y).tolist(), strict=True)
    return " ".join(f"{px:.1f},{py:.1f}" for px, py in pairs)


def text(x: float, y: float, said: str, *, anchor: str = "start", small: bool = False, turned: float = 0.0) -> str:
    """Write text with its middle at height y; `turned` in degrees anticlockwise about its anchor."""
    turn = f' transform="rotate({-turned:g} {x:.1f} {y:.1f})"' if turned else ""
    size = f' font-size="{SMALL}"' if small else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" dy=".35em" text-anchor="{anchor}"{size}{turn}>{html.escape(said)}</text>'


def text_width(said: str, size: float = SMALL) -> float:
    """Estimate the width of a line of text, px: letters of a sans serif are about 0.55 of its size wide."""
    narrow = sum(said.count(c) for c in "iljtf.,:;'|() 1")
    return size * (0.6 * len(said) - 0.25 * narrow)


def ticks(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """List round values between two ends, about as many as asked for and three at least, with their labels."""
    rough = max((high - low) / max(most, 1), 1e-300)
    decade = 10.0 ** math.floor(math.log10(rough))
    steps = [s * decade for s in (10.0, 5.0, 2.0, 1.0, 0.5, 0.2, 0.1)]
    for step in steps[next(k for k in (3, 2, 1, 0) if steps[k] >= rough * (1 - 1e-9)) :]:
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        if last - first >= 2:
            break
    return [(k * step, _label(k * step, step)) for k in range(first, last + 1)]


def _label(value: float, step: float) -> str:
    if step < 1e-4 or abs(value) >= 1e7:
        return f"{value:.3g}".replace("-", "−")
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    return f"{value:,.{decimals}f}".replace("-", "−") if value else "0"
