"""Noise with memory as a Markov chain: the noise of some readings given that of others, in time linear in their number.

A random walk beside independent noise, AR(1) noise, and independent noise are one model: a chain x_k = a_k x_(k-1) +
N(0, q_k), of which reading k shows x_k + N(0, s_k^2). What the readings before and after say of x_k is combined as in
a two-filter smoother (Fraser & Potter 1969); the Kalman gains do not depend on the readings, so that a filter of many
columns is one bidiagonal system.

Outlying readings beside a random walk: each one's own noise is wide, not the walk's step to it. Whitening spreads one
wide reading over several innovations, so that a tail of the innovations is another noise. Given which readings are
wide, all noise is Gaussian; which they are, each reading tells beside what all others tell of the walk there
(expectation propagation, Minka 2001). Against the sum over all sets of wide readings the evidence is right to a
twentieth of a nat.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded, solve_banded, solveh_banded
from scipy.special import expit

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.diagnosis.noise_law import LEAST_SCALE, MAD_OF_NORMAL, NoiseLaw


@dataclass(frozen=True, eq=False)
class _Chain:
    """The chain of a noise distribution, in units of sigma; arrays (n_points,) in the chain's order.

    `order` numbers the readings; x_k is `kept_share` times that of the reading before it plus noise of variance
    `gained`; the reading shows `scale` times x_k plus independent noise of variance `beside`.
    """

    order: IntArray
    kept_share: FloatArray
    gained: FloatArray
    beside: FloatArray
    scale: FloatArray

    @classmethod
    def of(cls, law: NoiseLaw) -> _Chain:
        n = len(law.sd)
        if law.walk.size:
            return cls(np.arange(n), np.ones(n), law.walk, law.sd**2, np.ones(n))
        root = np.arange(n)
        if law.before.size:  # rows of runs may alternate: those of one run together
            for k in np.flatnonzero(law.carry).tolist():
                root[k] = root[law.before[k]]
        order = np.argsort(root, kind="stable")
        carry = law.carry[order]
        return cls(order, carry, 1 - carry**2, np.zeros(n), law.sd[order])


def innovations_given_rest(law: NoiseLaw, columns: FloatArray, asked: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Whiten the noise of some readings given that of all others: what the others and earlier ones do not tell of each.

    `columns`: residuals, or slopes, of all readings, (n_points, n_columns); `asked`: mask of the readings to whiten,
    (n_points,); those that are lost are neither whitened nor given. Returns `innovations, sd`: whitened columns of the
    readings asked for, (n_asked, n_columns), of sd sigma each and independent, 0 where lost; and the sd of each reading
    in units of sigma, given the other readings and those asked for before it, (n_asked,), 1 where lost.
    """
    chain = _Chain.of(law)
    seen, own = ~law.lost[chain.order], asked[chain.order]
    given = seen & ~own
    y = np.where(seen[:, None], columns[chain.order] / chain.scale[:, None], 0.0)
    precision, later = _told_by_later(chain, given, y)
    mean, variance = _told_by_earlier(chain, seen, y)
    total = 1 + variance * precision
    expected = (mean + variance[:, None] * later) / total[:, None]
    sd = np.sqrt(variance / total + chain.beside)
    sd = np.where(seen, sd, 1.0)
    out, sd_out = np.zeros(y.shape), np.ones(len(y))
    out[chain.order] = np.where(seen[:, None], (y - expected) / sd[:, None], 0.0)
    sd_out[chain.order] = np.where(seen, sd * chain.scale, 1.0)
    return out[asked], sd_out[asked]


def _told_by_earlier(chain: _Chain, seen: BoolArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the means, (n_points, n_columns), and variances, (n_points,), of x_k given the readings before k."""
    n = len(y)
    variance, share, stays = np.empty(n), np.zeros(n), np.ones(n)
    rows = zip(chain.kept_share.tolist(), chain.gained.tolist(), chain.beside.tolist(), seen.tolist(), strict=True)
    after = 0.0  # variance of x_(k-1) given the readings up to it
    for k, (kept, gained, beside, is_seen) in enumerate(rows):
        now = kept * kept * after + gained
        variance[k] = now
        if is_seen:
            share[k] = now / (now + beside)
            stays[k] = beside / (now + beside)
        after = now * stays[k]
    # mean_(k+1) = a_(k+1) (stays_k mean_k + share_k y_k)
    entering = np.zeros(y.shape)
    entering[1:] = (chain.kept_share[1:] * share[:-1])[:, None] * y[:-1]
    bands = np.ones((2, n))
    bands[1, :-1] = -chain.kept_share[1:] * stays[:-1]
    return np.asarray(solve_banded((1, 0), bands, entering, check_finite=False)), variance


def _told_by_later(chain: _Chain, given: BoolArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return what the given readings after k tell of x_k: precision, (n_points,), and its product with the mean.

    The products have the shape of `y`, (n_points, n_columns).
    """
    n = len(y)
    precision, stays, share = np.zeros(n), np.zeros(n), np.zeros(n)
    rows = list(
        zip(chain.kept_share.tolist(), chain.gained.tolist(), chain.beside.tolist(), given.tolist(), strict=True)
    )
    for k in range(n - 1, 0, -1):
        kept, gained, beside, is_given = rows[k]
        known = precision[k]
        if is_given:
            across = (1 + beside * known) * gained + beside
            precision[k - 1] = kept * kept * (1 + beside * known) / across
            share[k], stays[k] = kept / across, kept * beside / across
        else:
            across = 1 + gained * known
            precision[k - 1] = kept * kept * known / across
            stays[k] = kept / across
    # later_(k-1) = share_k y_k + stays_k later_k
    entering = np.zeros(y.shape)
    entering[:-1] = share[1:, None] * y[1:]
    bands = np.ones((2, n))
    bands[0, 1:] = -stays[1:]
    return precision, np.asarray(solve_banded((0, 1), bands, entering, check_finite=False))


def walk_given_readings(law: NoiseLaw, residuals: FloatArray) -> FloatArray:
    """Return the expected random walk in residuals, given all of them, (n_points,); 0 without a walk."""
    if not law.walk.size:
        return np.zeros(len(residuals))
    weight = law.kept / law.sd**2
    bands = precision_bands_of_walk(law)
    bands[0] += weight
    return np.asarray(solveh_banded(bands, weight * residuals, lower=True, check_finite=False))


def precision_bands_of_walk(law: NoiseLaw) -> FloatArray:
    """Return the diagonal and the one below of a random walk's precision, in 1 / sigma^2, (2, n_points)."""
    steps = 1 / law.walk
    return np.stack([steps + np.append(steps[1:], 0.0), np.append(-steps[1:], 0.0)])


_ROUNDS = 20
_SAME = 0.01  # change of a reading's relative precision, and of sigma, at which the rounds end
_SMALLEST = 1e-9  # sigma, of the largest residual: most readings may be exactly as predicted
_FARTHEST = 1e100  # residual whose square is a number


def with_known_wide_readings(law: NoiseLaw, residuals: FloatArray) -> NoiseLaw:
    """Return a random walk's distribution with the tail on each reading's own noise, given the residuals of a fit.

    `law`: noise with a walk and a tail (`share`, `times`); `residuals`: residuals of the fit, (n_points,). Returns
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
            sigma = float(np.median(np.abs(apart / np.sqrt(beside + own))[kept])) / MAD_OF_NORMAL
        sigma = max(sigma, law.sigma_floor, _SMALLEST * float(np.abs(apart).max()), LEAST_SCALE)
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
