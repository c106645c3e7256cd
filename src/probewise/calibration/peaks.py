"""Find the peaks of a likelihood by least squares from many starts (Levenberg 1944, Marquardt 1963).

The starts are spread over the prior, and made from the peaks of the orders below and above: a Gaussian is split, added
or taken away. All starts take their steps together. Each data set's noise sd is that of its residuals, so that the
steps follow the Student-t likelihood.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logit

from probewise._arrays import FloatArray
from probewise.calibration.gaussian_responses import SingleGaussianResponses, total_light_by_gaussian
from probewise.calibration.priors import SSFPrior
from probewise.errors import ParameterError
from probewise.inference import SensorProblem, StudentT

_N_DRAWS = 1500
# Starts to two Gaussians, and to more; by the prior, by a split of the peak below, by one added to it.
_STARTS, _FEWER_STARTS = (12, 14, 6), (7, 8, 3)
_N_STEPS, _N_TRIED = 30, 8
_DIFFERENCE = 1e-5
_MOST_Z = 14.0
_FIRST_DAMPING, _LOOSER, _TIGHTER = 1e-2, 0.2, 5.0
_LONGEST = 2.0
_PRIOR_CURVATURE = 0.1
_EDGE = 1e-6
_STUCK = 1e6
_SETTLED = 1e-3
# Other peaks: ln L differs by so much from the next higher one, and is lower than the highest by so much at most.
_SAME, _HARDLY_LOWER, _N_OTHERS = 0.05, 6.0, 3


@dataclass(frozen=True, eq=False)
class HighestPeak:
    """The highest peak found: parameters, (n_params,), ln L there, and at most three others, (n_others, n_params).

    The others are less than 6 nats lower, highest first.
    """

    theta: FloatArray
    log_likelihood: float
    others: FloatArray


def find_highest_likelihood_peak_by_order(
    problem: Callable[[int], SensorProblem], highest: int, *, rng: np.random.Generator
) -> dict[int, HighestPeak]:
    """Find the highest peak of the likelihood of each order from 1 to `highest`; return a dict by order.

    `problem`: function from an order to its problem, with an `SSFPrior` of uniform light and a `StudentT` likelihood.
    """
    found: dict[int, HighestPeak] = {}
    responses = SingleGaussianResponses(problem(1))
    for n in range(1, highest + 1):
        prior = _checked_ssf_prior(problem(n))
        drawn = prior.from_unit_cube(rng.random((_N_DRAWS, len(prior.names))))
        n_free, n_split, n_added = _STARTS if n <= 2 else _FEWER_STARTS
        starts = [drawn[np.argsort(-problem(n).log_likelihood(drawn))[:n_free]]]
        if n > 1:
            below = np.repeat(found[n - 1].theta[None], n_split + n_added, axis=0)
            lone = drawn[:n_added, :6]
            starts += [
                _split_gaussian(below[:n_split], rng),
                _with_light_gaussian_added(prior, below[n_split:], lone, rng),
            ]
        found[n] = _ascend_from_starts(problem(n), responses, np.concatenate(starts))
    for n in range(highest - 1, 0, -1):
        above = found[n + 1].theta
        lacking = [np.delete(above, slice(6 * k, 6 * k + 6)) for k in range(n + 1)]
        again = _ascend_from_starts(problem(n), responses, np.array(lacking))
        found[n] = max(found[n], again, key=lambda peak: peak.log_likelihood)
    return found


def _checked_ssf_prior(problem: SensorProblem) -> SSFPrior:
    """Return a problem's prior, or raise ParameterError if it is no `SSFPrior`."""
    if not isinstance(problem.prior, SSFPrior):
        raise ParameterError("problem.prior", problem.prior, "an SSFPrior")
    return problem.prior


def _split_gaussian(theta: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Split one random Gaussian per row into two of its light, centre and covariance, (n, 6 N + 2) -> (n, 6 N + 8)."""
    m = len(theta)
    g = theta[:, :-2].reshape(m, -1, 6)
    rows, which = np.arange(m), rng.integers(g.shape[1], size=m)
    whole = g[rows, which]
    half = np.array([[2.0 * whole[:, 3], 2.0 * whole[:, 5]], [2.0 * whole[:, 5], 2.0 * whole[:, 4]]]).transpose(2, 0, 1)
    covariance = np.linalg.inv(half)
    share = rng.uniform(0.2, 0.8, m)
    angle, reach = rng.uniform(0.0, 2.0 * np.pi, m), rng.uniform(0.4, 0.97, m)
    root = np.linalg.cholesky(covariance)
    apart = np.einsum("nij,nj->ni", root, (reach * np.stack([np.cos(angle), np.sin(angle)])).T)
    left = 0.5 * np.linalg.inv(covariance - apart[:, :, None] * apart[:, None, :])
    scale = np.sqrt(
        (left[:, 0, 0] * left[:, 1, 1] - left[:, 0, 1] ** 2) / (whole[:, 3] * whole[:, 4] - whole[:, 5] ** 2)
    )
    parts = []
    for own, side in ((share, np.sqrt((1.0 - share) / share)), (1.0 - share, -np.sqrt(share / (1.0 - share)))):
        centre = whole[:, 1:3] + side[:, None] * apart
        moments = np.stack([left[:, 0, 0], left[:, 1, 1], left[:, 0, 1]], axis=1)
        parts.append(np.column_stack([whole[:, 0] * own * scale, centre, moments]))
    out = theta.copy()
    out[:, :-2].reshape(m, -1, 6)[rows, which] = parts[0]
    return np.concatenate([out[:, :-2], parts[1], out[:, -2:]], axis=1)


def _with_light_gaussian_added(
    prior: SSFPrior, theta: FloatArray, lone: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Add the Gaussians `lone`, with 0.01 to 0.2 of the first one's light: (n, 6 N + 2), (n, 6) -> (n, 6 N + 8)."""
    one, first = lone.copy(), theta[:, :6]
    light = first[:, 0] / prior.amplitude_at_unit_mass(first[:, 3] * first[:, 4] - first[:, 5] ** 2)
    one[:, 0] = (
        light * rng.uniform(0.01, 0.2, len(one)) * prior.amplitude_at_unit_mass(one[:, 3] * one[:, 4] - one[:, 5] ** 2)
    )
    return np.concatenate([theta[:, :-2], one, theta[:, -2:]], axis=1)


def _ascend_from_starts(problem: SensorProblem, responses: SingleGaussianResponses, starts: FloatArray) -> HighestPeak:
    """Ascend from each start, (n_starts, n_params), the worse half for a few steps only; return the best reached."""
    prior, likelihood, recording = _checked_ssf_prior(problem), problem.likelihood, problem.recording
    if not isinstance(likelihood, StudentT):
        raise ParameterError("problem.likelihood", likelihood, "a StudentT")
    usable = recording.usable
    readings = recording.readings[usable]

    def residual(z: FloatArray) -> FloatArray:
        theta = prior.from_unit_cube(expit(z))
        return np.asarray(readings - problem.model.predict(theta, recording.plan)[:, usable])

    z = logit(prior.to_unit_cube(starts).clip(_EDGE, 1.0 - _EDGE))
    n, d = z.shape
    damping = np.full(n, _FIRST_DAMPING)
    off = residual(z)
    high = likelihood.log_prob(readings, readings - off)
    going = np.ones(n, dtype=np.bool_)
    for k in range(_N_STEPS):
        if k == _N_TRIED:
            going &= high >= np.median(high)
        rows = np.flatnonzero(going)
        if not rows.size:
            break
        here, own = z[rows], off[rows]
        slope = _prediction_slopes(prior, responses, here)
        weighted = slope * likelihood.inverse_noise_variance(own)[:, None, :]
        curvature = weighted @ slope.transpose(0, 2, 1)
        gradient = np.einsum("ndp,np->nd", weighted, own)
        # Without information in the readings, about the curvature of the logistic prior limits the step.
        scale = np.einsum("ndd->nd", curvature) + _PRIOR_CURVATURE
        damped = curvature + (damping[rows, None] * scale)[:, None, :] * np.eye(d) + 0.01 * _PRIOR_CURVATURE * np.eye(d)
        step = np.linalg.solve(damped, gradient[..., None])[..., 0].clip(-_LONGEST, _LONGEST)
        to = (here + step).clip(-_MOST_Z, _MOST_Z)
        there = residual(to)
        reached = likelihood.log_prob(readings, readings - there)
        gain = reached - high[rows]
        better = gain > 0.0
        up = rows[better]
        z[up], off[up], high[up] = to[better], there[better], reached[better]
        damping[rows] = (damping[rows] * np.where(better, _LOOSER, _TIGHTER)).clip(1e-9, 1e9)
        going[rows] = (gain > _SETTLED) | (~better & (damping[rows] < _STUCK))
    order = np.argsort(-high)
    theta, high = prior.from_unit_cube(expit(z[order])), high[order]
    lower = -np.diff(high, prepend=high[0] + 1.0)
    others = np.flatnonzero((lower > _SAME) & (high > high[0] - _HARDLY_LOWER))[1 : 1 + _N_OTHERS]
    return HighestPeak(theta[0], float(high[0]), theta[others])


def _prediction_slopes(prior: SSFPrior, responses: SingleGaussianResponses, z: FloatArray) -> FloatArray:
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
    seen = responses.responses_by_gaussian(np.concatenate([theta[:n], theta[2 * n :]])).reshape(6, n, n_gaussians, -1)
    light = total_light_by_gaussian(theta).reshape(7, n, n_gaussians)
    theta = theta[:n]
    whole = light[0].sum(axis=1)
    lit = light[0][..., None] * seen[0]
    mixed = lit.sum(axis=1) / whole[:, None]
    span = (theta[:, -1] - theta[:, -2])[:, None, None] / _DIFFERENCE
    slope = np.empty((*z.shape, seen.shape[-1]))
    for kind in range(6):
        more = light[1 + kind] - light[0]
        each = light[1 + kind][..., None] * seen[kind]
        each -= lit
        each -= more[..., None] * mixed[:, None]
        each *= span / (whole[:, None] + more)[..., None]
        slope[:, kind:-2:6] = each
    levels = (prior.from_unit_cube(expit(z + _DIFFERENCE))[:, -2:] - theta[:, -2:]) / _DIFFERENCE
    slope[:, -2] = levels[:, :1] * (1.0 - mixed)
    slope[:, -1] = levels[:, 1:] * mixed
    return slope
