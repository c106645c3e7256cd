"""Find the peaks of a likelihood by least squares from many starts (Levenberg 1944, Marquardt 1963).

The starts are spread over the prior, and all of them take their steps together. Each data set's noise sd is that of its
residuals, so that the steps follow the Student-t likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logit

from probewise._arrays import FloatArray
from probewise.calibration.priors import SSFPrior
from probewise.errors import ParameterError
from probewise.inference import SensorProblem, StudentT

__all__ = ["Peak", "find_peak"]

_N_DRAWS = 1500
_N_STEPS = 25
_DIFFERENCE = 1e-5
_MOST_Z = 14.0
_FIRST_DAMPING, _LOOSER, _TIGHTER = 1e-2, 0.2, 5.0
_LONGEST = 2.0
_SETTLED = 1e-2


@dataclass(frozen=True, eq=False)
class Peak:
    """Where many ascents ended: the highest place, (n_params,), and ln L of each, (n_starts,), greatest first."""

    theta: FloatArray
    log_likelihood: FloatArray

    @property
    def highest(self) -> float:
        """Greatest ln L."""
        return float(self.log_likelihood[0])


def find_peak(problem: SensorProblem, *, n_starts: int, rng: np.random.Generator) -> Peak:
    """Climb from the best of many draws of the prior.

    Parameters
    ----------
    problem
        With an `SSFPrior` and a `StudentT` likelihood.
    n_starts
        Ascents, from the best of 1,500 draws.
    rng
        Source of randomness.
    """
    prior, likelihood, recording = problem.prior, problem.likelihood, problem.recording
    if not isinstance(prior, SSFPrior) or not isinstance(likelihood, StudentT):
        raise ParameterError("problem", problem, "one of an SSFPrior and a StudentT likelihood")
    usable = recording.usable
    readings = recording.readings[usable]

    def residual(z: FloatArray) -> FloatArray:
        theta = prior.from_unit_cube(expit(z))
        return np.asarray(readings - problem.model.predict(theta, recording.plan)[:, usable])

    def height(off: FloatArray) -> FloatArray:
        return likelihood.log_prob(readings, readings - off)

    drawn = rng.random((_N_DRAWS, len(prior.names)))
    started = problem.log_likelihood(prior.from_unit_cube(drawn))
    z = logit(drawn[np.argsort(-started)[:n_starts]])
    n, d = z.shape
    damping = np.full(n, _FIRST_DAMPING)
    off = residual(z)
    high = height(off)
    going = np.ones(n, dtype=np.bool_)
    for _ in range(_N_STEPS):
        rows = np.flatnonzero(going)
        if not rows.size:
            break
        here, own = z[rows], off[rows]
        shifted = (here[:, None, :] + _DIFFERENCE * np.eye(d)).reshape(-1, d)
        slope = (residual(shifted).reshape(len(rows), d, -1) - own[:, None, :]) / -_DIFFERENCE
        weight = likelihood.weights(own)
        weighted = slope * weight[:, None, :]
        curvature = weighted @ slope.transpose(0, 2, 1)
        gradient = np.einsum("ndp,np->nd", weighted, own)
        # Where the readings say nothing, the unit curvature of a logistic prior holds the step.
        scale = np.einsum("ndd->nd", curvature) + 0.1
        damped = curvature + np.einsum("n,nd,de->nde", damping[rows], scale, np.eye(d)) + 1e-3 * np.eye(d)
        step = np.linalg.solve(damped, gradient[..., None])[..., 0].clip(-_LONGEST, _LONGEST)
        to = (here + step).clip(-_MOST_Z, _MOST_Z)
        there = residual(to)
        reached = height(there)
        gain = reached - high[rows]
        better = gain > 0.0
        up = rows[better]
        z[up], off[up], high[up] = to[better], there[better], reached[better]
        damping[rows] = (damping[rows] * np.where(better, _LOOSER, _TIGHTER)).clip(1e-9, 1e9)
        going[rows] = (gain > _SETTLED) | (~better & (damping[rows] < 1e6))
    order = np.argsort(-high)
    return Peak(prior.from_unit_cube(expit(z[order[:1]]))[0], high[order])
