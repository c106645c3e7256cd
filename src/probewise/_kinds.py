"""Refuse values of the wrong kind in words, where they are made, and not as a TypeError three calls further down."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real

import numpy as np

from probewise.errors import ParameterError

__all__ = [
    "require_callable",
    "require_finite_number",
    "require_kind",
    "require_like",
    "require_number",
    "require_pair",
    "require_rng",
    "require_whole",
]


def require_rng(rng: object, name: str = "rng") -> None:
    """Raise ParameterError unless `rng` is a NumPy generator; a seed is the usual mistake."""
    if isinstance(rng, np.random.Generator):
        return
    seed = int(rng) if isinstance(rng, Integral) and not isinstance(rng, bool) and int(rng) >= 0 else 0
    raise ParameterError(name, rng, f"a NumPy random generator: np.random.default_rng({seed})")


def require_number(name: str, value: object, allowed: str = "a number") -> float:
    """Return a real number as a float; raise ParameterError for a text, a list, None, an array of several."""
    if isinstance(value, Real) or (isinstance(value, np.ndarray) and value.ndim == 0 and value.dtype.kind in "iuf"):
        return float(value)
    raise ParameterError(name, value, allowed)


def require_finite_number(name: str, value: object, allowed: str = "a finite number") -> float:
    """Return a finite real number as a float, or raise ParameterError."""
    number = require_number(name, value, allowed)
    if not math.isfinite(number):
        raise ParameterError(name, value, allowed)
    return number


def require_whole(name: str, value: object, *, least: int | None = 1) -> int:
    """Return a whole number, of at least `least` where that is given, as an int, or raise ParameterError."""
    if isinstance(value, Integral) and not isinstance(value, bool) and (least is None or int(value) >= least):
        return int(value)
    raise ParameterError(name, value, "a whole number" + ("" if least is None else f", {least} or more"))


def require_pair(name: str, value: object, allowed: str = "two finite numbers (x, y)") -> tuple[float, float]:
    """Return two finite numbers as a tuple of floats, or raise ParameterError."""
    if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str | bytes) and len(value) == 2:
        first, second = value
        if all(isinstance(v, Real) and math.isfinite(v) for v in (first, second)):
            return float(first), float(second)
    raise ParameterError(name, value, allowed)


def require_kind(name: str, value: object, kind: type | tuple[type, ...], allowed: str) -> None:
    """Raise ParameterError unless `value` is an instance of `kind`."""
    if not isinstance(value, kind):
        raise ParameterError(name, value, allowed)


def require_like(name: str, value: object, attributes: Sequence[str], allowed: str) -> None:
    """Raise ParameterError unless `value` has these attributes and is no class itself (`Circle` for `Circle()`)."""
    if isinstance(value, type):
        raise ParameterError(name, value, f"{allowed}; this is the class, a value of it is {value.__name__}(...)")
    for attribute in attributes:
        if not hasattr(value, attribute):
            raise ParameterError(name, value, allowed)


def require_callable(name: str, value: object, allowed: str) -> None:
    """Raise ParameterError unless `value` can be called."""
    if not callable(value):
        raise ParameterError(name, value, allowed)
