"""Scenes on the field, parsed from texts such as `circle:524,300,100`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from probewise.errors import ParameterError
from probewise.recordings.patterns import Disc, HalfPlane, Polygon, Quadrant, Uniform
from probewise.world import Oval, Surface

FORMS = (
    "[circle:]X,Y,RADIUS",
    "ellipse:X,Y,A,B,ANGLE",
    "polygon:X,Y,X,Y,X,Y,...",
    "edge:ANGLE,OFFSET",
    "corner:X,Y,DX,DY",
    "uniform:ALBEDO",
)
"""Forms of a scene; mm and degrees. White is inside, beyond the edge, or towards DX, DY = +1 or -1."""


def parse_scene(text: str) -> Surface:
    """Parse a scene from a text in one of the `FORMS`, such as `circle:524,300,100`.

    Raises
    ------
    ParameterError
        If the text has none of the forms.
    """
    name, _, listed = text.rpartition(":")
    try:
        return _MAKERS[name or "circle"](*(_parse_finite(cell) for cell in listed.split(",")))
    except (KeyError, TypeError, ValueError) as error:
        raise ParameterError("--scene", text, f"{'; '.join(FORMS)}; in mm and degrees") from error


def scene_text(surface: Surface) -> str:
    """Return the text of a scene for `parse_scene`, its numbers to six digits.

    Raises ParameterError for an ellipse, and for a scene with none of the forms, such as stripes or black on white.
    """
    if (getattr(surface, "inside", 1.0), getattr(surface, "outside", 0.0)) == (1.0, 0.0):
        match surface:
            case Uniform(albedo):
                return f"uniform:{albedo:g}"
            case HalfPlane(normal, offset):
                return f"edge:{math.degrees(normal):.6g},{offset:.6g}"
            case Quadrant((x, y), (dx, dy)):
                return f"corner:{x:g},{y:g},{dx},{dy}"
            case Disc((x, y), radius):
                return f"circle:{x:g},{y:g},{radius:g}"
            case Polygon(vertices):
                return "polygon:" + ",".join(f"{x:g},{y:g}" for x, y in vertices)
    raise ParameterError("scene", type(surface).__name__, "; ".join(FORMS))


def _parse_finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _circle(x_mm: float, y_mm: float, radius_mm: float) -> Disc:
    return Disc((x_mm, y_mm), _checked_positive(radius_mm))


def _ellipse(x_mm: float, y_mm: float, a_mm: float, b_mm: float, angle_deg: float) -> Oval:
    return Oval((x_mm, y_mm), (_checked_positive(a_mm), _checked_positive(b_mm)), math.radians(angle_deg))


def _polygon(*numbers: float) -> Polygon:
    if len(numbers) < 6:
        raise ValueError(numbers)
    return Polygon(tuple(zip(numbers[::2], numbers[1::2], strict=True)))


def _edge(angle_deg: float, offset_mm: float) -> HalfPlane:
    return HalfPlane(math.radians(angle_deg), offset_mm)


def _corner(x_mm: float, y_mm: float, dx: float, dy: float) -> Quadrant:
    if {abs(dx), abs(dy)} != {1.0}:
        raise ValueError(dx, dy)
    return Quadrant((x_mm, y_mm), (int(dx), int(dy)))


def _uniform(albedo: float) -> Uniform:
    if not 0 <= albedo <= 1:
        raise ValueError(albedo)
    return Uniform(albedo)


def _checked_positive(value: float) -> float:
    if value <= 0:
        raise ValueError(value)
    return value


_MAKERS: Mapping[str, Callable[..., Surface]] = {
    "circle": _circle,
    "ellipse": _ellipse,
    "polygon": _polygon,
    "edge": _edge,
    "corner": _corner,
    "uniform": _uniform,
}
