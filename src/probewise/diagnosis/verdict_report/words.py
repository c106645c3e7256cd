"""Formatting of numbers and units in a diagnosis."""

from __future__ import annotations

_LEAST_P = 1e-300  # smallest p-value that floating point represents reliably


def p_in_words(p_value: float) -> str:
    """Write a p-value as "p = ..."; one below 1e-300 as "p < 1e-300"."""
    return f"p = {p_value:.2g}" if p_value >= _LEAST_P else f"p < {_LEAST_P:g}"


def substitute_reading_unit(own: str, unit: str) -> str:
    """Return a parameter's unit `own` with the reading's `unit` in place of a leading "reading"."""
    return own.replace("reading", unit or "reading") if own.startswith("reading") else own
