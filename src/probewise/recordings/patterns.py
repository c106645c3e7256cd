"""What a recording says lay under the sensor: one value a pattern kind, numbers only.

These are the file format's kinds, not models: `scene` builds albedo fields from them and
the independent `world` paints pixels from them, so the two share numbers and no code.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from probewise._arrays import FloatArray

__all__ = ["Disc", "HalfPlane", "Image", "Pattern", "Polygon", "Quadrant", "Ramp", "Stripes", "Uniform"]


@dataclass(frozen=True)
class Uniform:
    """The same albedo everywhere."""

    albedo: float


@dataclass(frozen=True)
class HalfPlane:
    """Inside where x cos(normal) + y sin(normal) > offset."""

    normal_rad: float
    offset_mm: float
    inside: float = 1.0
    outside: float = 0.0


@dataclass(frozen=True)
class Quadrant:
    """Inside where both (x - cx) dx > 0 and (y - cy) dy > 0; direction holds dx, dy = +1 or -1."""

    corner_mm: tuple[float, float]
    direction: tuple[int, int]
    inside: float = 1.0
    outside: float = 0.0


@dataclass(frozen=True)
class Disc:
    """Inside a circle."""

    center_mm: tuple[float, float]
    radius_mm: float
    inside: float = 1.0
    outside: float = 0.0


@dataclass(frozen=True)
class Polygon:
    """Inside a polygon by the even-odd rule."""

    vertices_mm: tuple[tuple[float, float], ...]
    inside: float = 1.0
    outside: float = 0.0


@dataclass(frozen=True)
class Stripes:
    """Inside where frac((x . n - phase) / period) < duty."""

    normal_rad: float
    period_mm: float
    duty: float
    phase_mm: float
    inside: float = 1.0
    outside: float = 0.0


@dataclass(frozen=True)
class Ramp:
    """Albedo per_mm (x . n), not bounded: an encoder reading a scale is a sensor reading a ramp."""

    normal_rad: float
    per_mm: float


@dataclass(frozen=True, eq=False)
class Image:
    """Pixels, first row on top, albedo 0 to 1, 0 outside; `origin_mm` is the lower left corner."""

    albedo: FloatArray
    pixel_mm: float
    origin_mm: tuple[float, float]
    file: str


Pattern: TypeAlias = Uniform | HalfPlane | Quadrant | Disc | Polygon | Stripes | Ramp | Image
