"""Array types and the two checks every value makes of its arrays."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probewise.errors import ParameterError

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]


def frozen(values: ArrayLike) -> FloatArray:
    """Copy to a read-only array of floats, so that an immutable value really is one."""
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array


def frozen_int(values: ArrayLike) -> IntArray:
    """Copy to a read-only array of integers."""
    array = np.array(values, dtype=np.int64)
    array.flags.writeable = False
    return array


def require_finite(name: str, values: FloatArray) -> None:
    """Raise ParameterError naming the first value that is not finite."""
    bad = ~np.isfinite(values)
    if bad.any():
        at = int(np.flatnonzero(bad.ravel())[0])
        raise ParameterError(f"{name}[{at}]", float(values.ravel()[at]), "finite numbers")
