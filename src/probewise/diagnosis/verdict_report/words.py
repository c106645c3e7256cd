"""Numbers and units as a diagnosis says them."""

from __future__ import annotations

__all__ = ["p_in_words", "unit_in_words"]

_LEAST_P = 1e-300  # below it a p-value is no more than the end of what a number can hold


def p_in_words(p_value: float) -> str:
    """Write a p-value; none is nothing."""
    return f"p = {p_value:.2g}" if p_value >= _LEAST_P else f"p < {_LEAST_P:g}"


def unit_in_words(own: str, unit: str) -> str:
    """Write a parameter's unit with the reading's own for "reading"."""
    return own.replace("reading", unit or "reading") if own.startswith("reading") else own
