"""Numbers as people read them."""

from __future__ import annotations

import math
import re

__all__ = ["count", "number", "probability", "readable", "signed", "unit_name"]

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float, digits: int) -> str:
    """Write with a fixed number of decimals and a true minus sign; a dash where there is no number."""
    return f"{value:.{digits}f}".replace("-", "−") if math.isfinite(value) else "–"


def signed(value: float, digits: int) -> str:
    """Write a coordinate; what rounds to zero has no sign."""
    return number(value if abs(value) >= 0.5 * 10**-digits else 0.0, digits)


def readable(text: str) -> str:
    """Write the numbers of a text as people do: 2 × 10⁻⁷ for 2e-07, a true minus sign, "p = 0.2" on one line."""

    def power(found: re.Match[str]) -> str:
        return f"{found[1]}\u00a0×\u00a010{str(int(found[2])).translate(_RAISED)}"

    together = re.sub(r"\bp ([=<]) (?=\d)", "p\u00a0\\1\u00a0", text)
    return re.sub(r"(?<![\w.])-(?=\d)", "−", re.sub(r"(\d)e([+-]\d+)", power, together))


def count(n: int, noun: str) -> str:
    """Write a count with its noun, plural where it must be."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def unit_name(unit: str) -> str:
    """Name a unit behind a number: the LEGO brick's are "LEGO units", every other stands for itself."""
    return "LEGO units" if unit == "LEGO" else unit


def probability(p: float) -> str:
    """Write a probability; near 0 and 1 say so rather than round to them."""
    if p < 0.001:
        return "< 0.001"
    return "> 0.999" if p > 0.999 else f"{p:.3f}"
