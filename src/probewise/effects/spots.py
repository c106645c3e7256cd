"""What sits at one place: a bell-shaped spot beside a line that was scanned, and how large it may be.

From one line nobody can tell a bright spot beside it from a faint one on it. So the prior is laid out
by what the line shows: the spot's height where the line passes it, its place along the line, how many
radii it lies beside the line, and its radius; the first and the last two make the spot's own height.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.heavy_tailed import HeavyTailed
from probewise.priors import LogUniform, Normal, Product, Uniform
from probewise.recordings.plan import Plan

__all__ = ["ALONG_X", "Line", "SpotPrior", "bell", "scanned_lines", "spot_bank"]

_RADII = (0.04, 0.1, 0.25)  # of the line's length, for the bank; their prior reaches twice as far
_MARGIN = 0.1  # of the line's length: a spot may lie beyond its ends
_STRAIGHT = 0.02  # of a scan's length: how far it may stray from its line
_LEAST_PLACES = 8


def bell(squared_distance: FloatArray, radius: FloatArray) -> FloatArray:
    """exp(-d^2 / 2 r^2); both broadcast."""
    return np.exp(-0.5 * squared_distance / radius**2)


@dataclass(frozen=True)
class Line:
    """Places s t + offset_mm n for s from low_mm to high_mm, with t at `angle_rad` to X and n a quarter turn on."""

    angle_rad: float
    offset_mm: float
    low_mm: float
    high_mm: float

    @property
    def length_mm(self) -> float:
        """From end to end."""
        return self.high_mm - self.low_mm

    def place(self, along_mm: FloatArray, beside_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """X and Y of places so far along the line and beside it."""
        c, s, n = np.cos(self.angle_rad), np.sin(self.angle_rad), self.offset_mm + beside_mm
        return c * along_mm - s * n, s * along_mm + c * n

    def coordinates(self, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Invert `place`."""
        c, s = np.cos(self.angle_rad), np.sin(self.angle_rad)
        return c * x_mm + s * y_mm, c * y_mm - s * x_mm - self.offset_mm


ALONG_X = Line(0.0, 0.0, -50.0, 50.0)
"""The X axis, 50 mm to either side."""


def scanned_lines(plan: Plan) -> tuple[Line, ...]:
    """List the lines along which straight scans went, each once."""
    found: dict[tuple[float, float], Line] = {}
    for rows in plan.rows_by_scan():
        places = np.unique(np.stack([plan.x_mm[rows], plan.y_mm[rows]], axis=-1), axis=0)
        if len(places) < _LEAST_PLACES:
            continue
        t = places[-1] - places[0]  # sorted by X, then Y: never against X
        angle = float(np.arctan2(t[1], t[0]))
        along, across = Line(angle, 0.0, 0.0, 1.0).coordinates(*places.T)
        if np.ptp(across) > _STRAIGHT * np.ptp(along):
            continue
        line = Line(angle, float(across.mean()), float(along.min()), float(along.max()))
        key = (round(angle, 3), round(line.offset_mm / (_STRAIGHT * line.length_mm)))
        other = found.get(key, line)
        found[key] = Line(
            other.angle_rad, other.offset_mm, min(line.low_mm, other.low_mm), max(line.high_mm, other.high_mm)
        )
    return tuple(found.values())


@dataclass(frozen=True)
class SpotPrior:
    """Believe in a spot of either sign on or beside a line; parameters: its height (named `size`), x, y, r."""

    size: str
    typical: float
    line: Line

    BESIDE: ClassVar[Normal] = Normal(0.0, 0.7)  # radii beside the line

    @property
    def names(self) -> tuple[str, ...]:
        """The height's name, then x, y, r."""
        return (self.size, "x", "y", "r")

    @cached_property
    def _by_line(self) -> Product:
        """What the line shows: height on it, place along it, radii beside it, radius."""
        line, length = self.line, self.line.length_mm
        return Product(
            {
                "on_line": HeavyTailed(self.typical),
                "along": Uniform(line.low_mm - _MARGIN * length, line.high_mm + _MARGIN * length),
                "beside": self.BESIDE,
                "r": LogUniform(_RADII[0] / 2 * length, _RADII[-1] * 2 * length),
            }
        )

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        """Map coordinates to height, x, y, r, (n_samples, 4) both ways."""
        on_line, along, beside, r = self._by_line.from_unit_cube(u).T
        x, y = self.line.place(along, beside * r)
        return np.stack([on_line * np.exp(0.5 * beside**2), x, y, r], axis=-1)

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        """Invert `from_unit_cube`."""
        return self._by_line.to_unit_cube(self._shown(theta))

    def log_prob(self, theta: FloatArray) -> FloatArray:
        """Natural log of the density, (n_samples, 4) -> (n_samples,)."""
        shown = self._shown(theta)
        # d(on_line, beside) / d(height, y) = exp(-beside^2 / 2) / r
        return self._by_line.log_prob(shown) - 0.5 * shown[:, 2] ** 2 - np.log(shown[:, 3])

    def _shown(self, theta: FloatArray) -> FloatArray:
        height, x, y, r = theta.T
        along, beside_mm = self.line.coordinates(x, y)
        beside = beside_mm / r
        return np.stack([height * np.exp(-0.5 * beside**2), along, beside, r], axis=-1)


def spot_bank(typical: float, line: Line) -> FloatArray:
    """Spots of three radii, a radius apart, on the line: (n_bank, 1, 4)."""
    spots = []
    for share in _RADII:
        r = share * line.length_mm
        along = np.arange(line.low_mm, line.high_mm + r / 2, r)
        x, y = line.place(along, np.zeros_like(along))
        spots.append(np.stack([np.full_like(along, typical), x, y, np.full_like(along, r)], axis=-1))
    return np.concatenate(spots)[:, None, :]
