"""Array types and common checks of arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any, ParamSpec, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probewise.errors import ParameterError, require

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
P = ParamSpec("P")
T = TypeVar("T")


def own_arithmetic(function: Callable[P, T]) -> Callable[P, T]:
    """Run a public function with floating-point errors as NumPy has them by default, whatever `np.seterr` says.

    Underflow is ignored; what is ignored already stays so, and anything else is a warning, no error. A user's functions
    that it calls run so, too.
    """

    @wraps(function)
    def call(*args: P.args, **named: P.kwargs) -> T:
        kept = {name: "ignore" if way == "ignore" else "warn" for name, way in np.geterr().items()}
        with np.errstate(**{**kept, "under": "ignore"}):  # type: ignore[arg-type]
            return function(*args, **named)

    return call


def logsumexp(values: ArrayLike, axis: int | None = None) -> Any:
    """Return the log of the sum of exponentials over an axis, or over all: the bits of SciPy's, in a tenth of its time.

    The greatest values are summed apart from the others, which keeps the digits that these add.
    """
    values = np.asarray(values, dtype=np.float64)
    most = values.max(axis=axis, keepdims=True)
    at_most = values == most
    n_most = at_most.sum(axis=axis, keepdims=True, dtype=np.float64)
    away = np.where(at_most, -np.inf, values) - np.where(np.isfinite(most), most, 0.0)
    out = np.log1p(np.exp(away).sum(axis=axis, keepdims=True) / n_most) + np.log(n_most) + most
    return out.item() if axis is None else out.squeeze(axis)


def floats(values: ArrayLike, name: str = "values") -> FloatArray:
    """Convert numbers (an array, a list, a column of a table) to an array of floats; a float64 array is not copied.

    None and masked values become NaN. ParameterError, with the argument's `name`, for a text, a date, a complex number,
    a set, a ragged list, or a whole number beyond floats.
    """
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(np.object_), np.nan)
    if type(values) is np.ndarray and values.dtype == np.float64:
        return values
    allowed = "numbers, in an array or a list"
    try:
        array = np.asarray(values)
        texts = array.dtype == np.object_ and any(isinstance(v, str | bytes) for v in array.ravel())
        require(not texts and array.dtype.kind in "biufO", name, values, allowed)
        return array.astype(np.float64)
    except ParameterError:
        raise
    except Exception as error:  # objects may raise anything where a number is wanted
        raise ParameterError(name, values, allowed) from error


def array_or_none(values: ArrayLike) -> NDArray[Any] | None:
    """Return values as an array; None for a ragged list and the like, which `floats` refuses by its name."""
    try:
        return np.asarray(values)
    except Exception:  # objects may raise anything
        return None


def read_only_floats(values: ArrayLike, name: str = "values") -> FloatArray:
    """Copy numbers to a read-only array of floats; ParameterError as of `floats`."""
    array = np.array(floats(values, name))
    array.flags.writeable = False
    return array


def frozen_int(values: ArrayLike, name: str = "values") -> IntArray:
    """Copy whole numbers to a read-only array of integers; ParameterError for any others."""
    numbers = array_or_none(values)
    if numbers is None or numbers.dtype.kind not in "iu":
        numbers = floats(values, name)
        whole = (np.abs(numbers) < 2**53) & (numbers == np.floor(numbers))
        require(whole.all(), name, values, "whole numbers")
    array = np.array(numbers, dtype=np.int64)
    array.flags.writeable = False
    return array


ROUNDING = 1e-9
"""Share of a quantity up to which another one differs from it by rounding, of whole models too."""

LAST_DIGITS = 1e-12
"""The same of a few operations."""

TINY = 1e-300
"""Least divisor, whose square root is a number: what it divides is 0 with it."""


MOST_NUMBERS = 2_000_000
"""Numbers of an array that are held in memory at once."""


def rounding_error(values: FloatArray, axis: int | None = None) -> FloatArray:
    """Return the difference up to which values are taken for equal, since they are the results of arithmetic.

    It is 1e-12 of the range of the finite ones, or a few steps of the floating-point grid where they lie far from 0; of
    all values, or of those along `axis`, which is kept with length 1.
    """
    finite, kept = np.isfinite(values), axis is not None
    high = np.max(values, axis=axis, keepdims=kept, initial=-np.inf, where=finite)
    low = np.min(values, axis=axis, keepdims=kept, initial=np.inf, where=finite)
    largest = np.max(np.abs(values), axis=axis, keepdims=kept, initial=0.0, where=finite)
    return np.asarray(np.maximum(LAST_DIGITS * (high - low), 4 * np.spacing(largest)))


def distinct_values(values: FloatArray, within: float | None = None) -> FloatArray:
    """Return the distinct finite values, sorted, (n_distinct,); of those within `within` of each other, the least.

    By default these are the values that differ by no more than the rounding error of arithmetic, as places of a forward
    and a backward scan do.
    """
    ordered = np.unique(values[np.isfinite(values)])
    apart = float(rounding_error(ordered)) if within is None else within
    return np.asarray(ordered[np.diff(ordered, prepend=-np.inf) > apart])


def varies(values: FloatArray) -> bool:
    """Return whether finite values differ by more than the rounding error of arithmetic."""
    finite = values[np.isfinite(values)]
    return finite.size > 1 and float(np.ptp(finite)) > float(rounding_error(finite))


def require_finite(name: str, values: FloatArray) -> None:
    """Raise ParameterError if a value is not finite; the message gives index and value of the first."""
    bad = ~np.isfinite(values)
    if bad.any():
        at = int(np.flatnonzero(bad.ravel())[0])
        raise ParameterError(f"{name}[{at}]", float(values.ravel()[at]), "finite numbers")


def nearly_equal(first: FloatArray, second: FloatArray) -> bool:
    """Return whether two ways of calling a function give the same readings, up to rounding."""
    if first.shape != second.shape or not np.array_equal(np.isfinite(first), np.isfinite(second)):
        return False
    one, other = (values[np.isfinite(first)] for values in (first, second))
    return np.allclose(one, other, rtol=ROUNDING, atol=ROUNDING * float(np.abs(other).max(initial=0.0)))


def data_frame(columns: Mapping[str, Any]) -> Any:
    """Return columns by name as a pandas DataFrame; ParameterError without pandas."""
    try:
        import pandas  # type: ignore[import-untyped,import-not-found,unused-ignore]  # where it is there
    except ImportError as error:
        raise ParameterError("to_frame", "no pandas", "an environment with it: pip install pandas") from error
    return pandas.DataFrame(dict(columns))
