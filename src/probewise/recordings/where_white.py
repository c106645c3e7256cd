"""A pattern in words that a person at the bench understands: which side is white."""

from __future__ import annotations

import math

from probewise.recordings.patterns import Disc, HalfPlane, Image, Pattern, Polygon, Quadrant, Ramp, Stripes, Uniform

_SIDES = {
    0: "on the right, x > {:g} mm",
    1: "on top, y > {:g} mm",
    2: "on the left, x < {:g} mm",
    3: "below, y < {:g} mm",
}
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
        case HalfPlane(normal, offset, inside, outside):
            return _shades_in_words(_half_plane_in_words(normal, offset), inside, outside)
        case Quadrant((x, y), (dx, dy), inside, outside):
            sides = f"{'above' if dy > 0 else 'below'} y = {y:g} mm and {'right' if dx > 0 else 'left'} of x = {x:g} mm"
            return _shades_in_words(sides, inside, outside)
        case Disc((x, y), radius, inside, outside):
            return _shades_in_words(
                f"inside the circle of radius {radius:g} mm about ({x:g}, {y:g}) mm", inside, outside
            )
        case Polygon(_, inside, outside):
            return _shades_in_words("inside the polygon", inside, outside)
        case Stripes(normal, period, duty, _, inside, outside):
            way = math.degrees(normal)
            stripes = f"in stripes of {duty * period:g} mm, one every {period:g} mm, across {way:g} degrees"
            return _shades_in_words(stripes, inside, outside)
        case Ramp(normal, per_mm):
            return f"a ramp that brightens by {per_mm:g} of white per mm towards {math.degrees(normal):g} degrees"
        case Image(_, _, _, file):
            return f"the picture {file}, black around it"


def _half_plane_in_words(normal_rad: float, offset_mm: float) -> str:
    quarter = normal_rad / (math.pi / 2)
    if abs(quarter - round(quarter)) > _EVEN:
        towards = f"towards {math.degrees(normal_rad):g} degrees"
        return f"{towards} of the line {offset_mm:g} mm from the origin"
    side = round(quarter) % 4
    return _SIDES[side].format((offset_mm if side < 2 else -offset_mm) + 0.0)


def _shades_in_words(where: str, inside: float, outside: float) -> str:
    return f"{_shade_in_words(inside)} {where}, {_shade_in_words(outside)} elsewhere"


def _shade_in_words(albedo: float) -> str:
    if albedo >= 1:
        return "white"
    return "black" if albedo <= 0 else f"grey (albedo {albedo:g})"
