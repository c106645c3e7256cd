"""The evidence of N Gaussians over that of N - 1, by taking one of the N away or adding one.

With one Gaussian's light at nothing, N Gaussians are N - 1: the models are nested (Dickey 1971). So samples of either
posterior tell of the other's evidence: from N, take one faint Gaussian away; from N - 1, add one drawn from the prior.
Its light is integrated out, which one predicted curve allows: residuals are linear in its share of the light. Both
kinds of samples meet in a bridge (Bennett 1976).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy.special import expit

from probewise._arrays import FloatArray
from probewise.calibration.gaussian_responses import LoneResponses, light_of
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
class Removal:
    """Mean likelihood over the light of one faint Gaussian, over the likelihood without it.

    Parameters
    ----------
    prior
        Of N Gaussians, 2 or more, light uniform; see `has_reference`.
    alone
        Problem of one Gaussian over the same recording.
    n_bright
        Number of bright Gaussians, below N.
    """

    prior: SSFPrior
    alone: SensorProblem
    n_bright: int

    def taken(self, theta: FloatArray) -> FloatArray:
        """Log of that ratio for each faint Gaussian of sorted samples of N, (n, 6 N + 2) -> (n, N - n_bright)."""
        n = self.prior.n_gaussians
        at_once = max(1, _AT_ONCE // (n * self._readings.size))
        blocks = [theta[at : at + at_once] for at in range(0, len(theta), at_once)]
        return np.concatenate([self._taken(block) for block in blocks]) if blocks else np.empty((0, n - self.n_bright))

    def added(self, rest: FloatArray, gaussian: FloatArray) -> FloatArray:
        """Log of that ratio for a Gaussian more, (n, 6), of any light, beside samples of N - 1, (n, 6 N - 4)."""
        if not len(rest):
            return np.empty(0)
        at_once = max(1, _AT_ONCE // (self.prior.n_gaussians * self._readings.size))
        found = []
        for at in range(0, len(rest), at_once):
            part = rest[at : at + at_once]
            seen, light = self._responses(part)
            one = self._lone.to(gaussian[at : at + at_once])
            found.append(self._log_gain(_mixture_response(seen, light), one, light, part[:, -2:]))
        return np.concatenate(found)

    def _taken(self, theta: FloatArray) -> FloatArray:
        seen, light = self._responses(theta)
        out = np.empty((len(light), light.shape[1] - self.n_bright))
        for at in range(out.shape[1]):
            k = self.n_bright + at
            others = np.delete(light, k, axis=1)
            out[:, at] = self._log_gain(
                _mixture_response(np.delete(seen, k, axis=1), others), seen[:, k], others, theta[:, -2:]
            )
        return out

    def _responses(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Responses to each Gaussian by itself, (n, N, n_used), and its light, (n, N)."""
        return self._lone.to_each(theta), light_of(theta)

    def _log_gain(self, others: FloatArray, one: FloatArray, light: FloatArray, levels: FloatArray) -> FloatArray:
        """Integrate over the light of one Gaussian beside others.

        With t the light over that of the brightest of the others, whose own scale is integrated out, the ratio is
        (N - 1) / N times the integral of the likelihood over t from 0, times min(1, t^-N), over that at t = 0.
        """
        sums = self._sums(others, one, levels)
        return self._integrated(*sums, light.sum(axis=-1) / light.max(axis=-1))

    def _sums(self, others: FloatArray, one: FloatArray, levels: FloatArray) -> _Sums:
        """Sum residual squared, residual times change, change squared over data sets, (..., n_sets) each.

        The residual is that of the others alone; the change, of a Gaussian that takes their place.
        """
        span = levels[..., 1:] - levels[..., :1]
        off = self._readings - levels[..., :1] - span * others
        change = span * (one - others)
        parts = [off * off, off * change, change * change]
        shapes = [(*part.shape[:-1], -1) for part in parts]
        sums = [self._likelihood.sums_by_group(part.reshape(-1, part.shape[-1])) for part in parts]
        square, both, own = (part.reshape(shape) for part, shape in zip(sums, shapes, strict=True))
        return np.broadcast_to(square, own.shape), both, own

    def _integrated(self, square: FloatArray, both: FloatArray, own: FloatArray, whole: FloatArray) -> FloatArray:
        """Log of the integral over t, over the likelihood at t = 0; `whole`: the others' light over the brightest's."""
        n = self.prior.n_gaussians
        low, high = self._bounds(square, both, own, FAINT / (FAINT + whole))
        place, weight = _NODES
        share = (low[..., None] + (high - low)[..., None] * 0.5 * (place + 1.0)).clip(1e-14, 1.0 - 1e-12)
        log_density = self._log_density(square, both, own, whole, share)
        most = log_density.max(axis=-1)
        summed = most + np.log(np.exp(log_density - most[..., None]) @ (0.5 * weight)) + np.log(high - low)
        return np.asarray(summed + math.log((n - 1) / n) - self._log_likelihood(square))

    def _log_density(
        self, square: FloatArray, both: FloatArray, own: FloatArray, whole: FloatArray, share: FloatArray
    ) -> FloatArray:
        """Log of likelihood times prior of shares of the light, (..., n_shares)."""
        q = share[..., None]
        left = square[..., None, :] - 2.0 * q * both[..., None, :] + q * q * own[..., None, :]
        log_measure = np.log(whole[..., None]) - 2.0 * np.log1p(-share)
        return np.asarray(self._log_likelihood(left) + log_measure)

    def _bounds(
        self, square: FloatArray, both: FloatArray, own: FloatArray, most: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Shares of light between which the likelihood is not negligible, (...,) each."""
        share = np.zeros(square.shape[:-1])
        for _ in range(_N_NEWTON):
            q = share[..., None]
            left = np.maximum(square - 2.0 * q * both + q * q * own, 1e-300)
            per_variance = np.minimum(self._likelihood.sizes / left, 1.0 / self._likelihood.sd_floor**2)
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

    def _log_likelihood(self, square: FloatArray) -> FloatArray:
        """Log likelihood up to a constant from sums of squares, (..., n_sets) -> (...)."""
        first, per_log, values = self._tables
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
    def _tables(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of each data set, the first log of the sum of squares and one over its step, (n_sets,) each; the table.

        Log integrals over sigma, one data set after the other, are a straight line but near the bounds of sigma, so
        that linear interpolation serves.
        """
        likelihood = self._likelihood
        sizes, of = np.unique(likelihood.sizes, return_inverse=True)
        low, high = np.log(likelihood.sd_floor**2 * sizes * 1e-3), np.log(likelihood.sd_ceiling**2 * sizes * 1e3)
        grid = np.linspace(low, high, _N_TABLE, axis=1)
        values = log_sigma_integral(np.exp(grid), sizes[:, None], likelihood.sd_floor, likelihood.sd_ceiling)
        return low[of], ((_N_TABLE - 1) / (high - low))[of], values[of].ravel()

    @property
    def _lone(self) -> LoneResponses:
        return LoneResponses(self.alone)

    @cached_property
    def _readings(self) -> FloatArray:
        recording = self.alone.recording
        return np.asarray(recording.readings[recording.usable])

    @cached_property
    def _likelihood(self) -> StudentT:
        if not isinstance(self.alone.likelihood, StudentT):
            raise ParameterError("alone.likelihood", self.alone.likelihood, "a StudentT")
        return self.alone.likelihood


def _mixture_response(seen: FloatArray, light: FloatArray) -> FloatArray:
    """Response to a mixture, (n, n_used), from its Gaussians', (n, N, n_used), and their light, (n, N)."""
    return np.asarray(((light / light.sum(axis=1, keepdims=True))[:, None, :] @ seen)[:, 0])


def bridged(added: FloatArray, taken: FloatArray) -> tuple[float, float]:
    """Bridge N - 1 and N Gaussians: log of the ratio of evidences, and the effective share of the samples.

    Parameters
    ----------
    added
        `Removal.added` at samples of N - 1, (n_below,).
    taken
        `Removal.taken` at samples of N, (n, N).
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
    return found, min(_share(up), _share(samples))


def _share(weight: FloatArray) -> float:
    """Effective share of weighted samples, (n,)."""
    return float(weight.sum() ** 2 / (weight @ weight) / len(weight)) if weight.any() else 0.0
