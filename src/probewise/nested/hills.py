"""Estimate the evidence of a hill of the posterior by importance sampling, and whether a run has met the hill."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.nested.ascent import GaussianAtPeak
from probewise.nested.clusters import Clusters
from probewise.nested.evaluate import Bound, Evaluator, Points
from probewise.nested.importance import HeldOutSamples, Posterior, Weighted, draw_and_weigh
from probewise.nested.moves import SliceMove
from probewise.nested.proposal import single_student_t
from probewise.nested.repartition import covariance_root_of_points
from probewise.nested.space import Space, unbounded_space_of
from probewise.nested.weights import n_effective

_N_SAMPLES = 1000  # of a hill
_ROUNDS = 6
_SETTLED = 0.5  # nats
_FEWEST_STEPS = 6
_PER_PARAM, _DRAWS_PER_PARAM = 4, 40
_FITS, _ENOUGH = 6, 4.0  # effective samples a parameter
_POWERS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15, 0.1)
_WIDER = 1.2  # the sds of the Student t than those of the points it is fitted to
_INSIDE = 0.9  # of the weight of a hill, within the ellipsoid in which the run's own weight is counted
_MET = 0.5  # of the evidence of a hill: with more, the run has met it


@dataclass(frozen=True, eq=False)
class HillEstimate:
    """A hill of the posterior, that is a mode and its surroundings, with samples and the log of its evidence.

    `theta`: samples of the hill, (n, n_params). Within `radius` sds of the single cluster `shape`, in coordinates of
    `space`, lies 90 % of the hill's evidence.
    """

    log_z: float
    theta: FloatArray
    space: Space
    shape: Clusters
    radius: float

    @classmethod
    def from_draws(cls, drawn: Weighted, space: Space, rng: np.random.Generator) -> HillEstimate:
        """Make the estimate from weighted draws on a hill; `space` holds the coordinates of its ellipsoid."""
        theta = drawn.samples(_N_SAMPLES, rng=rng)
        x = space.enter(theta)
        shape = Clusters.from_groups([x])
        return cls(drawn.log_z, theta, space, shape, float(np.quantile(_distance_in_sds(x, shape), _INSIDE)))

    def is_met_by(self, run: Posterior) -> bool:
        """Return whether a run's posterior has, within this hill's ellipsoid, more than half of the hill's evidence."""
        inside = _distance_in_sds(self.space.enter(run.theta), self.shape) <= self.radius
        near = float(run.weight[inside].sum())
        return near > 0 and run.log_z + math.log(near) > self.log_z + math.log(_MET * _INSIDE)


def _distance_in_sds(x: FloatArray, shape: Clusters) -> FloatArray:
    """Distance of points (n, n_params) from the mean of a single cluster, in sds of the cluster, (n,)."""
    return np.asarray(np.linalg.norm((x - shape.mean[0]) @ shape.inverse_root[0].T, axis=1))


def log_evidence_of_unmet_hills(hills: Iterable[HillEstimate], run: Posterior) -> float:
    """Return the log of the sum of the evidences of the hills that a run has not met; -inf where it met all."""
    return float(logsumexp([-math.inf, *(hill.log_z for hill in hills if not hill.is_met_by(run))]))


def _n_points_on_hill(n_params: int) -> int:
    return max(_PER_PARAM * n_params, 20)


def calls_for_hill_evidence(n_params: int) -> float:
    """Return about how many evaluations the evidence of a hill takes: two or three rounds of chains."""
    return 2.5 * _n_points_on_hill(n_params) * max(n_params, _FEWEST_STEPS) * SliceMove().target


def draw_uniformly_near_hilltop(top: GaussianAtPeak, evaluate: Evaluator, rng: np.random.Generator) -> Points:
    """Draw points uniformly where the log likelihood is within (n_params + 2) / 2 of a hill's highest (slice sampling).

    On a normal hill these points have the covariance of the whole hill.
    """
    n_params = top.root.shape[0]
    n = _n_points_on_hill(n_params)
    below = (n_params + 2) / 2
    move = SliceMove(hops=0)
    live = top.highest.u + rng.standard_normal((n, n_params)) @ top.root.T
    starts = top.highest.take_rows(np.zeros(n, dtype=np.int64))
    highest, log_volume = top.highest_log_likelihood, -math.inf
    for _ in range(_ROUNDS):
        drawn, _ = move.draw(starts, Bound(highest - below, 1.0), live, evaluate, rng)
        last, log_volume = log_volume, float(np.linalg.slogdet(covariance_root_of_points(drawn.u))[1])
        rise = max(float(drawn.log_likelihood.max()) - highest, 0.0)
        if rise < _SETTLED and abs(log_volume - last) < _SETTLED * math.sqrt(n_params):
            break
        highest += rise
        live = drawn.u
        starts = drawn.take_rows((drawn.log_likelihood > highest - below).nonzero()[0])
        starts = starts.take_rows(rng.integers(len(starts), size=n))
    return drawn


def estimate_hill(settled: Points, evaluate: Evaluator, rng: np.random.Generator) -> HillEstimate | None:
    """Estimate a hill's evidence by draws from a Student t about points on the hill; None where no Student t fits.

    Where there are too few effective samples, the Student t is fitted anew to the weighted draws, up to five times.
    """
    space = unbounded_space_of(evaluate.problem.prior)
    x, n_params = space.enter(settled.theta), settled.theta.shape[1]
    mean, covariance = x.mean(axis=0), np.atleast_2d(np.cov(x, rowvar=False))
    n_draws, enough = max(_DRAWS_PER_PARAM * n_params, 200), _ENOUGH * n_params
    for _ in range(_FITS):
        proposal = single_student_t(mean, _WIDER**2 * covariance)
        drawn = draw_and_weigh(proposal, 0.0, HeldOutSamples.empty(), space, evaluate, n_draws=n_draws, rng=rng)
        if drawn.n_eff > enough:
            return HillEstimate.from_draws(drawn, space, rng)
        if not drawn.n_eff > 1:
            return None
        # A power of the weights that leaves enough of them for a covariance.
        power = next((p for p in _POWERS if n_effective(p * drawn.log_weight) > enough), None)
        if power is None:
            return None
        weight, x = np.exp(power * drawn.log_weight), space.enter(drawn.theta)
        weight /= weight.sum()
        mean = weight @ x
        covariance = (x - mean).T @ ((x - mean) * weight[:, None])
    return None
