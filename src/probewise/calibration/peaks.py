"""Climb to the peaks of an order's likelihood by least squares (Levenberg 1944, Marquardt 1963), many starts at once.

Each data set's noise sd is that of its residuals, so that the steps follow the Student-t likelihood.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit, logit

from probewise._arrays import FloatArray
from probewise.calibration.priors import SSFPrior
from probewise.inference import SensorProblem, StudentT

_N_DRAWS, _N_FREE, _N_SPLIT, _N_ADDED = 1000, 10, 10, 4  # draws of the prior; starts from them and from peaks below
_N_STEPS, _N_TRIED = 30, 8  # steps of a climb; after so many the lower half of the starts is left
_DIFFERENCE, _EDGE, _MOST_LOGIT = 1e-5, 1e-6, 14.0
_CURVATURE = 0.1  # about that of a logistic prior: it limits steps where the readings say nothing
_SETTLED = 1e-3


def climb(problem: SensorProblem, alone: SensorProblem, starts: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Climb to a peak of the likelihood from each start, (n_starts, 6 N + 2), the lower half for a few steps only.

    `problem`: of an `SSFPrior` and a `StudentT` likelihood; `alone`: the same of one Gaussian. Return where the climbs
    end and ln L there, (n_starts,), highest first.
    """
    prior, likelihood, recording = problem.prior, problem.likelihood, problem.recording
    assert isinstance(prior, SSFPrior)
    assert isinstance(likelihood, StudentT)
    readings = recording.readings[recording.usable]

    def residuals(z: FloatArray) -> FloatArray:
        predicted = problem.model.predict(prior.from_unit_cube(expit(z)), recording.plan)
        return np.asarray(readings - predicted[:, recording.usable])

    z = logit(prior.to_unit_cube(starts).clip(_EDGE, 1.0 - _EDGE))
    off = residuals(z)
    high = likelihood.log_prob(readings, readings - off)
    damping, going = np.full(len(z), 1e-2), np.ones(len(z), dtype=np.bool_)
    for k in range(_N_STEPS):
        if k == _N_TRIED:
            going &= high >= np.median(high)
        rows = np.flatnonzero(going)
        if not rows.size:
            break
        slope = _slopes(prior, alone, z[rows])
        weighted = slope * likelihood.inverse_noise_variance(off[rows])[:, None, :]
        curvature = weighted @ slope.transpose(0, 2, 1)
        scale = damping[rows, None] * (np.einsum("ndd->nd", curvature) + _CURVATURE) + 0.01 * _CURVATURE
        gradient = np.einsum("ndp,np->nd", weighted, off[rows])
        step = np.linalg.solve(curvature + scale[:, None, :] * np.eye(z.shape[1]), gradient[..., None])[..., 0]
        to = (z[rows] + step.clip(-2.0, 2.0)).clip(-_MOST_LOGIT, _MOST_LOGIT)
        there = residuals(to)
        gain = likelihood.log_prob(readings, readings - there) - high[rows]
        better = gain > 0.0
        up = rows[better]
        z[up], off[up], high[up] = to[better], there[better], high[up] + gain[better]
        damping[rows] = (damping[rows] * np.where(better, 0.2, 5.0)).clip(1e-9, 1e9)
        going[rows] = (gain > _SETTLED) | (~better & (damping[rows] < 1e6))
    order = np.argsort(-high)
    return prior.from_unit_cube(expit(z[order])), high[order]


def _slopes(prior: SSFPrior, alone: SensorProblem, z: FloatArray) -> FloatArray:
    """Differentiate the predictions by the logits `z` of the prior's cube, (n, d) -> (n, d, n_used).

    A change of one Gaussian leaves the responses to the others unchanged, so one kind of parameter is changed for all
    Gaussians at once; a change of light needs no new response.
    """
    n, n_gaussians = len(z), prior.n_gaussians
    changed = np.repeat(z[None], 7, axis=0)
    for kind in range(6):
        changed[1 + kind, :, kind:-2:6] += _DIFFERENCE
    theta = prior.from_unit_cube(expit(changed.reshape(7 * n, -1)))
    # The light is the first kind, with the responses of no change.
    each = np.concatenate([theta[:n], theta[2 * n :]])[:, :-2].reshape(-1, 6)
    lone = np.column_stack([np.ones(len(each)), each[:, 1:], np.zeros(len(each)), np.ones(len(each))])
    seen = alone.model.predict(lone, alone.recording.plan)[:, alone.recording.usable].reshape(6, n, n_gaussians, -1)
    g = theta[:, :-2].reshape(7, n, n_gaussians, 6)
    light = g[..., 0] / np.sqrt(g[..., 3] * g[..., 4] - g[..., 5] ** 2)
    whole = light[0].sum(axis=1)
    lit = light[0][..., None] * seen[0]
    mixed = lit.sum(axis=1) / whole[:, None]
    span = (theta[:n, -1] - theta[:n, -2])[:, None, None] / _DIFFERENCE
    slope = np.empty((*z.shape, seen.shape[-1]))
    for kind in range(6):
        more = light[1 + kind] - light[0]
        change = light[1 + kind][..., None] * seen[kind] - lit - more[..., None] * mixed[:, None]
        slope[:, kind:-2:6] = change * span / (whole[:, None] + more)[..., None]
    levels = (prior.from_unit_cube(expit(z + _DIFFERENCE))[:, -2:] - theta[:n, -2:]) / _DIFFERENCE
    slope[:, -2], slope[:, -1] = levels[:, :1] * (1.0 - mixed), levels[:, 1:] * mixed
    return slope


def starts_of_climbs(problem: SensorProblem, below: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Draw starts of N Gaussians: the best draws of the prior, and peaks of N - 1 with one split or added.

    `below`: peaks of N - 1, (n_peaks, 6 N - 4), none for N = 1. Return (n_starts, 6 N + 2).
    """
    prior = problem.prior
    assert isinstance(prior, SSFPrior)
    drawn = prior.from_unit_cube(rng.random((_N_DRAWS, len(prior.names))))
    best = drawn[np.argsort(-problem.log_likelihood(drawn))[:_N_FREE]]
    if prior.n_gaussians == 1:
        return best
    theta = np.resize(below, (_N_SPLIT + _N_ADDED, below.shape[1]))
    return np.concatenate([best, _split(theta[:_N_SPLIT], rng), _added(prior, theta[_N_SPLIT:], drawn, rng)])


def _split(theta: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Split a random Gaussian per row into two of its light, centre and covariance, (n, 6 N - 4) -> (n, 6 N + 2)."""
    m = len(theta)
    g = theta[:, :-2].reshape(m, -1, 6)
    rows, which = np.arange(m), rng.integers(g.shape[1], size=m)
    whole = g[rows, which]
    covariance = 0.5 * np.linalg.inv(whole[:, [3, 5, 5, 4]].reshape(m, 2, 2))
    share, angle, reach = rng.uniform(0.2, 0.8, m), rng.uniform(0.0, 2.0 * np.pi, m), rng.uniform(0.4, 0.97, m)
    towards = reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    apart = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), towards)
    left = 0.5 * np.linalg.inv(covariance - apart[:, :, None] * apart[:, None, :])
    scale = np.sqrt(np.linalg.det(left) / (whole[:, 3] * whole[:, 4] - whole[:, 5] ** 2))
    parts = []
    for own, side in ((share, np.sqrt((1.0 - share) / share)), (1.0 - share, -np.sqrt(share / (1.0 - share)))):
        centre = whole[:, 1:3] + side[:, None] * apart
        parts.append(np.column_stack([whole[:, 0] * own * scale, centre, left.reshape(m, 4)[:, [0, 3, 1]]]))
    out = theta.copy()
    out[:, :-2].reshape(m, -1, 6)[rows, which] = parts[0]
    return np.concatenate([out[:, :-2], parts[1], out[:, -2:]], axis=1)


def _added(prior: SSFPrior, theta: FloatArray, drawn: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Add a Gaussian of the prior's draws, of 0.01 to 0.2 of the first one's light: (n, 6 N - 4) -> (n, 6 N + 2)."""
    new, first = drawn[: len(theta), :6].copy(), theta[:, :6]
    unit = [prior.amplitude_at_unit_mass(g[:, 3] * g[:, 4] - g[:, 5] ** 2) for g in (new, first)]
    new[:, 0] = first[:, 0] / unit[1] * rng.uniform(0.01, 0.2, len(new)) * unit[0]
    return np.concatenate([theta[:, :-2], new, theta[:, -2:]], axis=1)
