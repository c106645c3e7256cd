"""The naive likelihood: the sensor reads one level over black, another over white (paper, "The Naive Likelihood").

The paper prints (2 pi sigma)^(-1/2) and a positive exponent; a normal density has
(2 pi sigma^2)^(-1/2) and a negative one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from probewise._arrays import FloatArray, floats
from probewise._kinds import checked_number
from probewise.effects.noise_distribution import log_gaussian_density
from probewise.errors import ParameterError
from probewise.inference._residuals import residuals


@dataclass(frozen=True)
class Naive:
    """Likelihood of a sensor with two levels, each with Gaussian noise of its own sd (paper, "The Naive Likelihood").

    Parameters
    ----------
    mu_black, sd_black, mu_white, sd_white
        Mean and sd of readings over black and over white, in units of the reading; the means differ, else
        ParameterError.
    """

    mu_black: float
    sd_black: float
    mu_white: float
    sd_white: float

    def __post_init__(self) -> None:
        for name in ("mu_black", "sd_black", "mu_white", "sd_white"):
            checked_number(name, getattr(self, name))
        for name in ("sd_black", "sd_white"):
            if not 0 < getattr(self, name) < math.inf:
                raise ParameterError(name, getattr(self, name), "greater than 0, finite")
        if not (math.isfinite(self.mu_black) and math.isfinite(self.mu_white)) or self.mu_black == self.mu_white:
            raise ParameterError("(mu_black, mu_white)", (self.mu_black, self.mu_white), "finite and different")

    @classmethod
    def estimated(cls, black: ArrayLike, white: ArrayLike, *, sd_floor: float) -> Naive:
        """Build from readings over known black and known white, two or more of each: their means and sds.

        `sd_floor`, for instance `step / sqrt(12)`, is the least sd, for readings that are all equal. ParameterError if
        readings are too few or not finite.
        """
        values: list[float] = []
        for name, readings in (("black", black), ("white", white)):
            array = np.asarray(readings, dtype=np.float64).ravel()
            if array.size < 2 or not np.isfinite(array).all():
                raise ParameterError(name, array.tolist(), "two or more finite readings")
            values += [float(array.mean()), max(float(array.std(ddof=1)), sd_floor)]
        return cls(*values)

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return the log likelihood of readings, (n_points,), given predictions, (n_samples, n_points): (n_samples,).

        A prediction counts as white where it is nearer to `mu_white` than to `mu_black`.
        """
        readings, predicted = floats(readings, "readings"), floats(predicted, "predicted")
        residuals(readings, predicted)
        middle, sign = 0.5 * (self.mu_black + self.mu_white), 1.0 if self.mu_white > self.mu_black else -1.0
        black = log_gaussian_density(readings, self.mu_black, self.sd_black)
        white = log_gaussian_density(readings, self.mu_white, self.sd_white)
        over_white = (predicted - middle) * sign > 0
        return np.asarray(over_white @ (white - black) + black.sum())
