"""The normal cumulative distribution, fast enough to be called a billion times."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from probewise._arrays import FloatArray

__all__ = ["normal_cdf"]

_STEPS = 512  # table entries per standard deviation
_LIMIT = 8.5  # beyond it the cumulative is 0 or 1 within 1e-17
_NODES = np.arange(-_LIMIT, _LIMIT + 0.5 / _STEPS, 1 / _STEPS)
_CUMULATIVE = np.asarray(ndtr(_NODES))
_DENSITY = np.exp(-0.5 * _NODES**2) / np.sqrt(2 * np.pi)
_BLOCK = 16384  # elements that stay in the cache with the table


def normal_cdf(z: FloatArray, *, out: FloatArray | None = None) -> FloatArray:
    """Cumulative of the standard normal, any shape, within 1e-10.

    Taylor's series to second order about the nearest entry of a table: the third-order term is
    at most 0.4 (h/2)^3 / 6 = 6e-11. Large arrays are taken in blocks that fit the cache. The
    result goes into `out`, which may be `z` itself and must be contiguous.
    """
    z = np.asarray(z, dtype=np.float64)
    if z.size < 1000:  # the calls cost more than the function
        return np.asarray(ndtr(z, out=out))
    if out is None:
        out = np.empty(z.shape)
    flat_in, flat_out = z.reshape(-1), out.reshape(-1)
    length = min(_BLOCK, z.size)
    entries, steps, sums = np.empty(length, dtype=np.intp), np.empty(length), np.empty(length)
    for start in range(0, z.size, length):
        n = min(length, z.size - start)
        entry, step, total = entries[:n], steps[:n], sums[:n]
        np.minimum(flat_in[start : start + n], _LIMIT, out=step)
        np.maximum(step, -_LIMIT, out=step)
        np.multiply(step, _STEPS, out=total)
        total += _LIMIT * _STEPS + 0.5
        entry[:] = total
        np.multiply(entry, 1 / _STEPS, out=total)
        total -= _LIMIT
        step -= total
        # Phi(z0 + d) = Phi(z0) + phi(z0) d (1 - z0 d / 2)
        total *= step
        total *= -0.5
        total += 1.0
        total *= step
        _DENSITY.take(entry, out=step, mode="clip")  # "clip" spares the check of bounds
        total *= step
        _CUMULATIVE.take(entry, out=step, mode="clip")
        np.add(total, step, out=flat_out[start : start + n])
    return out
