"""Fit a mixture of Student t distributions to samples by expectation maximisation (Peel & McLachlan 2000)."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray
from probewise.nested.clusters import Clusters
from probewise.nested.proposal import DEGREES_OF_FREEDOM, Proposal

_NUMBERS = (1, 2, 3, 5, 8, 12, 18, 27, 40)
_TO_CHOOSE, _TO_FIT = 12, 30  # iterations
_LLOYD = 8
_PER_PARAMETER = 1.0  # samples for each parameter of a component, at least


def fit_mixture(x: FloatArray, weight: FloatArray | None = None, *, rng: np.random.Generator) -> Proposal:
    """Fit a mixture to samples, (n_samples, n_params), of equal weight or with weights, (n_samples,).

    The number of components, 1 to 40, with the greatest held-out likelihood (fit to one half, score on the other) is
    fitted to all samples.
    """
    order = rng.permutation(len(x))
    x, weight = x[order], np.ones(len(x)) if weight is None else weight[order]
    # Weights sum to the effective sample size, so that a component's mass is a number of samples.
    weight = weight * weight.sum() / (weight @ weight)
    first = np.arange(len(x)) < len(x) // 2
    n_first, n_params = weight[first].sum(), x.shape[1]
    possible = [n for n in _NUMBERS if n == 1 or _PER_PARAMETER * n * (n_params + 1) < n_first]

    def held_out_score(n: int) -> float:
        fitted = _fit_components(x[first], weight[first], n, _TO_CHOOSE, rng)
        return float(weight[~first] @ fitted.log_density(x[~first]))

    best = possible[0] if len(possible) == 1 else max(possible, key=held_out_score)
    return _fit_components(x, weight, best, _TO_FIT, rng)


def _fit_components(
    x: FloatArray, weight: FloatArray, n_components: int, n_iterations: int, rng: np.random.Generator
) -> Proposal:
    """Fit up to `n_components` Student t by expectation maximisation; components with too few samples are dropped."""
    n_params = x.shape[1]
    centre = weight @ x / weight.sum()
    off = x - centre
    whole = (off * weight[:, None]).T @ off / weight.sum()
    whole_root = _cholesky_factors(whole[None])[0]
    share, mean, root = _initial_components_by_kmeans(x, weight, centre, whole_root, n_components, rng)
    # A component borrows one sample's worth of the whole's covariance, scaled to a component's volume.
    borrowed = whole * n_components ** (-2.0 / n_params)
    for _ in range(n_iterations):
        log_part, square = _log_densities_and_square_distances(x, share, mean, root)
        part = np.exp(log_part - log_part.max(axis=0))
        part *= weight / part.sum(axis=0)
        mass = part.sum(axis=1)
        keep = mass > n_params + 1.5
        if not keep.any():
            keep = mass == mass.max()
        part, mass = part[keep], mass[keep]
        scaled = part * (DEGREES_OF_FREEDOM + n_params) / (DEGREES_OF_FREEDOM + square[keep])
        mean = scaled @ x / scaled.sum(axis=1)[:, None]
        off = x[None] - mean[:, None]
        covariance = (scaled[:, :, None] * off).transpose(0, 2, 1) @ off
        lent = 1.0 if len(mass) > 1 else 0.0
        root = _cholesky_factors((covariance + lent * borrowed) / (mass + lent)[:, None, None])
        share = mass / mass.sum()
    return _mixture_as_proposal(mean, root, share)


def single_student_t(mean: FloatArray, covariance: FloatArray) -> Proposal:
    """Return one Student t distribution of this mean, (n_params,), and scale matrix, (n_params, n_params)."""
    return _mixture_as_proposal(mean[None], _cholesky_factors(covariance[None]), np.ones(1))


def _mixture_as_proposal(mean: FloatArray, root: FloatArray, share: FloatArray) -> Proposal:
    """Return a mixture as a proposal: means (k, n_params), Cholesky factors (k, n_params, n_params), shares (k,)."""
    log_det = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    clusters = Clusters(mean, root, np.asarray(np.linalg.inv(root)), log_det, np.ones(len(share), dtype=np.int64))
    return Proposal(clusters, len(share) * (np.zeros((1, mean.shape[1])),), len(share) * (1.0,), share)


def _cholesky_factors(covariance: FloatArray) -> FloatArray:
    """Cholesky factors, (k, n_params, n_params), with a small ridge where there is no extent."""
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    ridge = 1e-10 * variance + 1e-13 * variance.mean(axis=1, keepdims=True) + 1e-24
    return np.asarray(np.linalg.cholesky(covariance + ridge[:, :, None] * np.eye(covariance.shape[1])))


def _initial_components_by_kmeans(
    x: FloatArray,
    weight: FloatArray,
    middle: FloatArray,
    whole_root: FloatArray,
    n_components: int,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return components to start from, by k-means++ (Arthur & Vassilvitskii 2007).

    Shares (k,), means (k, n_params) and roots of covariances (k, n_params, n_params).
    """
    if n_components == 1:
        return np.ones(1), middle[None], whole_root[None]
    white = (x - middle) @ np.linalg.inv(whole_root).T
    centre = white[[rng.choice(len(x), p=weight / weight.sum())]]
    square = ((white - centre[0]) ** 2).sum(axis=1)
    while len(centre) < n_components:
        chance = weight * square
        centre = np.concatenate([centre, white[[rng.choice(len(x), p=chance / chance.sum())]]])
        square = np.minimum(square, ((white - centre[-1]) ** 2).sum(axis=1))
    for _ in range(_LLOYD):
        home = ((white**2).sum(axis=1) - 2 * centre @ white.T + (centre**2).sum(axis=1)[:, None]).argmin(axis=0)
        mine = np.where(home == np.arange(len(centre))[:, None], weight, 0.0)
        mine = mine[mine.sum(axis=1) > 0]
        centre = mine @ white / mine.sum(axis=1)[:, None]
    mass = mine.sum(axis=1)
    spread = np.einsum("kn,kn->k", mine, ((white[None] - centre[:, None]) ** 2).mean(axis=2)) / mass
    spread = np.sqrt(np.maximum(spread, 0.1 * n_components ** (-2.0 / x.shape[1])))
    return mass / mass.sum(), middle + centre @ whole_root.T, spread[:, None, None] * whole_root


def _log_densities_and_square_distances(
    x: FloatArray, share: FloatArray, mean: FloatArray, root: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return log(share times density) up to a constant and the squared distance in sds, per component, (k, n) each."""
    n_params = x.shape[1]
    white = (x[None] - mean[:, None]) @ np.linalg.inv(root).transpose(0, 2, 1)
    square = (white**2).sum(axis=2)
    log_det = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    exponent = -0.5 * (DEGREES_OF_FREEDOM + n_params)
    log_part = np.log(share)[:, None] - log_det[:, None] + exponent * np.log1p(square / DEGREES_OF_FREEDOM)
    return log_part, square
