"""The patterns of the recording format: one class per kind, holding numbers only.

They are data, not models: `scene` builds albedo fields from them and the independent `world`
renders pixels from them, so the two share numbers but no code.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from probewise._arrays import FloatArray, floats
from probewise._kinds import checked_finite_number, checked_pair
from probewise.errors import ParameterError, require


class _CheckedPattern:
    """Base of the patterns: converts numbers to floats and pairs to tuples; ParameterError for other values."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # type: ignore[arg-type]  # every pattern is a dataclass
            value: object = getattr(self, field.name)
            if field.type == "float":
                value = checked_finite_number(field.name, value)
            elif field.type == "tuple[float, float]":
                value = checked_pair(field.name, value)
            object.__setattr__(self, field.name, value)

    def _require_positive(self, name: str) -> None:
        require(getattr(self, name) > 0, name, getattr(self, name), "a number greater than 0")


@dataclass(frozen=True)
class Uniform(_CheckedPattern):
    """Uniform albedo."""

    albedo: float


@dataclass(frozen=True)
class HalfPlane(_CheckedPattern):
    """The half-plane x cos(normal) + y sin(normal) > offset: albedo `inside` there, `outside` elsewhere."""

    normal_rad: float
    offset_mm: float
    inside: float = 1.0
    outside: float = 0.0


@dataclass(frozen=True)
class Quadrant(_CheckedPattern):
    """The quadrant (x - cx) dx > 0 and (y - cy) dy > 0, (cx, cy) its corner; direction is (dx, dy), each +1 or -1.

    The albedo is `inside` there, `outside` elsewhere.
    """

    corner_mm: tuple[float, float]
    direction: tuple[int, int]
    inside: float = 1.0
    outside: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        allowed = "(1, 1), (1, -1), (-1, 1) or (-1, -1)"
        dx, dy = checked_pair("direction", self.direction, allowed)
        require(abs(dx) == abs(dy) == 1, "direction", self.direction, allowed)
        object.__setattr__(self, "direction", (int(dx), int(dy)))


@dataclass(frozen=True)
class Disc(_CheckedPattern):
    """A disc: albedo `inside` the circle and `outside` it."""

    center_mm: tuple[float, float]
    radius_mm: float
    inside: float = 1.0
    outside: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_positive("radius_mm")


@dataclass(frozen=True)
class Polygon(_CheckedPattern):
    """A polygon: albedo `inside` it, by the even-odd rule, and `outside` it."""

    vertices_mm: tuple[tuple[float, float], ...]
    inside: float = 1.0
    outside: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        allowed = "three corners (x, y) or more"
        vertices: object = self.vertices_mm
        if not isinstance(vertices, Sequence | np.ndarray) or isinstance(vertices, str) or len(vertices) < 3:
            raise ParameterError("vertices_mm", vertices, allowed)
        pairs = tuple(checked_pair(f"vertices_mm[{k}]", corner) for k, corner in enumerate(vertices))
        object.__setattr__(self, "vertices_mm", pairs)


@dataclass(frozen=True)
class Stripes(_CheckedPattern):
    """Stripes where frac((x . n - phase) / period) < duty, n the unit normal: albedo `inside` and `outside` them."""

    normal_rad: float
    period_mm: float
    duty: float
    phase_mm: float
    inside: float = 1.0
    outside: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_positive("period_mm")
        require(0 <= self.duty <= 1, "duty", self.duty, "a number from 0 to 1")


@dataclass(frozen=True)
class Ramp(_CheckedPattern):
    """A linear gradient without bounds: albedo per_mm (x . n), n the unit normal.

    It also stands for the scale of an encoder, a sensor that reads its own position along n.
    """

    normal_rad: float
    per_mm: float


@dataclass(frozen=True, eq=False)
class Image(_CheckedPattern):
    """An image: one albedo (0 to 1) per pixel, (n_rows, n_columns), first row on top; the albedo outside is 0.

    `origin_mm` is its lower left corner. `file` is the name, without a path, of the PNG or .npy file in which
    `write_recording` and `write_plan` store it.
    """

    albedo: FloatArray
    pixel_mm: float
    origin_mm: tuple[float, float]
    file: str

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_positive("pixel_mm")
        albedo = floats(self.albedo, "albedo")
        require(albedo.ndim == 2, "albedo", f"an array of shape {albedo.shape}", "(n_rows, n_columns), numbers 0 to 1")
        object.__setattr__(self, "albedo", albedo)


Pattern: TypeAlias = Uniform | HalfPlane | Quadrant | Disc | Polygon | Stripes | Ramp | Image


def have_same_albedo(one: Pattern, other: Pattern) -> bool:
    """Return whether two patterns have the same kind and values; of images all pixels count, but no file's name."""
    own = (field.name for field in dataclasses.fields(one) if field.name != "file")
    return type(one) is type(other) and all(
        np.array_equal(getattr(one, k), getattr(other, k), equal_nan=k == "albedo") for k in own
    )


PATTERNS: tuple[type, ...] = (Uniform, HalfPlane, Quadrant, Disc, Polygon, Stripes, Ramp, Image)
"""The classes of the patterns."""


_SIDES = ("on the right, x > {:g} mm", "on top, y > {:g} mm", "on the left, x < {:g} mm", "below, y < {:g} mm")
_EVEN = 1e-9


def where_white_in_words(pattern: Pattern) -> str:
    """Say where a pattern is white, seen from above with x to the right and y up, in its own frame.

    Examples
    --------
    >>> from probewise.recordings import HalfPlane
    >>> where_white_in_words(HalfPlane(0.0, 0.0))
    'white on the right, x > 0 mm, black elsewhere'
    """
    match pattern:
        case Uniform(albedo):
            return f"all {_shade_in_words(albedo)}"
        case Ramp(normal, per_mm):
            return f"a ramp that brightens by {per_mm:g} of white per mm towards {math.degrees(normal):g} degrees"
        case Image(_, _, _, file):
            return f"the picture {file}, black around it"
        case HalfPlane(normal, offset):
            quarter = normal / (math.pi / 2)
            side = round(quarter) % 4
            where = f"towards {math.degrees(normal):g} degrees of the line {offset:g} mm from the origin"
            if abs(quarter - round(quarter)) <= _EVEN:
                where = _SIDES[side].format((offset if side < 2 else -offset) + 0.0)
        case Quadrant((x, y), (dx, dy)):
            where = f"{'above' if dy > 0 else 'below'} y = {y:g} mm and {'right' if dx > 0 else 'left'} of x = {x:g} mm"
        case Disc((x, y), radius):
            where = f"inside the circle of radius {radius:g} mm about ({x:g}, {y:g}) mm"
        case Polygon():
            where = "inside the polygon"
        case Stripes(normal, period, duty):
            across = f"across {math.degrees(normal):g} degrees"
            where = f"in stripes of {duty * period:g} mm, one every {period:g} mm, {across}"
    return f"{_shade_in_words(pattern.inside)} {where}, {_shade_in_words(pattern.outside)} elsewhere"


def _shade_in_words(albedo: float) -> str:
    if albedo >= 1:
        return "white"
    return "black" if albedo <= 0 else f"grey (albedo {albedo:g})"
