"""Information gained on the parameters: prior minus posterior differential entropy, by two methods.

`bits_gained` uses nested sampling: its information H is the relative entropy of the posterior to the prior, and the two
entropies differ from it by the mean log prior only. `neighbour_entropy` looks at equally weighted samples alone: at
distances to nearest neighbours, which assume no shape.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import digamma, gammaln

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.priors import Prior


def bits_gained(information: float, log_prior: FloatArray, weight: FloatArray, prior_entropy_bits: float) -> float:
    """Convert nested sampling's information to prior minus posterior differential entropy.

    With p the prior and P the posterior, h(P) = -H - E_P[ln p], so h(p) - h(P) = H + E_P[ln p] + h(p).
    For a uniform prior the last two cancel and the bits are H / ln 2.

    Parameters
    ----------
    information
        H, relative entropy of posterior to prior, nats.
    log_prior
        Natural log of the prior density of posterior samples, shape (n_samples,).
    weight
        Their weights, shape (n_samples,), summing to one.
    prior_entropy_bits
        h(p) in bits, see `prior_entropy`.
    """
    return (information + float(weight @ log_prior)) / math.log(2) + prior_entropy_bits


def prior_entropy(prior: Prior, *, rng: np.random.Generator, n_samples: int = 20_000) -> float:
    """Return the differential entropy of a prior in bits: minus the mean log2 density of `n_samples` draws."""
    theta = prior.from_unit_cube(rng.random((n_samples, len(prior.names))))
    return -float(np.mean(prior.log_prob(theta))) / math.log(2)


def neighbour_entropy(theta: FloatArray, *, neighbour: int = 4) -> float:
    """Return the differential entropy in bits from distances to the k-th neighbour, theta (n_samples, n_params).

    Kozachenko and Leonenko's estimate (k, `neighbour`, as in Kraskov et al. 2004): psi(n) - psi(k) + ln V_d + d mean(ln
    r_k). The columns are scaled to unit sd first, and the scale is added back, since the estimate assumes a density
    that is even over the distance r_k. ParameterError if more than k samples coincide, for a constant
    column, or for a k that is not below the number of samples.
    """
    n_samples, n_params = theta.shape
    if not 1 <= neighbour < n_samples:
        raise ParameterError("neighbour", neighbour, f"1 to {n_samples - 1}, fewer than the samples")
    scale = theta.std(axis=0)
    if np.any(scale <= 0):
        raise ParameterError("theta", "a constant column", "samples that vary in every parameter")
    distance = np.asarray(cKDTree(theta / scale).query(theta / scale, k=[neighbour + 1])[0])
    if np.any(distance <= 0):
        raise ParameterError("theta", "repeated samples", f"samples of which no {neighbour + 1} coincide")
    log_ball = 0.5 * n_params * math.log(math.pi) - float(gammaln(0.5 * n_params + 1))
    nats = float(digamma(n_samples)) - float(digamma(neighbour)) + log_ball + n_params * float(np.log(distance).mean())
    return float(nats + np.log(scale).sum()) / math.log(2)
