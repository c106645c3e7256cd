"""The evidence of N Gaussians over that of N - 1, by taking one of the N away or adding one, its light integrated out.

With one Gaussian's light at zero, N Gaussians are N - 1: the models are nested (Dickey 1971). So samples of either
posterior estimate the ratio: from samples of N, one faint Gaussian is taken away; to samples of N - 1, one drawn from
the prior is added. Residuals are linear in its share of the light, so one predicted curve suffices to integrate the
light out. A bridge combines both kinds of samples (Bennett 1976).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy.special import expit

from probewise._arrays import FloatArray
from probewise.calibration.gaussian_responses import SingleGaussianResponses, total_light_by_gaussian
from probewise.calibration.priors import SSFPrior
from probewise.calibration.whole_coordinates import FAINT
from probewise.errors import ParameterError
from probewise.inference import SensorProblem, StudentT, log_sigma_integral

_Sums: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]

_AT_ONCE = 400_000
# Integrals over a light's posterior within 1e-4.
_NODES = np.polynomial.legendre.leggauss(12)
_REACH = 5.0
_N_NEWTON = 4
_N_TABLE = 1024
_N_ROOT, _ROOT = 60, 1e-7


@dataclass(frozen=True, eq=False)
class FaintGaussianLikelihoodRatio:
    """Mean likelihood over the light of one faint Gaussian, divided by the likelihood without the Gaussian.

    `prior`: of N Gaussians, 2 or more, with uniform light; see `has_uniform_prior_of_light`. `alone`: problem of one
    Gaussian over the same recording. `n_bright`: number of bright Gaussians, below N.
    """

    prior: SSFPrior
    alone: SensorProblem
    n_bright: int

    def log_likelihood_ratios_of_faint_gaussians(self, theta: FloatArray) -> FloatArray:
        """Log of the ratio for each faint Gaussian of sorted samples of N, (n, 6 N + 2) -> (n, N - n_bright)."""
        n = self.prior.n_gaussians
        at_once = max(1, _AT_ONCE // (n * self._usable_readings.size))
        blocks = [theta[at : at + at_once] for at in range(0, len(theta), at_once)]
        return (
            np.concatenate([self._log_likelihood_ratios_of_block(block) for block in blocks])
            if blocks
            else np.empty((0, n - self.n_bright))
        )

    def log_likelihood_ratio_of_added_gaussian(self, rest: FloatArray, gaussian: FloatArray) -> FloatArray:
        """Log of the ratio, (n,), for `gaussian`, (n, 6), of any light, added to samples of N - 1, (n, 6 N - 4)."""
        if not len(rest):
            return np.empty(0)
        at_once = max(1, _AT_ONCE // (self.prior.n_gaussians * self._usable_readings.size))
        found = []
        for at in range(0, len(rest), at_once):
            part = rest[at : at + at_once]
            seen, light = self._responses_and_light_by_gaussian(part)
            one = self._response_model.responses_to_gaussians(gaussian[at : at + at_once])
            found.append(
                self._log_likelihood_ratio_of_gaussian(_mixture_response(seen, light), one, light, part[:, -2:])
            )
        return np.concatenate(found)

    def _log_likelihood_ratios_of_block(self, theta: FloatArray) -> FloatArray:
        seen, light = self._responses_and_light_by_gaussian(theta)
        out = np.empty((len(light), light.shape[1] - self.n_bright))
        for at in range(out.shape[1]):
            k = self.n_bright + at
            others = np.delete(light, k, axis=1)
            out[:, at] = self._log_likelihood_ratio_of_gaussian(
                _mixture_response(np.delete(seen, k, axis=1), others), seen[:, k], others, theta[:, -2:]
            )
        return out

    def _responses_and_light_by_gaussian(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Responses of the readings to each Gaussian by itself, (n, N, n_used), and its light, (n, N)."""
        return self._response_model.responses_by_gaussian(theta), total_light_by_gaussian(theta)

    def _log_likelihood_ratio_of_gaussian(
        self, others: FloatArray, one: FloatArray, light: FloatArray, levels: FloatArray
    ) -> FloatArray:
        """Log of the ratio, (n,), for a Gaussian of responses `one` beside `others`, (n, n_used) each.

        `light` of the others, (n, N - 1). With t the Gaussian's light over that of the brightest other, whose own scale
        is integrated out, the ratio is (N - 1) / N times the integral of the likelihood over t from 0 to `FAINT`, over
        the likelihood at t = 0.
        """
        sums = self._residual_sums_by_data_set(others, one, levels)
        return self._log_integral_over_light(*sums, light.sum(axis=-1) / light.max(axis=-1))

    def _residual_sums_by_data_set(self, others: FloatArray, one: FloatArray, levels: FloatArray) -> _Sums:
        """Sum residual squared, residual times change, and change squared within data sets, (..., n_sets) each.

        The residual is without the Gaussian; the change is that of the prediction if the Gaussian held all light.
        """
        span = levels[..., 1:] - levels[..., :1]
        off = self._usable_readings - levels[..., :1] - span * others
        change = span * (one - others)
        parts = [off * off, off * change, change * change]
        shapes = [(*part.shape[:-1], -1) for part in parts]
        sums = [self._student_t_likelihood.sums_by_group(part.reshape(-1, part.shape[-1])) for part in parts]
        square, both, own = (part.reshape(shape) for part, shape in zip(sums, shapes, strict=True))
        return np.broadcast_to(square, own.shape), both, own

    def _log_integral_over_light(
        self, square: FloatArray, both: FloatArray, own: FloatArray, whole: FloatArray
    ) -> FloatArray:
        """Log of the ratio, (...,), from the sums of `_residual_sums_by_data_set`.

        `whole`: light of all others over that of the brightest, (...,).
        """
        n = self.prior.n_gaussians
        low, high = self._integration_limits(square, both, own, FAINT / (FAINT + whole))
        place, weight = _NODES
        share = (low[..., None] + (high - low)[..., None] * 0.5 * (place + 1.0)).clip(1e-14, 1.0 - 1e-12)
        log_density = self._log_likelihood_times_prior(square, both, own, whole, share)
        most = log_density.max(axis=-1)
        summed = most + np.log(np.exp(log_density - most[..., None]) @ (0.5 * weight)) + np.log(high - low)
        return np.asarray(summed + math.log((n - 1) / n) - self._log_likelihood_of_sums(square))

    def _log_likelihood_times_prior(
        self, square: FloatArray, both: FloatArray, own: FloatArray, whole: FloatArray, share: FloatArray
    ) -> FloatArray:
        """Log of likelihood times prior, up to a constant, at shares of the light `share`, (..., n_shares)."""
        q = share[..., None]
        left = square[..., None, :] - 2.0 * q * both[..., None, :] + q * q * own[..., None, :]
        log_measure = np.log(whole[..., None]) - 2.0 * np.log1p(-share)
        return np.asarray(self._log_likelihood_of_sums(left) + log_measure)

    def _integration_limits(
        self, square: FloatArray, both: FloatArray, own: FloatArray, most: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Least and greatest share of the light at which the likelihood is not negligible, (...,) each."""
        share = np.zeros(square.shape[:-1])
        for _ in range(_N_NEWTON):
            q = share[..., None]
            left = np.maximum(square - 2.0 * q * both + q * q * own, 1e-300)
            per_variance = np.minimum(
                self._student_t_likelihood.group_sizes / left, 1.0 / self._student_t_likelihood.sd_floor**2
            )
            told = (per_variance * own).sum(axis=-1) + 1e-12
            best = (per_variance * both).sum(axis=-1) / told
            share = np.clip(best, 0.0, most)
        sd = 1.0 / np.sqrt(told)
        # Where the best share is out of bounds, the likelihood falls from the bound almost by an exponential.
        beyond = np.maximum(np.maximum(-best, best - most), 0.0) / sd
        reach = _REACH**2 * sd / (beyond + np.hypot(beyond, _REACH))
        low = np.clip(share - reach, 0.0, most)
        high = np.clip(share + reach, 0.0, most)
        return low, np.maximum(high, low + 1e-12)

    def _log_likelihood_of_sums(self, square: FloatArray) -> FloatArray:
        """Log likelihood up to a constant from sums of squares, (..., n_sets) -> (...)."""
        first, per_log, values = self._log_likelihood_tables
        cells = np.log(np.maximum(square, 1e-300))
        cells -= first
        cells *= per_log
        np.clip(cells, 0.0, _N_TABLE - 2, out=cells)
        entry = cells.astype(np.intp)
        cells -= entry
        entry += _N_TABLE * np.arange(len(first))
        cells *= (values[1:] - values[:-1]).take(entry)
        cells += values.take(entry)
        return np.asarray(cells.sum(axis=-1))

    @cached_property
    def _log_likelihood_tables(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Tables of the log likelihood over the log sum of squares, per data set.

        First log and one over the step, (n_sets,) each; then the log integrals over sigma, concatenated. They follow a
        straight line except near the bounds of sigma, so linear interpolation suffices.
        """
        likelihood = self._student_t_likelihood
        sizes, of = np.unique(likelihood.group_sizes, return_inverse=True)
        low, high = np.log(likelihood.sd_floor**2 * sizes * 1e-3), np.log(likelihood.sd_ceiling**2 * sizes * 1e3)
        grid = np.linspace(low, high, _N_TABLE, axis=1)
        values = log_sigma_integral(np.exp(grid), sizes[:, None], likelihood.sd_floor, likelihood.sd_ceiling)
        return low[of], ((_N_TABLE - 1) / (high - low))[of], values[of].ravel()

    @property
    def _response_model(self) -> SingleGaussianResponses:
        return SingleGaussianResponses(self.alone)

    @cached_property
    def _usable_readings(self) -> FloatArray:
        recording = self.alone.recording
        return np.asarray(recording.readings[recording.usable])

    @cached_property
    def _student_t_likelihood(self) -> StudentT:
        if not isinstance(self.alone.likelihood, StudentT):
            raise ParameterError("alone.likelihood", self.alone.likelihood, "a StudentT")
        return self.alone.likelihood


def _mixture_response(seen: FloatArray, light: FloatArray) -> FloatArray:
    """Response to a mixture, (n, n_used), from those to its Gaussians, (n, N, n_used), and their light, (n, N)."""
    return np.asarray(((light / light.sum(axis=1, keepdims=True))[:, None, :] @ seen)[:, 0])


def bridge_log_z_ratio(added: FloatArray, taken: FloatArray) -> tuple[float, float]:
    """Estimate by a bridge the log of Z of N over Z of N - 1; also return the lesser effective share of samples.

    `added`: `log_likelihood_ratio_of_added_gaussian` at samples of N - 1, (n_below,). `taken`:
    `log_likelihood_ratios_of_faint_gaussians` at samples of N, (n, N - n_bright); see `FaintGaussianLikelihoodRatio`.
    """
    each, added = taken.ravel(), np.where(added > -np.inf, added, -1e300)
    real = np.concatenate([added[added > -1e300], each])
    low, high = real.min() - 1.0, real.max() + 1.0
    found = 0.5 * (low + high)
    # By Newton's method, within bounds that close in: where a step leaves them, they are halved.
    for _ in range(_N_ROOT):
        up, down = expit(added - found), expit(found - each)
        uneven = up.mean() - down.mean()
        low, high = (found, high) if uneven > 0.0 else (low, found)
        slope = (up * (1.0 - up)).mean() + (down * (1.0 - down)).mean()
        step = uneven / slope if slope > 0.0 else np.inf
        before, found = found, found + step if low < found + step < high else 0.5 * (low + high)
        if abs(found - before) < _ROOT:
            break
    found = float(found)
    samples = expit(found - taken).sum(axis=1)
    up = expit(added - found)
    return found, min(_effective_sample_fraction(up), _effective_sample_fraction(samples))


def _effective_sample_fraction(weight: FloatArray) -> float:
    """Return Kish's effective sample size of weights, (n,), divided by n."""
    return float(weight.sum() ** 2 / (weight @ weight) / len(weight)) if weight.any() else 0.0
