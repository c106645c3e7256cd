"""What stands in for a posterior about a point: predictions to second order under the law of the noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.coordinates import FARTHEST
from probewise.diagnosis.joint import log_likelihood_of_whitened
from probewise.diagnosis.noise import NoiseLaw
from probewise.diagnosis.quadratic import Quadratic

__all__ = ["Surrogate"]


@dataclass(frozen=True, eq=False)
class Surrogate:
    """The log density of coordinates z = center + e @ steps, by e, (n_samples, n_params).

    `residual` (n_rows,) and `changes` (n_rows, n_changes) are whitened; under normal noise in the axes of the space
    that they span, where a sum of squares has few terms.
    """

    quadratic: Quadratic
    center: FloatArray
    steps: FloatArray
    law: NoiseLaw
    sd_floor: float
    residual: FloatArray
    changes: FloatArray

    @classmethod
    def of(
        cls,
        quadratic: Quadratic,
        center: FloatArray,
        steps: FloatArray,
        readings: FloatArray,
        law: NoiseLaw,
        sd_floor: float,
    ) -> Self:
        """Set predictions against readings, (n_points,)."""
        residual, changes = law(readings - quadratic.center), law(quadratic.changes.T)
        if law.share == 0:
            _, turned = np.linalg.qr(np.concatenate([changes, residual[:, None]], axis=1))
            residual, changes = turned[:, -1], turned[:, :-1]
        return cls(quadratic, center, steps, law, sd_floor, residual, changes)

    def log_density(self, e: FloatArray) -> FloatArray:
        """Prior and likelihood but for a constant, (n_samples,); minus infinity outside the prior's bounds."""
        z = self.center + e @ self.steps
        whitened = self.residual[:, None] - self.changes @ self.quadratic.amounts(e).T
        height = log_likelihood_of_whitened(self.law, whitened, self.sd_floor) - 0.5 * np.sum(z**2, axis=1)
        return np.where((np.abs(z) < FARTHEST).all(axis=1), height, -np.inf)
