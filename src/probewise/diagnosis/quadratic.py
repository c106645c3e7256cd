"""A model's predictions about a point, to second order: what stands in for it where thousands of samples move.

The steps by which it is laid out are those of the posterior's approximation, so that it is an interpolation over the
region that matters, not an extrapolation from a point. Changes of the readings that make no difference are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray, IntArray

__all__ = ["Quadratic"]

_NEGLIGIBLE = 0.02  # noise sd, over all readings together: less of a change at one step is none


@dataclass(frozen=True, eq=False)
class Quadratic:
    """Second-order predictions of the usable readings.

    `inverse` (n_params, n_params) turns a move from `center` into steps; `predicted` (n_points,) are the predictions
    there; products of steps, one and by pairs, times `amounts` (n_terms, n_changes) are amounts of the orthonormal
    `changes` (n_changes, n_points).
    """

    center: FloatArray
    inverse: FloatArray
    pairs: tuple[IntArray, IntArray]
    predicted: FloatArray
    amounts: FloatArray
    changes: FloatArray

    @classmethod
    def of(
        cls, predict: Callable[[FloatArray], FloatArray], center: FloatArray, steps: FloatArray, sd: float
    ) -> Quadratic:
        """Lay out.

        Parameters
        ----------
        predict
            The model, (n_samples, n_params) -> (n_samples, n_points).
        center
            About which, (n_params,).
        steps
            One a row, (n_params, n_params); it is exact at each, back and forth, and at the sum of any two.
        sd
            Noise of a reading.
        """
        p = len(center)
        first, second = np.triu_indices(p)
        apart = first != second
        z = np.concatenate([np.zeros((1, p)), steps, -steps, steps[first[apart]] + steps[second[apart]]])
        y = predict(center + z)
        here, up, down, both = y[0], y[1 : p + 1] - y[0], y[p + 1 : 2 * p + 1] - y[0], y[2 * p + 1 :] - y[0]
        terms = np.empty((len(first), y.shape[1]))
        terms[~apart] = 0.5 * (up + down)
        terms[apart] = both - up[first[apart]] - up[second[apart]]
        terms = np.concatenate([0.5 * (up - down), terms])
        squares, axes = np.linalg.eigh(terms @ terms.T)
        kept = squares > (_NEGLIGIBLE * sd) ** 2
        lengths = np.sqrt(squares[kept])
        inverse = np.asarray(np.linalg.inv(steps), dtype=np.float64)
        amounts, changes = axes[:, kept] * lengths, (axes[:, kept] / lengths).T @ terms
        return cls(center, inverse, (first, second), here, amounts, changes)

    def __call__(self, z: FloatArray) -> FloatArray:
        """Predict the usable readings, (n_samples, n_params) -> (n_samples, n_points)."""
        e = (z - self.center) @ self.inverse
        first, second = self.pairs
        products = np.concatenate([e, e[:, first] * e[:, second]], axis=1)
        return np.asarray(self.predicted + (products @ self.amounts) @ self.changes)
