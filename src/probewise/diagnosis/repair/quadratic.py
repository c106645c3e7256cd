"""A quadratic surrogate of a model's predictions about a point, cheap enough to move thousands of samples.

It is fitted at steps of the size of the approximate posterior, so that it interpolates over the relevant region instead
of extrapolating from a point. Negligible changes of the readings are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray, IntArray

_NEGLIGIBLE = 0.02  # noise sds, over all readings together: smaller changes at one step are neglected
_RUNS_AWAY = 1e100  # of a prediction, whose square overflows: it counts as impossible


@dataclass(frozen=True, eq=False)
class QuadraticPredictions:
    """Quadratic predictions at steps `e` from a point: `center` + `change_coefficients(e)` @ `changes`.

    `center` (n_points,) are the predictions at the point; `changes` (n_changes, n_points) are orthonormal. Their
    coefficients are linear in n_terms terms, the steps and products of `pairs` of steps, by `shares` (n_terms,
    n_changes).
    """

    center: FloatArray
    pairs: tuple[IntArray, IntArray]
    shares: FloatArray
    changes: FloatArray

    @classmethod
    def of(cls, predict: Callable[[FloatArray], FloatArray], n_params: int, sd: float) -> QuadraticPredictions:
        """Build the surrogate; it is exact, but for negligible changes, at every step, its reverse, and sums of two.

        Parameters
        ----------
        predict
            The model as a function of steps, (n_samples, n_params) -> (n_samples, n_points); finite at step 0.
        n_params
            Number of parameters, one step each.
        sd
            Noise sd of a reading: changes by less than 0.02 sd over all readings together are neglected.
        """
        first, second = np.triu_indices(n_params)
        apart = first != second
        one = np.eye(n_params)
        y = predict(np.concatenate([np.zeros((1, n_params)), one, -one, one[first[apart]] + one[second[apart]]]))
        y = np.where(np.abs(y) < _RUNS_AWAY, y, np.nan)
        up, down, both = y[1 : n_params + 1] - y[0], y[n_params + 1 : 2 * n_params + 1] - y[0], y[2 * n_params + 1 :]
        # Readings impossible on one side are as on the other; on both, they say nothing.
        up, down = (np.nan_to_num(np.where(np.isnan(a), -b, a)) for a, b in ((up, down), (down, up)))
        squares = np.empty((len(first), y.shape[1]))
        squares[~apart] = 0.5 * (up + down)
        squares[apart] = np.nan_to_num(both - y[0] - up[first[apart]] - up[second[apart]])
        terms = np.concatenate([0.5 * (up - down), squares])
        lengths, axes = np.linalg.eigh(terms @ terms.T)
        kept = lengths > (_NEGLIGIBLE * sd) ** 2
        root = np.sqrt(lengths[kept])
        return cls(y[0], (first, second), axes[:, kept] * root, (axes[:, kept] / root).T @ terms)

    def change_coefficients(self, e: FloatArray) -> FloatArray:
        """Return the coefficient of each change at steps `e`, (n_samples, n_params) -> (n_samples, n_changes)."""
        first, second = self.pairs
        return np.asarray(np.concatenate([e, e[:, first] * e[:, second]], axis=1) @ self.shares)
