"""The likelihood of independent Gaussian noise of known sd."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from probewise._arrays import FloatArray, floats, read_only_floats
from probewise.errors import ParameterError, ShapeError
from probewise.inference._residuals import residuals

_LOG_2PI = math.log(2 * math.pi)


@dataclass(frozen=True, eq=False)
class GaussianKnown:
    """Likelihood of independent Gaussian noise of known sd.

    Parameters
    ----------
    sd
        In units of the reading: a number, or one for each reading, (n_points,); ParameterError if not above 0.
    """

    sd: ArrayLike

    def __post_init__(self) -> None:
        sd = read_only_floats(self.sd, "sd")
        if sd.ndim > 1:
            raise ShapeError(f"sd has shape {sd.shape}; allowed: a number or (n_points,)")
        if not ((sd > 0) & np.isfinite(sd)).all():
            raise ParameterError("sd", sd.tolist(), "greater than 0, finite")
        object.__setattr__(self, "sd", sd)

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return the log likelihood of readings, (n_points,), given predictions, (n_samples, n_points): (n_samples,).

        All constants are included.
        """
        readings, predicted = floats(readings, "readings"), floats(predicted, "predicted")
        sd = np.asarray(self.sd)
        if sd.ndim == 1 and sd.size != readings.size:
            raise ShapeError(
                f"sd has {sd.size} values for {readings.size} readings; allowed: one per reading, or one number"
            )
        z = residuals(readings, predicted) / sd
        constant = 0.5 * readings.size * _LOG_2PI + float(np.broadcast_to(np.log(sd), readings.shape).sum())
        return np.asarray(-0.5 * np.einsum("ij,ij->i", z, z) - constant)
