"""What weighted samples are worth, and equally weighted ones from them."""

from __future__ import annotations

import math

import numpy as np

from probewise._arrays import FloatArray, IntArray

__all__ = ["n_effective", "resampled"]


def n_effective(log_weight: FloatArray) -> float:
    """Kish's effective number of samples, of weights that need not be normalised, (n,); 0 where all are zero."""
    most = float(np.max(log_weight))
    if not math.isfinite(most):
        return 0.0
    weight = np.exp(log_weight - most)
    return float(weight.sum() ** 2 / (weight @ weight))


def resampled(weight: FloatArray, n: int, rng: np.random.Generator) -> IntArray:
    """Draw rows by weight, (n_weights,) -> (n,), systematically: each as often as its share of n, up or down."""
    ladder = np.cumsum(weight)
    rows = np.searchsorted(ladder / ladder[-1], (np.arange(n) + rng.random()) / n, side="right")
    return np.asarray(np.minimum(rows, len(ladder) - 1))
