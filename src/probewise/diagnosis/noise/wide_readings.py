"""Outlying readings beside a random walk: each one's own noise is wide, not the walk's step to it.

Whitening spreads one wide reading over several innovations, so that a tail of the innovations is another noise. Given
which readings are wide, all noise is Gaussian; which they are, each reading tells beside what all others tell of the
walk there (expectation propagation, Minka 2001). Against the sum over all sets of wide readings the evidence is right
to a twentieth of a nat.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.special import expit

from probewise._arrays import FloatArray
from probewise.diagnosis.noise.law import NoiseLaw
from probewise.diagnosis.noise.memory import precision_bands_of_walk

_ROUNDS = 20
_SAME = 0.01  # change of a reading's relative precision, and of sigma, at which the rounds end
_SMALLEST = 1e-9  # sigma, of the largest residual: most readings may be exactly as predicted
_FARTHEST = 1e100  # residual whose square is a number


def with_known_wide_readings(law: NoiseLaw, residuals: FloatArray) -> NoiseLaw:
    """Return a random walk's distribution with the tail on each reading's own noise, given the residuals of a fit.

    Parameters
    ----------
    law
        Noise with a walk and a tail (`share`, `times`).
    residuals
        Residuals of the fit, (n_points,).

    Returns
    -------
    Gaussian noise with the probability of each reading to be wide (`wide`), and sds that include it. Its `log_extra` is
    what the log density of these residuals, averaged over the sets of wide readings, exceeds that of this noise by.
    """
    if not np.abs(residuals).max() < _FARTHEST:  # of predictions that ran away: impossible in any case
        return replace(law, wide=np.zeros(len(residuals)))
    kept, excess = ~law.lost, 1 - law.times**-2
    own, bands = law.sd**2, precision_bands_of_walk(law)
    sigma = math.inf
    precise = np.ones(len(own))  # expected precision of each reading, relative to a narrow one
    for k in range(_ROUNDS):
        weight = law.kept * precise / own
        smoothed, variance = _smoothed_and_variance(bands, weight, residuals)
        unshared = np.maximum(1 - weight * variance, 1e-12)
        apart, beside = (residuals - smoothed) / unshared, variance / unshared  # from the walk as the others tell it
        last = sigma
        if k:
            sigma = math.sqrt(max(float(np.mean((weight * (residuals - smoothed) * residuals)[kept])), 0.0))
        else:  # whatever some outlying readings are
            sigma = float(np.median(np.abs(apart / np.sqrt(beside + own))[kept])) / 0.6745
        sigma = max(sigma, law.sigma_floor, _SMALLEST * float(np.abs(apart).max()), 1e-150)
        apart /= sigma
        log_narrow = np.log1p(-law.share) + _log_density(apart, beside + own)
        log_wide = np.log(law.share) + _log_density(apart, beside + own * law.times**2)
        wide, used = expit(log_wide - log_narrow), precise
        precise = 1 - excess * wide
        if k and np.abs(precise - used)[kept].max() < _SAME and abs(sigma / last - 1) < _SAME:
            break
    log_mixed = np.logaddexp(log_narrow, log_wide)
    log_extra = float(np.sum((log_mixed - _log_density(apart, beside + own / used))[kept]))
    return replace(
        law, sd=np.sqrt(own / used), wide=law.kept * (1 - used) / excess, log_extra=law.log_extra + log_extra
    )


def _smoothed_and_variance(
    steps: FloatArray, weight: FloatArray, residuals: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the expected walk and its variance, in units of sigma^2, given all residuals: (n_points,) both.

    `steps` are the bands of the walk's precision, (2, n_points); `weight` the precisions of the readings, (n_points,).
    """
    bands = steps.copy()
    bands[0] += weight
    root = cholesky_banded(bands, lower=True, check_finite=False)
    # The inverse's diagonal from the pivots of elimination forwards and backwards.
    backwards = np.stack([bands[0, ::-1], np.append(bands[1, -2::-1], 0.0)])
    pivots = cholesky_banded(backwards, lower=True, check_finite=False)[0, ::-1] ** 2
    smoothed = cho_solve_banded((root, True), weight * residuals, check_finite=False)
    return np.asarray(smoothed), np.asarray(1 / (root[0] ** 2 + pivots - bands[0]))


def _log_density(apart: FloatArray, variance: FloatArray) -> FloatArray:
    """Return the normal log density, without its constant."""
    return np.asarray(-0.5 * np.log(variance) - 0.5 * apart**2 / variance)
