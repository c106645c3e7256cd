"""Checks of arguments, with messages that say what is allowed; `name` is the argument's name in the message."""

from __future__ import annotations

import inspect
import math
import os
import re
import sys
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray

from probewise.errors import ParameterError, UnitWarning, did_you_mean, require, warn

_FULL_TURN_RAD = math.tau * (1 + 1e-9)
_MOST = 10_000_000  # of anything that is counted: more fill the memory
_CONTROL = re.compile("[\\x00-\\x1f\\x7f\\ud800-\\udfff]")  # and lone surrogates: no font has them, and no file
_MOST_LISTED = 250  # characters of names, so that what was perhaps meant is not cut off


def require_rng(rng: object) -> None:
    """Raise ParameterError unless `rng` is a NumPy generator; the message shows how to make one from a seed."""
    if isinstance(rng, np.random.Generator):
        return
    seed = int(rng) if isinstance(rng, Integral) and not isinstance(rng, bool) and int(rng) >= 0 else 0
    raise ParameterError("rng", rng, f"a NumPy random generator: np.random.default_rng({seed})")


def checked_number(name: str, value: object, allowed: str = "a number") -> float:
    """Return a real number (NaN and infinity included) as a float; raise ParameterError for anything else."""
    if isinstance(value, Real) or (isinstance(value, np.ndarray) and value.ndim == 0 and value.dtype.kind in "iuf"):
        try:
            return float(value)
        except OverflowError:
            raise ParameterError(name, value, f"{allowed}, within the range of floats") from None
    raise ParameterError(name, value, allowed)


def checked_finite_number(name: str, value: object, allowed: str = "a finite number") -> float:
    """Return a finite real number as a float, or raise ParameterError."""
    number = checked_number(name, value, allowed)
    require(math.isfinite(number), name, value, allowed)
    return number


def checked_whole(name: str, value: object, *, least: int | None = 1, most: int | None = _MOST) -> int:
    """Return a whole number from `least` to `most` (None: any) as an int; raise ParameterError for anything else."""
    if isinstance(value, Integral) and not isinstance(value, bool):
        number = int(value)
        if (least is None or number >= least) and (most is None or number <= most):
            return number
    bounds = ("" if least is None else f", {least} or more") + ("" if most is None else f", up to {most:,}")
    raise ParameterError(name, value, f"a whole number{bounds}")


def checked_pair(name: str, value: object, allowed: str = "two finite numbers (x, y)") -> tuple[float, float]:
    """Return two finite numbers as a tuple of floats, or raise ParameterError."""
    if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str | bytes) and len(value) == 2:
        first, second = value
        if _is_finite_real(first) and _is_finite_real(second):
            return float(first), float(second)
    raise ParameterError(name, value, allowed)


def checked_one_or_several_numbers(name: str, value: object) -> tuple[float, ...]:
    """Return a finite number, or several in a list or array, as a tuple; raise ParameterError for anything else."""
    if isinstance(value, Real):
        value = (value,)
    array_like = isinstance(value, Sequence | np.ndarray | range) and not isinstance(value, str | bytes)
    if not array_like or getattr(value, "ndim", 1) == 0 or not all(_is_finite_real(v) for v in value):  # type: ignore[attr-defined]
        raise ParameterError(name, value, "a number, or several in a list")
    return tuple(v.item() if isinstance(v, np.generic) else v for v in value)  # type: ignore[attr-defined]


def _is_finite_real(value: object) -> TypeGuard[float]:
    """Return whether a value is a real number within the range of floats, which whole numbers may leave."""
    return isinstance(value, Real) and bool(abs(value) <= sys.float_info.max)  # type: ignore[operator]


def require_one_of(name: str, value: object, known: Sequence[str]) -> None:
    """Raise ParameterError unless `value` is one of the names `known`; the message suggests the nearest."""
    if isinstance(value, str) and value in known:
        return
    listed = ", ".join(map(repr, known))
    if len(listed) > _MOST_LISTED:
        listed = f"{listed[:_MOST_LISTED]} ... ({len(known)} names)"
    raise ParameterError(name, value, listed + did_you_mean(value, known))


def warn_of_likely_degrees(name: str, values: float | NDArray[np.float64]) -> None:
    """Warn (UnitWarning) if an angle in radians is beyond a full turn either way: somebody may have given degrees."""
    widest = abs(values) if isinstance(values, float) else float(np.abs(values).max(initial=0.0))
    if _FULL_TURN_RAD < widest < math.inf:
        said = f"{name} reaches {widest:.6g} rad, beyond a full turn (6.283 rad): convert degrees with numpy.radians"
        warn(said, UnitWarning)


def require_flag(name: str, value: object) -> None:
    """Raise ParameterError unless `value` is True or False; a text such as "no" is refused too."""
    require_kind(name, value, (bool, np.bool_), "True or False")


def checked_path(name: str, value: object, allowed: str = "the name of a file: a text or a Path") -> Path:
    """Return the name of a file, a text or Path, as a Path; raise ParameterError for anything else."""
    if isinstance(value, os.PathLike) or (isinstance(value, str) and value):
        named = os.fspath(value)
        if isinstance(named, str) and "\0" not in named:
            return Path(named)
    raise ParameterError(name, value, allowed)


def require_kind(name: str, value: object, kind: type | tuple[type, ...], allowed: str) -> None:
    """Raise ParameterError, which says what is `allowed`, unless `value` is an instance of `kind`."""
    if not isinstance(value, kind):
        method = getattr(value, "__name__", "") if hasattr(value, "__self__") else ""
        call = f"this is the method {method}, call it: {method}(); " if method else ""
        raise ParameterError(name, value, call + allowed)


def require_like(name: str, value: object, attributes: Sequence[str], allowed: str) -> None:
    """Raise ParameterError unless `value` has these attributes; a class in place of its instance is refused too."""
    if isinstance(value, type):
        raise ParameterError(name, value, f"{allowed}; this is the class, a value of it is {value.__name__}(...)")
    for attribute in attributes:
        require(hasattr(value, attribute), name, value, allowed)


def require_callable(name: str, value: object, allowed: str) -> None:
    """Raise ParameterError unless `value` can be called."""
    require(callable(value), name, value, allowed)


def require_accepts(name: str, value: object, allowed: str, *arguments: None, **named: None) -> None:
    """Raise ParameterError unless `value` can be called so; a function without a readable signature passes."""
    require_callable(name, value, allowed)
    try:
        inspect.signature(value).bind(*arguments, **named)  # type: ignore[arg-type]
    except TypeError:
        raise ParameterError(name, value, allowed) from None
    except ValueError:  # a function written in C may not tell what it takes
        return


def require_progress(value: object, allowed: str = "a function") -> None:
    """Raise ParameterError unless `value` can be called as a `Progress`: stage, done, total, note."""
    names = dict.fromkeys(("stage", "done", "total", "note"))
    require_accepts("progress", value, f"{allowed} progress({', '.join(names)})", **names)


def checked_text(name: str, value: object, allowed: str = "a text") -> str:
    """Return a text that is not empty, or raise ParameterError."""
    if isinstance(value, str) and value:
        return str(value)
    raise ParameterError(name, value, allowed)


def require_text(name: str, value: object, allowed: str = "a text") -> None:
    """Raise ParameterError unless `value` is a text, which may be empty, without control characters."""
    require(isinstance(value, str) and not _CONTROL.search(value), name, value, f"{allowed}, no control characters")


def checked_texts(name: str, value: object, allowed: str) -> tuple[str, ...]:
    """Return several texts, none empty, as a tuple; raise ParameterError for anything else, also for a single text.

    Those of a set are sorted: its order differs from one process to the next.
    """
    several = isinstance(value, Sequence | set | frozenset | np.ndarray | Mapping) and getattr(value, "ndim", 1) > 0
    if isinstance(value, str) or not several:
        example = f": [{value!r}]" if isinstance(value, str) else ""
        raise ParameterError(name, value, f"{allowed}, in a list{example}")
    texts = tuple(checked_text(name, each, allowed) for each in value)  # type: ignore[attr-defined]
    return tuple(sorted(texts)) if isinstance(value, set | frozenset) else texts


def require_mapping(name: str, value: object, allowed: str) -> None:
    """Raise ParameterError unless `value` is a dict or the like whose keys are texts, none empty."""
    require_kind(name, value, Mapping, allowed)
    assert isinstance(value, Mapping)
    for each in value:
        require_text(f"a name in {name}", checked_text(f"a name in {name}", each))
