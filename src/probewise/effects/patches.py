"""Local effects: a Gaussian patch on or beside a scanned line, and its prior.

One scan cannot distinguish a bright patch beside its line from a faint one on it. So the prior is over what
the scan shows: the height on the line, the place along it, the distance from it in radii, and the radius.
The patch's own height follows from the height on the line and the distance in radii.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.heavy_tailed_prior import HeavyTailedPrior
from probewise.effects.motion import distinct_positions_mm
from probewise.effects.vocabulary import NamedEffect, V, single_column_bank
from probewise.priors import LogUniform, Normal, Product, Uniform
from probewise.recordings.plan import Plan

_RADII = (0.04, 0.1, 0.25)  # of the line's length, for the bank; the prior reaches twice as far either way
_MARGIN = 0.1  # of the line's length: a patch may lie beyond its ends
_STRAIGHT = 0.02  # of a scan's length: the largest deviation from a straight line
_LEAST_PLACES = 8
_LEAST_ANGLE_RAD = np.radians(-89.5)
_ONE_DIRECTION_RAD = np.radians(1.0)


def gaussian_bump(squared_distance: FloatArray, radius: FloatArray) -> FloatArray:
    """Return exp(-d^2 / 2 r^2) of the squared distances d^2; the arrays broadcast."""
    return np.exp(-0.5 * squared_distance / radius**2)


@dataclass(frozen=True)
class ScanLine:
    """A line at `angle_rad` to X, `offset_mm` beside the origin, from `low_mm` to `high_mm` along it.

    Its points are s t + offset_mm n, s from low_mm to high_mm; t is the unit vector along the line, n is t turned by 90
    degrees.
    """

    angle_rad: float
    offset_mm: float
    low_mm: float
    high_mm: float

    @property
    def length_mm(self) -> float:
        """Length of the line, mm."""
        return self.high_mm - self.low_mm

    def lab_coordinates_mm(self, along_mm: FloatArray, beside_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return X and Y of points given by their position along the line and distance from it; arrays broadcast."""
        c, s, n = np.cos(self.angle_rad), np.sin(self.angle_rad), self.offset_mm + beside_mm
        return c * along_mm - s * n, s * along_mm + c * n

    def line_coordinates_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the position of points X, Y along the line, and their distance from it; arrays broadcast."""
        c, s = np.cos(self.angle_rad), np.sin(self.angle_rad)
        return c * x_mm + s * y_mm, c * y_mm - s * x_mm - self.offset_mm


ALONG_X = ScanLine(0.0, 0.0, -50.0, 50.0)
"""The X axis, 50 mm to either side."""


def distinct_scan_lines(plan: Plan) -> tuple[ScanLine, ...]:
    """Return the distinct lines of the plan's straight scans that have eight distinct places or more."""
    found: list[ScanLine] = []
    for rows in plan.rows_by_scan():
        places = np.unique(np.stack([plan.x_mm[rows], plan.y_mm[rows]], axis=-1), axis=0)
        if len(places) < _LEAST_PLACES:
            continue
        angle = _principal_angle_rad(places)
        along, across = ScanLine(angle, 0.0, 0.0, 1.0).line_coordinates_mm(*places.T)
        if len(distinct_positions_mm(along)) < _LEAST_PLACES or np.ptp(across) > _STRAIGHT * np.ptp(along):
            continue
        line = ScanLine(angle, float(across.mean()), float(along.min()), float(along.max()))
        for k, other in enumerate(found):
            if _are_one_line(line, other):
                low_mm, high_mm = min(line.low_mm, other.low_mm), max(line.high_mm, other.high_mm)
                found[k] = replace(other, low_mm=low_mm, high_mm=high_mm)
                break
        else:
            found.append(line)
    return tuple(found)


def _are_one_line(line: ScanLine, other: ScanLine) -> bool:
    """Return whether two lines have one direction and, as shares of their lengths, one offset."""
    apart = line.offset_mm / line.length_mm - other.offset_mm / other.length_mm
    return abs(line.angle_rad - other.angle_rad) < _ONE_DIRECTION_RAD and abs(apart) < 0.5 * _STRAIGHT


def _principal_angle_rad(places_mm: FloatArray) -> float:
    """Return the angle to X of the principal axis of places, (n_places, 2), above -89.5 and up to 90.5 degrees.

    So places that scatter about a line along Y have an angle of about 90 degrees, and never one of -90.
    """
    x_mm, y_mm = (axis - axis.mean() for axis in (places_mm - places_mm[0]).T)  # exactly 0 for an axis that rests
    angle = 0.5 * float(np.arctan2(2 * x_mm @ y_mm, x_mm @ x_mm - y_mm @ y_mm))
    return angle + np.pi if angle < _LEAST_ANGLE_RAD else angle


@dataclass(frozen=True)
class PatchPrior:
    """Prior of a patch of either sign on or beside a line; parameters: its height (named `size`), x, y, r."""

    size: str
    typical: float
    line: ScanLine

    BESIDE: ClassVar[Normal] = Normal(0.0, 0.7)  # distance from the line in radii

    @property
    def names(self) -> tuple[str, ...]:
        """The height's name, then x, y, r."""
        return (self.size, "x", "y", "r")

    @property
    def radius_prior(self) -> LogUniform:
        """Log-uniform prior of the radius, mm: from 0.02 to 0.5 of the line's length."""
        return LogUniform(_RADII[0] / 2 * self.line.length_mm, _RADII[-1] * 2 * self.line.length_mm)

    @cached_property
    def _prior_seen_by_scan(self) -> Product:
        """Prior over what the scan shows: height on the line, place along it, distance in radii, radius."""
        line, length = self.line, self.line.length_mm
        return Product(
            {
                "on_line": HeavyTailedPrior(self.typical),
                "along": Uniform(line.low_mm - _MARGIN * length, line.high_mm + _MARGIN * length),
                "beside": self.BESIDE,
                "r": self.radius_prior,
            }
        )

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        """Map unit-cube coordinates to height, x, y, r; both (n_samples, 4)."""
        on_line, along, beside, r = self._prior_seen_by_scan.from_unit_cube(u).T
        x, y = self.line.lab_coordinates_mm(along, beside * r)
        return np.stack([on_line * np.exp(0.5 * beside**2), x, y, r], axis=-1)

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        """Map height, x, y, r to unit-cube coordinates; both (n_samples, 4)."""
        return self._prior_seen_by_scan.to_unit_cube(self._parameters_seen_by_scan(theta))

    def log_prob(self, theta: FloatArray) -> FloatArray:
        """Return the natural log of the density, (n_samples, 4) -> (n_samples,); -inf for a radius of 0 or below."""
        possible = theta[:, 3] > 0
        shown = self._parameters_seen_by_scan(np.where(possible[:, None], theta, 1.0))
        # d(on_line, beside) / d(height, y) = exp(-beside^2 / 2) / r
        log_density = self._prior_seen_by_scan.log_prob(shown) - 0.5 * shown[:, 2] ** 2 - np.log(shown[:, 3])
        return np.where(possible, log_density, -np.inf)

    def _parameters_seen_by_scan(self, theta: FloatArray) -> FloatArray:
        """Convert height, x, y, r to height on the line, place along it, distance in radii, radius: (n_samples, 4)."""
        height, x, y, r = theta.T
        along, beside_mm = self.line.line_coordinates_mm(x, y)
        beside = beside_mm / r
        return np.stack([height * np.exp(-0.5 * beside**2), along, beside, r], axis=-1)


@dataclass(frozen=True)
class PatchEffect(NamedEffect[V]):
    """Base of effects that are a patch on or beside the scanned line `line`; `lines` are the candidate lines."""

    typical: float
    line: ScanLine = ALONG_X
    lines: tuple[ScanLine, ...] = ()

    size: ClassVar[str]
    """Name of the patch's height."""

    @cached_property
    def prior(self) -> PatchPrior:
        """Prior of height, place and radius."""
        return PatchPrior(self.size, self.typical, self.line)

    def variants(self) -> tuple[Self, ...]:
        """Return one variant for each scanned line."""
        return tuple(replace(self, line=line) for line in self.lines)

    def bank(self) -> FloatArray:
        """Return parameters of patches on the line, of three radii and spaced by their radius: (n_bank, 1, 4)."""
        patches = []
        for share in _RADII:
            r = share * self.line.length_mm
            along = np.arange(self.line.low_mm, self.line.high_mm + r / 2, r)
            x, y = self.line.lab_coordinates_mm(along, np.zeros_like(along))
            patches.append(single_column_bank(self.typical, x, y, r))
        return np.concatenate(patches)
