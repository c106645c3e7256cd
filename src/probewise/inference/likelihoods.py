"""Likelihoods of readings.

Paper, sections 2.4.1, "The Naive Likelihood" (eq. 6), 2.5, "The SSF Likelihood" (eq. 11: Student-t), and 2.7 (eq. 19
and 20: its product over data sets).

`Naive` is the paper's sensor of two levels. The paper prints (2 pi sigma)^(-1/2) and a positive exponent; a normal
density has (2 pi sigma^2)^(-1/2) and a negative one.

`StudentT` integrates a Gaussian over its unknown sd, sigma. The paper keeps [sum of squares]^(-(N-1)/2), which with an
unbounded prior of sigma diverges where a hypothesis fits the few readings of a small data set exactly, and is flat
after one reading. So here sigma's prior is 1/sigma between a floor and a ceiling, and all constants are kept.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammainc, gammaincc, gammaln

from probewise._arrays import FloatArray, IntArray, floats, frozen_int, read_only_floats
from probewise._kinds import checked_number
from probewise.errors import ParameterError, ShapeError, require

_LOG_2PI = math.log(2 * math.pi)


def residuals(readings: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return readings, (n_points,), minus predictions, (n_samples, n_points): (n_samples, n_points).

    ShapeError if the shapes do not match.
    """
    readings, predicted = floats(readings, "readings"), floats(predicted, "predicted")
    if readings.ndim != 1 or predicted.ndim != 2 or predicted.shape[1] != readings.size:
        raise ShapeError(
            f"readings have shape {readings.shape}, predictions {predicted.shape}; "
            "allowed: (n_points,) and (n_samples, n_points)"
        )
    return readings - predicted


@dataclass(frozen=True)
class Naive:
    """Likelihood of a sensor with two levels, each with Gaussian noise of its own sd (paper, eq. 6).

    Mean and sd of readings over black and over white, in units of the reading; the means differ, else ParameterError.
    """

    mu_black: float
    sd_black: float
    mu_white: float
    sd_white: float

    def __post_init__(self) -> None:
        for name in ("mu_black", "sd_black", "mu_white", "sd_white"):
            checked_number(name, getattr(self, name))
        for name in ("sd_black", "sd_white"):
            require(0 < getattr(self, name) < math.inf, name, getattr(self, name), "greater than 0, finite")
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
        black, white = (
            -0.5 * ((readings - mean) / sd) * ((readings - mean) / sd) - np.log(sd) - 0.5 * math.log(2 * math.pi)
            for mean, sd in ((self.mu_black, self.sd_black), (self.mu_white, self.sd_white))
        )
        over_white = (predicted - middle) * sign > 0
        return np.asarray(over_white @ (white - black) + black.sum())


@dataclass(frozen=True, eq=False)
class GaussianKnown:
    """Likelihood of independent Gaussian noise of known sd.

    `sd`: in units of the reading, a number, or one for each reading, (n_points,); ParameterError if not above 0.
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


_TINY = 1e-250
_N_TERMS = 100
_MANY_GROUPS = 16  # from here on, sums in place are cheaper than a product with a mostly zero matrix


def log_sigma_integral(square: ArrayLike, n: ArrayLike, low: float, high: float) -> FloatArray:
    """Return the log of the integral of sigma^(-n-1) exp(-square / (2 sigma^2)) over sigma from `low` to `high`.

    With t = square / (2 sigma^2) it is (2 / square)^(n/2) / 2 times a difference of two incomplete
    gamma functions of order n/2. It is computed in log space from the tail in which both ends lie,
    so it is accurate from square = 0 to squares whose integral underflows.

    `square`: sum of squared residuals, 0 or more; `n`: number of residuals, greater than 0, broadcasts with `square`.
    The bounds of sigma are 0 < low < high.
    """
    s, a = np.asarray(square, dtype=np.float64), np.asarray(n, dtype=np.float64) / 2.0
    with np.errstate(over="ignore"):
        t_low, t_high = s / (2.0 * low**2), s / (2.0 * high**2)
    fits = t_low < a  # residuals below the floor: both ends in the lower tail
    huge = t_high > a  # residuals beyond the ceiling: both ends in the upper tail
    if not (fits.any() or huge.any()):
        return _log_twice_integral_over_peak(s, a, t_low, t_high) - math.log(2.0)
    s, a, t_low, t_high = np.broadcast_arrays(s, a, t_low, t_high)
    out = np.empty(s.shape)
    if fits.any():
        b = a[fits]
        out[fits] = _log_diff_exp(
            _log_lower_gamma_scaled(b, t_low[fits]) - 2.0 * b * math.log(low),
            _log_lower_gamma_scaled(b, t_high[fits]) - 2.0 * b * math.log(high),
        )
    if huge.any():
        b = a[huge]
        difference = _log_diff_exp(_log_upper_gamma(b, t_high[huge]), _log_upper_gamma(b, t_low[huge]))
        out[huge] = difference + b * (math.log(2.0) - np.log(s[huge]))
    usual = ~(fits | huge)
    if usual.any():
        out[usual] = _log_twice_integral_over_peak(s[usual], a[usual], t_low[usual], t_high[usual])
    return out - math.log(2.0)


def _log_twice_integral_over_peak(s: FloatArray, a: FloatArray, t_low: FloatArray, t_high: FloatArray) -> FloatArray:
    """Return the log of twice the integral, for t_low above a and t_high below: the integrand's peak is within."""
    share = gammainc(a, t_low) - gammainc(a, t_high)
    return np.asarray(gammaln(a) + np.log(share) + a * (math.log(2.0) - np.log(s)))


def _log_diff_exp(large: FloatArray, small: FloatArray) -> FloatArray:
    return np.asarray(large + np.log(-np.expm1(np.minimum(small - large, -1e-300))))


def _log_lower_gamma_scaled(a: FloatArray, t: FloatArray) -> FloatArray:
    """Return the log of gamma(a, t) / t^a, gamma the lower incomplete one; finite at t = 0, for t up to about a."""
    share = gammainc(a, t)
    safe = np.where(share > _TINY, t, 1.0)
    out = np.log(np.maximum(share, _TINY)) + gammaln(a) - a * np.log(safe)
    rare = share <= _TINY
    if rare.any():
        b, x = a[rare], t[rare]
        term = total = np.ones_like(x)
        for k in range(1, _N_TERMS):
            term = term * x / (b + k)
            total = total + term
        out[rare] = np.log(total) - x - np.log(b)
    return np.asarray(out)


def _log_upper_gamma(a: FloatArray, t: FloatArray) -> FloatArray:
    """Return the log of Gamma(a, t), the upper incomplete gamma function, for t from about a; -inf at t = inf."""
    share = gammaincc(a, t)
    out = np.log(np.maximum(share, _TINY)) + gammaln(a)
    rare = share <= _TINY
    if rare.any():
        b, x = a[rare], t[rare]
        # Legendre's continued fraction, evaluated from its tail.
        fraction = np.zeros_like(x)
        for k in range(_N_TERMS, 0, -1):
            fraction = k * (k - b) / (x + 2 * k + 1 - b - fraction)
        with np.errstate(invalid="ignore"):
            value = b * np.log(x) - x - np.log(x + 1 - b - fraction)
        out[rare] = np.where(np.isposinf(x), -np.inf, value)
    return np.asarray(out)


@dataclass(frozen=True, eq=False)
class StudentT:
    """Student-t likelihood: Gaussian noise, the sd of each data set integrated out (paper, eq. 19 and 20).

    The paper gives S^(-(N-1)/2), from a prior uniform in an unbounded sigma. Here sigma's prior is 1/sigma between a
    floor and a ceiling: it is proper, tends to S^(-N/2) for wide bounds, and keeps all constants.

    For a data set of N readings with sum of squares S, and L = ln(sd_ceiling / sd_floor): (2 pi)^(-N/2) / L times the
    integral of sigma^(-N-1) exp(-S / 2 sigma^2) from floor to ceiling.

    `groups`: label of the data set of each reading, (n_points,), any integers. `sd_floor`, `sd_ceiling`: bounds of
    every data set's sigma, in units of the reading, 0 < floor < ceiling, else ParameterError.
    """

    groups: IntArray
    sd_floor: float
    sd_ceiling: float

    def __post_init__(self) -> None:
        groups = frozen_int(self.groups)
        if groups.ndim != 1:
            raise ShapeError(f"groups have shape {groups.shape}; allowed: (n_points,)")
        if not 0 < self.sd_floor < self.sd_ceiling < math.inf:
            bounds = self.sd_floor, self.sd_ceiling
            raise ParameterError("(sd_floor, sd_ceiling)", bounds, "0 < floor < ceiling, finite")
        object.__setattr__(self, "groups", groups)

    @cached_property
    def _group_indicator(self) -> FloatArray:
        """Indicator matrix, (n_points, n_groups): 1 where reading i belongs to data set j."""
        return np.asarray(self.groups[:, None] == np.unique(self.groups)[None, :], dtype=np.float64)

    @cached_property
    def _group_starts(self) -> IntArray | None:
        """Index of each data set's first reading, if there are over 16, contiguous each and in order; else None."""
        starts = np.flatnonzero(np.diff(self.groups, prepend=self.groups[:1] - 1))
        in_one_piece = starts.size == self.group_sizes.size and bool((np.diff(self.groups[starts]) > 0).all())
        return starts if in_one_piece and starts.size > _MANY_GROUPS else None

    def sums_by_group(self, square: FloatArray) -> FloatArray:
        """Return sums over the readings of each data set, (n_samples, n_points) -> (n_samples, n_groups)."""
        if self._group_starts is None:
            return square @ self._group_indicator
        return np.asarray(np.add.reduceat(square, self._group_starts, axis=1))

    @cached_property
    def group_sizes(self) -> FloatArray:
        """Number of readings of each data set, in the order of their labels, (n_groups,)."""
        return np.asarray(self._group_indicator.sum(axis=0))

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return the log likelihood of readings, (n_points,), given predictions, (n_samples, n_points): (n_samples,).

        All constants are included.
        """
        residual = residuals(readings, predicted)
        if residual.shape[1] != self.groups.size:
            raise ShapeError(
                f"groups has {self.groups.size} values for {residual.shape[1]} readings; allowed: one per reading"
            )
        square = self.sums_by_group(np.square(residual, out=residual))
        integral = log_sigma_integral(square, self.group_sizes, self.sd_floor, self.sd_ceiling)
        constant = 0.5 * self.groups.size * _LOG_2PI + self.group_sizes.size * math.log(
            math.log(self.sd_ceiling / self.sd_floor)
        )
        return np.asarray(integral.sum(axis=1) - constant)

    def inverse_noise_variance(self, residual: FloatArray) -> FloatArray:
        """Return one over the noise variance of each reading's data set, as its residuals estimate the variance.

        (n_samples, n_points) -> the same shape. The variance is limited to the bounds of the sd.

        The gradient of `log_prob` by the predictions is the residual times this, except near the bounds of the sd.
        """
        variance = self.sums_by_group(np.square(residual)) / self.group_sizes
        per_set = 1.0 / variance.clip(self.sd_floor**2, self.sd_ceiling**2)
        return np.asarray(per_set[:, np.unique(self.groups, return_inverse=True)[1]])
