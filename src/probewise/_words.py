"""Words, numbers and units that sentences of every package share."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from types import MappingProxyType

_LEAST_IN_DIGITS = 1e-3  # a smaller mean and sd share a power of ten
_LEAST_WITH_POINT = 1e-7  # a smaller sd has no two digits among eight after the point

UNITS: Mapping[str, str] = MappingProxyType(
    {name: name for name in ("mm", "m", "s", "ms", "h", "rad", "counts", "g", "kg", "ppm", "rpm")}
    | {"mv": "mV", "v": "V", "hz": "Hz", "pa": "Pa", "deg": "°", "c": "°C", "k": "K"}
    | {"percent": "%", "pct": "%"}
)
"""Units by the last part of the name of a column or parameter, such as battery_mv."""


def count_with_noun(n: int, noun: str) -> str:
    """Write a count with its noun, plus "s" unless the count is 1."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def unit_of_name(name: str) -> str:
    """Return the unit at the end of a name, as written: "mm" of x_mm, "°" of turn_deg; "" if there is none."""
    stem, _, suffix = name.rpartition("_")
    return UNITS.get(suffix, "") if stem and not stem.endswith(("_per", "_by")) else ""


def unit_after_number(unit: str) -> str:
    """Return a unit as written after a number: "LEGO units" for "LEGO", "per d" for "1/d", nothing for "1"."""
    if unit in ("", "1", "row"):
        return ""
    return "LEGO units" if unit == "LEGO" else re.sub(r"^1\s*(?:/|per\b)\s*", "per ", unit)


def value_with_sd(mean: float, sd: float, unit: str = "", *, factor: float = 1.0) -> str:
    """Return "mean ± sd unit", both numbers times `factor`, rounded to two significant digits of the sd."""
    mean, sd = factor * mean, factor * sd
    largest = max(abs(mean), sd)
    if sd > 0 and largest < _LEAST_IN_DIGITS:
        power = math.floor(math.log10(largest))
        scale = 10.0**-power
        digits = max(1 - math.floor(math.log10(scale * sd)), 0)
        written = f"({scale * mean:z.{digits}f} ± {scale * sd:.{digits}f})e{power:03d}"
    elif 0 < sd < _LEAST_WITH_POINT and math.isfinite(mean):
        digits = max(math.floor(math.log10(max(abs(mean), sd))) - math.floor(math.log10(sd)) + 2, 2)
        written = f"{mean:z.{digits}g} ± {sd:.2g}"
    elif math.isfinite(sd) and sd > 0:
        digits = min(max(1 - math.floor(math.log10(sd)), 0), 8)
        written = f"{mean:z.{digits}f} ± {sd:.{digits}f}"  # "z": no minus sign on a rounded zero
    else:
        written = f"{mean:.4g}"
    return f"{written} {unit_after_number(unit)}".rstrip()
