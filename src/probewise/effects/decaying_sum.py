"""The recursion of what keeps a part of what came before: lags, overshoots."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray


def decaying_sum(added: FloatArray, kept: FloatArray, *, longest: int) -> FloatArray:
    """Return s with s_k = kept_k s_(k-1) + added_k, (n_samples, n_points); no sum reaches over `longest` points.

    Each s_k is an affine map of the one before. A parallel prefix scan composes the maps in pairs, then pairs of
    pairs, until each map starts at the beginning of its sum.
    """
    held, carry = np.broadcast_arrays(added, kept)
    held, carry, reach = held.copy(), carry.copy(), 1
    while reach < longest:
        held[:, reach:] = held[:, reach:] + carry[:, reach:] * held[:, :-reach]
        carry[:, reach:] = carry[:, reach:] * carry[:, :-reach]
        reach *= 2
    return held
