"""Formatting of numbers, units and counts for reports."""

from __future__ import annotations

import math
import re

from probewise._words import count_with_noun, unit_of_name, value_with_sd

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number_text(value: float, digits: int) -> str:
    """Write a number with fixed decimals, a true minus sign, none before zero; a dash if it is not finite."""
    return f"{value:z.{digits}f}".replace("-", "−") if math.isfinite(value) else "–"


def decimals_to_show(value: float, least: int) -> int:
    """Return the number of decimals that show two significant digits of a value; `least` or more."""
    if not (math.isfinite(value) and value):
        return least
    return max(least, 1 - math.floor(math.log10(abs(value))))


def value_with_error(value: float, error: float, unit: str = "") -> str:
    """Write a value with its error as `value_with_sd` does, typeset; a dash if the value is not finite."""
    return typeset_numbers(value_with_sd(value, error, unit)) if math.isfinite(value) else "–"


def digits_of_range(low: float, high: float, least: int) -> int:
    """Return the significant digits that show both ends to the second digit of their distance; `least` or more."""
    width, largest = high - low, max(abs(low), abs(high))
    if not 0 < width < math.inf:
        return least
    return min(max(math.floor(math.log10(largest)) - math.floor(math.log10(width)) + 2, least), 15)


def range_text(low: float, high: float, scale: float = 0.0) -> str:
    """Write the ends of a range to four significant digits, or as many as tell them apart; one number if equal.

    Ends within a thousandth of `scale`, the spread of all values, are equal.
    """
    if high - low <= max(1e-3 * scale, 1e-12 * max(abs(low), abs(high))):
        return f"{low:.{digits_of_range(low, low + 0.01 * scale, 4)}g}"
    digits = digits_of_range(low, high, 4)
    return f"{low:.{digits}g} to {high:.{digits}g}"


def value_and_interval_texts(value: float, low: float, high: float) -> tuple[str, str]:
    """Return texts of a value and of its interval, to the third significant digit of the interval's width."""
    digits = digits_of_range(low, high, 3)
    value_text, *ends = (typeset_numbers(f"{number:.{digits}g}") for number in (value, low, high))
    return value_text, " to ".join(ends)


def words_without_unit(name: str) -> str:
    """Write a parameter's name without its unit, spaces for underscores and dots."""
    stem = name.rpartition("_")[0] if unit_of_name(name) else name
    return stem.replace("_", " ").replace(".", " ")


def typeset_numbers(text: str) -> str:
    """Typeset the numbers in a text: 2 × 10⁻⁷ for 2e-07, true minus signs, no line break within "p = 0.2"."""

    def power_of_ten(found: re.Match[str]) -> str:
        return f"{found[1]}\u00a0×\u00a010{str(int(found[2])).translate(_RAISED)}"

    together = re.sub(r"\bp ([=<]) (?=\d)", "p\u00a0\\1\u00a0", text)
    return re.sub(r"(?<![\w.])-(?=\d)", "−", re.sub(r"([\d)])e([+-]\d+)", power_of_ten, together))


_MINUTES = {"minute": 1.0, "hour": 60.0, "day": 1440.0, "month": 43_830.0, "year": 525_960.0}
_LEAST_OF_A_UNIT = 3  # of the next larger unit, from which durations are written in it


def duration_text(minutes: float) -> str:
    """Write a duration in the largest unit, from minutes to years, of which it has three or more; at least a minute."""
    noun = [unit for unit, length in _MINUTES.items() if unit == "minute" or minutes >= _LEAST_OF_A_UNIT * length][-1]
    return count_with_noun(max(round(minutes / _MINUTES[noun]), 1), noun)


def probability_text(p: float) -> str:
    """Write a probability with three decimals; as a bound, "< 0.001" or "> 0.999", near 0 and 1."""
    if p < 0.001:
        return "< 0.001"
    return "> 0.999" if p > 0.999 else f"{p:.3f}"
