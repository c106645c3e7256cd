"""Noise with memory as a Markov chain: the noise of some readings given that of others, in time linear in their number.

A random walk beside independent noise, AR(1) noise, and independent noise are one model: a chain x_k = a_k x_(k-1) +
N(0, q_k), of which reading k shows x_k + N(0, s_k^2). What the readings before and after say of x_k is combined as in
a two-filter smoother (Fraser & Potter 1969); the Kalman gains do not depend on the readings, so that a filter of many
columns is one bidiagonal system.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_banded, solveh_banded

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.diagnosis.noise.law import NoiseLaw


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

    Parameters
    ----------
    law
        Joint distribution of all readings' noise, its tail aside.
    columns
        Residuals, or slopes, of all readings, (n_points, n_columns).
    asked
        Mask of the readings to whiten, (n_points,); those that are lost are neither whitened nor given.

    Returns
    -------
    innovations, sd
        Whitened columns of the readings asked for, (n_asked, n_columns), of sd sigma each and independent, 0 where
        lost; and the sd of each reading in units of sigma, given the other readings and those asked for before it,
        (n_asked,), 1 where lost.
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
