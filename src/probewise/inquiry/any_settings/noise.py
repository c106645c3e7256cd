"""The noise of a reading: Gaussian or heavy-tailed, of known or unknown sd, with outliers or without."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from scipy.special import gammaln, ndtr, ndtri, stdtr, stdtrit

from probewise._arrays import FloatArray
from probewise._kinds import checked_number
from probewise.errors import ParameterError, ShapeError
from probewise.priors import Marginal

AnyNoise: TypeAlias = "float | Callable[[FloatArray], Any] | Marginal | ReadingNoise"

_ALLOWED_SD = (
    "a number greater than 0, a function of the predicted reading, or, where it is unknown, its prior, such as "
    "LogUniform(0.1, 10.0)"
)
_LOG_2PI = math.log(2 * math.pi)
_OUTERMOST = 0.01  # of the outliers' range, at each end: a tail is not smaller
_N_GAUSSIAN, _N_HEAVY = 7, 16  # nodes of the quadrature over the noise


@dataclass(frozen=True)
class ReadingNoise:
    """Noise of independent readings.

    Parameters
    ----------
    sd
        Sd of the noise, in the unit of the reading (of a Student-t distribution: its scale): a number; a function that
        returns the sd for each of an array of predicted readings; or a prior, where it is unknown and inferred.
    dof
        Degrees of freedom of a Student-t distribution; infinity is the Gaussian.
    outliers
        Share of the readings that do not depend on the prediction, 0 or more, below 1.
    between
        Least and greatest outlier; they are uniform in between. Required if there are outliers.

    Raises
    ------
    ParameterError
        If a value is out of range.
    """

    sd: float | Callable[[FloatArray], Any] | Marginal
    dof: float = math.inf
    outliers: float = 0.0
    between: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if isinstance(self.sd, type | str | bytes):
            raise ParameterError("noise sd", self.sd, _ALLOWED_SD)
        is_number = not (self.is_sd_inferred or callable(self.sd))
        if is_number and not 0 < checked_number("noise sd", self.sd, _ALLOWED_SD) < math.inf:
            raise ParameterError("noise sd", self.sd, _ALLOWED_SD)
        if self.is_sd_inferred and not np.min(self.sd.from_unit(np.array([1e-9, 0.5]))) > 0:  # type: ignore[union-attr]
            raise ParameterError("noise sd", self.sd, "a prior of numbers greater than 0, such as LogUniform(0.1, 10)")
        if not checked_number("dof", self.dof) > 0:
            raise ParameterError("dof", self.dof, "greater than 0; infinity is the Gaussian")
        if not 0 <= checked_number("outliers", self.outliers) < 1:
            raise ParameterError(
                "outliers", self.outliers, "0 or more, below 1: the share of readings that are outliers"
            )
        if self.outliers and (self.between is None or not _is_range(self.between)):
            allowed = "(low, high), finite, low < high: the least and the greatest outlier"
            raise ParameterError("between", self.between, allowed)

    @classmethod
    def of(cls, given: AnyNoise) -> ReadingNoise:
        """Build the noise from a sd, a function of the prediction, the prior of a sd, or a ReadingNoise."""
        return given if isinstance(given, ReadingNoise) else cls(given)

    @property
    def is_sd_inferred(self) -> bool:
        """Whether the sd is unknown: a parameter with a prior."""
        return isinstance(self.sd, Marginal)

    def scale(self, predicted: FloatArray, sd: FloatArray | None) -> FloatArray:
        """Return the sd of each prediction's noise, (n_samples, n_points).

        `sd`, (n_samples,): each sample's, if the sd is inferred; else None. ShapeError or ParameterError if a function
        for the sd returns a wrong shape or a number not above 0.
        """
        if sd is not None:
            return np.asarray(np.broadcast_to(sd[:, None], predicted.shape))
        if not callable(self.sd):
            return np.full(predicted.shape, self.sd)
        found = np.asarray(self.sd(predicted.ravel()), dtype=np.float64)
        if found.shape not in ((), (predicted.size,)):
            allowed = f"({predicted.size},), one for each predicted reading"
            raise ShapeError(f"noise sd returns shape {found.shape}; allowed: {allowed}")
        out = np.array(np.broadcast_to(found, (predicted.size,))).reshape(predicted.shape)
        bad = ~((out > 0) & np.isfinite(out))
        if bad.any():
            where = predicted[bad][0]
            raise ParameterError(
                f"noise sd of the predicted reading {where:g}", float(out[bad][0]), "finite, greater than 0"
            )
        return out

    def log_density(self, readings: FloatArray, predicted: FloatArray, scale: FloatArray) -> FloatArray:
        """Return the log density of readings, given predictions and sds (`scale`); arrays that broadcast."""
        core = self._log_standard_density((readings - predicted) / scale) - np.log(scale)
        if not self.outliers:
            return np.asarray(core)
        return np.asarray(np.logaddexp(math.log1p(-self.outliers) + core, self._log_outlier_density(readings)))

    def cdf(self, readings: FloatArray, predicted: FloatArray, scale: FloatArray) -> FloatArray:
        """Return the probability of a smaller reading, given prediction and sd (`scale`); arrays that broadcast."""
        z = (readings - predicted) / scale
        core = ndtr(z) if math.isinf(self.dof) else stdtr(self.dof, z)
        if not self.outliers:
            return np.asarray(core)
        low, high = self._outlier_range
        return np.asarray((1 - self.outliers) * core + self.outliers * np.clip((readings - low) / (high - low), 0, 1))

    def smaller_tail(self, readings: FloatArray, predicted: FloatArray, scale: FloatArray) -> FloatArray:
        """Return the probability of a smaller or of a greater reading, whichever is less; arrays that broadcast."""
        # One minus the probability of a smaller reading would be 0 from 8.3 sds above on.
        if not self.outliers:
            return np.minimum(self.cdf(readings, predicted, scale), self.cdf(-readings, -predicted, scale))
        low, high = self._outlier_range
        mirrored = replace(self, between=(-high, -low))
        tail = np.minimum(self.cdf(readings, predicted, scale), mirrored.cdf(-readings, -predicted, scale))
        # An outlier at the very end of its range, such as a reading of 0, is no less probable than others.
        least = np.where((readings >= low) & (readings <= high), _OUTERMOST * self.outliers, 0.0)
        return np.maximum(tail, least)

    def draw(self, predicted: FloatArray, scale: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Draw a reading for each prediction, with sd `scale`; arrays of one shape."""
        z = rng.standard_normal(predicted.shape) if math.isinf(self.dof) else rng.standard_t(self.dof, predicted.shape)
        core = predicted + scale * z
        if not self.outliers:
            return np.asarray(core)
        return np.where(
            rng.random(predicted.shape) < self.outliers, rng.uniform(*self._outlier_range, predicted.shape), core
        )

    @cached_property
    def nodes_and_weights(self) -> tuple[FloatArray, FloatArray]:
        """Nodes in sds, and their weights, of a quadrature over the noise without its outliers, (n_nodes,) each."""
        if math.isinf(self.dof) and not self.is_sd_inferred:
            node, weight = np.polynomial.hermite_e.hermegauss(_N_GAUSSIAN)
            return node, weight / weight.sum()
        # A mixture of Gaussians of several sds has a narrow peak, which few nodes of one of them would miss.
        node, weight = np.polynomial.legendre.leggauss(_N_HEAVY)
        below = (node + 1) / 2
        return np.asarray(ndtri(below) if math.isinf(self.dof) else stdtrit(self.dof, below)), weight / 2

    def outlier_nodes(self, n: int) -> FloatArray:
        """Return `n` evenly spaced outliers, (n,); empty if the noise has none."""
        if not self.outliers:
            return np.empty(0)
        low, high = self._outlier_range
        return np.asarray(low + (high - low) * (np.arange(n) + 0.5) / n)

    @property
    def _outlier_range(self) -> tuple[float, float]:
        assert self.between is not None
        return self.between

    def _log_standard_density(self, z: FloatArray) -> FloatArray:
        if math.isinf(self.dof):
            return np.asarray(-0.5 * (z * z + _LOG_2PI))
        nu = self.dof
        constant = float(gammaln((nu + 1) / 2) - gammaln(nu / 2)) - 0.5 * math.log(nu * math.pi)
        return np.asarray(constant - 0.5 * (nu + 1) * np.log1p(z * z / nu))

    def _log_outlier_density(self, readings: FloatArray) -> FloatArray:
        low, high = self._outlier_range
        inside = (readings >= low) & (readings <= high)
        return np.where(inside, math.log(self.outliers / (high - low)), -np.inf)


def _is_range(value: Any) -> bool:
    try:
        low, high = value
        return bool(np.isfinite([low, high]).all() and low < high)
    except (TypeError, ValueError):
        return False
