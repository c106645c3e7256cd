"""A surrogate of a posterior about a point: quadratic predictions under the noise model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.hypothesis_problem import log_likelihood_marginal_over_sigma
from probewise.diagnosis.fitting.coordinates import FARTHEST
from probewise.diagnosis.noise.law import NoiseLaw
from probewise.diagnosis.repair.quadratic import QuadraticPredictions


@dataclass(frozen=True, eq=False)
class SurrogatePosterior:
    """An approximate posterior of coordinates z = center + e @ steps, as a function of e, (n_samples, n_params).

    The noise is normal: for heavy-tailed noise, residuals are replaced by pseudo-residuals. `residual` (n_axes,), at
    the center, and `changes` (n_axes, n_changes) are whitened, in orthonormal axes of the space that they span: n_axes
    is n_changes + 1, or n_usable if that is less.
    """

    quadratic: QuadraticPredictions
    center: FloatArray
    steps: FloatArray
    law: NoiseLaw
    residual: FloatArray
    changes: FloatArray

    @classmethod
    def of(
        cls,
        quadratic: QuadraticPredictions,
        center: FloatArray,
        steps: FloatArray,
        readings: FloatArray,
        law: NoiseLaw,
    ) -> Self:
        """Build from quadratic predictions at steps from `center`, the readings (n_usable,), and their noise."""
        residual = law(readings - quadratic.center)[:, None]
        residual = law.normal_pseudo_residuals(residual, np.maximum(law.likeliest_sigma(residual), 1e-150))
        _, turned = np.linalg.qr(np.concatenate([law(quadratic.changes.T), residual], axis=1))
        normal = law.without_tail_or_rounding()
        return cls(quadratic, center, steps, normal, turned[:, -1], turned[:, :-1])

    def log_density(self, e: FloatArray) -> FloatArray:
        """Return the unnormalised log posterior at steps e, (n_samples,); minus infinity beyond six prior sds."""
        z = self.center + e @ self.steps
        whitened = self.residual[:, None] - self.changes @ self.quadratic.change_coefficients(e).T
        height = log_likelihood_marginal_over_sigma(self.law, whitened) - 0.5 * np.sum(z**2, axis=1)
        return np.where((np.abs(z) < FARTHEST).all(axis=1), height, -np.inf)
