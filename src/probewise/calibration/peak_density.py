"""Evidence of an order from the peak of its likelihood: importance sampling with a Student-t about it.

The first density has the peak's curvature (Laplace); its weighted draws shape the next (population Monte Carlo, Cappé,
Guillin, Marin & Robert 2004). Gaussians have no labels, so the density is averaged over their orders.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri, gammaln, logsumexp

from probewise._arrays import BoolArray, FloatArray
from probewise.calibration.known_density import independent_proposal
from probewise.calibration.peak_coordinates import PeakCoordinates
from probewise.calibration.priors import SSFPrior
from probewise.errors import ParameterError
from probewise.inference import SensorProblem, StudentT
from probewise.nested.weights import n_effective

_DEGREES_OF_FREEDOM = 8.0
_N_ROUNDS, _N_PILOTS = 4, 1000
_DIFFERENCE = 1e-5
# Draws that shape the next density are tempered until they are this many for each coordinate.
_LEAST_PER_COORDINATE = 6.0
_WIDENED = 1.1
# Share of the draws that count as near the peak.
_NEAR = 0.9


@dataclass(frozen=True, eq=False)
class StudentTDensity:
    """Mean, (d,), and lower root of the covariance, (d, d), of a multivariate Student-t."""

    mean: FloatArray
    root: FloatArray

    def draw(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw points, (n, d)."""
        white = rng.standard_normal((n, len(self.mean)))
        white *= np.sqrt(_DEGREES_OF_FREEDOM / rng.chisquare(_DEGREES_OF_FREEDOM, size=(n, 1)))
        return np.asarray(self.mean + white @ self.root.T)

    @property
    def least_log_density(self) -> float:
        """Log density above which nine tenths of the draws lie, by Fisher's distribution."""
        d = len(self.mean)
        at = self.mean + math.sqrt(d * float(fdtri(d, _DEGREES_OF_FREEDOM, _NEAR))) * self.root[:, 0]
        return float(self.log_density(at[None])[0])

    def log_density(self, y: FloatArray) -> FloatArray:
        """Natural log of the density, (n, d) -> (n,)."""
        nu, d = _DEGREES_OF_FREEDOM, len(self.mean)
        white = np.linalg.solve(self.root, (y - self.mean).T)
        norm = gammaln((nu + d) / 2) - gammaln(nu / 2) - 0.5 * d * math.log(nu * math.pi)
        norm -= float(np.log(np.diag(self.root)).sum())
        return np.asarray(norm - 0.5 * (nu + d) * np.log1p((white**2).sum(axis=0) / nu))


@dataclass(frozen=True, eq=False)
class PeakDensity:
    """A Student-t about a peak, averaged over the labels of the Gaussians: a `KnownDensity`."""

    space: PeakCoordinates
    one: StudentTDensity

    @property
    def prior(self) -> SSFPrior:
        """Of N Gaussians."""
        return self.space.prior

    def drawn(self, n: int, *, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Draw within the prior: coordinates, parameters, log density over the prior's; at most n rows."""
        y = self.one.draw(n, rng)
        theta, log_prior = self.space.leave(y, rng.random(n))
        inside = np.isfinite(log_prior)
        return y[inside], theta[inside], self._log_density(y[inside]) - log_prior[inside]

    def draw(self, rest: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Draw as many as there are rows in `rest`, (n, 6 N + 2); nan where outside the prior."""
        y = self.one.draw(len(rest), rng)
        theta, log_prior = self.space.leave(y, rng.random(len(rest)))
        theta[~np.isfinite(log_prior)] = np.nan
        return theta

    def widened(self, factor: float) -> PeakDensity:
        """Widen it by a factor."""
        return PeakDensity(self.space, StudentTDensity(self.one.mean, factor * self.one.root))

    def fitted_to(self, theta: FloatArray) -> PeakDensity:
        """Fit a density to samples, (n, 6 N + 2), each with the labels that this one gives them."""
        y = self.space.enter(theta)
        labelled = np.stack([self.space.relabel(y, change) for change in self.space.relabelled])
        best = np.argmax([self.one.log_density(each) for each in labelled], axis=0)
        own = labelled[best, np.arange(len(y))]
        root = np.linalg.cholesky(_WIDENED**2 * np.cov(own, rowvar=False))
        return PeakDensity(self.space, StudentTDensity(own.mean(axis=0), np.asarray(root, dtype=np.float64)))

    def near(self, y: FloatArray) -> BoolArray:
        """Whether coordinates, with any labels, are among the densest draws; (n, 6 N + 1) -> (n,)."""
        each = [self.one.log_density(self.space.relabel(y, change)) for change in self.space.relabelled]
        return np.asarray(np.max(each, axis=0) > self.one.least_log_density)

    def log_over_prior(self, theta: FloatArray) -> FloatArray:
        """Log density over the prior's, (n, 6 N + 2) -> (n,)."""
        y = self.space.enter(theta)
        return self._log_density(y) - self.space.leave(y)[1]

    def propose(self, here: FloatArray, *, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Propose draws of it, as `independent_proposal` says."""
        return independent_proposal(self, here, rng=rng)

    def _log_density(self, y: FloatArray) -> FloatArray:
        each = [self.one.log_density(self.space.relabel(y, change)) for change in self.space.relabelled]
        return np.asarray(logsumexp(each, axis=0) - math.log(len(each)))


def density_about_peak(
    problem: SensorProblem, peak: FloatArray, *, rng: np.random.Generator, n_pilots: int = _N_PILOTS
) -> tuple[PeakDensity, int]:
    """Shape a density to the posterior about a peak.

    Parameters
    ----------
    problem
        With an `SSFPrior` of uniform light and a `StudentT` likelihood.
    peak
        Where the likelihood is greatest, (6 N + 2,).
    rng
        Source of randomness.
    n_pilots
        Draws of each round that shapes it.

    Returns
    -------
    The density, and likelihood evaluations.
    """
    prior = problem.prior
    if not isinstance(prior, SSFPrior):
        raise ParameterError("problem.prior", prior, "an SSFPrior")
    space = PeakCoordinates(prior)
    density, n_calls = _laplace(problem, space, peak), 0
    for _ in range(_N_ROUNDS):
        y, theta, log_density = PeakDensity(space, density).drawn(n_pilots, rng=rng)
        n_calls += len(y)
        if len(y) < 2 * y.shape[1]:
            density = StudentTDensity(density.mean, 0.5 * density.root)
            continue
        log_weight = problem.log_likelihood(theta) - log_density
        density = _fitted_density(y, _tempered(log_weight, _LEAST_PER_COORDINATE * y.shape[1]), density)
    return PeakDensity(space, density), n_calls


def share_missed_about(
    problem: SensorProblem,
    density: PeakDensity,
    theta: FloatArray,
    log_z: float,
    *,
    n_draws: int,
    rng: np.random.Generator,
) -> float:
    """Tell which share of the evidence lies about a peak and has no samples, two errors below its estimate.

    Parameters
    ----------
    problem
        With an `SSFPrior` of uniform light.
    density
        About the peak.
    theta
        Samples of the posterior, (n, 6 N + 2).
    log_z
        Natural log of the evidence as they tell it.
    n_draws
        Draws by which the peak is weighed.
    rng
        Source of randomness.
    """
    y, drawn, log_density = density.drawn(n_draws, rng=rng)
    near = density.near(y)
    weight = np.exp(problem.log_likelihood(drawn[near]) - log_density[near] - log_z) if near.any() else np.zeros(1)
    about = float(weight.sum()) / n_draws
    error = math.sqrt(max(float((weight**2).sum()) / n_draws - about**2, 0.0) / n_draws)
    missed = max(about - 2.0 * error - float(density.near(density.space.enter(theta)).mean()), 0.0)
    return missed / (1.0 + missed)


def _laplace(problem: SensorProblem, space: PeakCoordinates, peak: FloatArray) -> StudentTDensity:
    """Shape a density by the peak's curvature, and by the prior's width where the readings say little."""
    prior, likelihood, recording = space.prior, problem.likelihood, problem.recording
    if not isinstance(likelihood, StudentT):
        raise ParameterError("problem.likelihood", likelihood, "a StudentT")
    at = space.enter(peak[None])[0]
    d = len(at)
    wide = space.enter(prior.from_unit_cube(np.random.default_rng(0).random((500, len(prior.names))))).var(axis=0)
    theta, _ = space.leave(at + _DIFFERENCE * np.concatenate([np.zeros((1, d)), np.eye(d)]))
    predicted = problem.model.predict(theta, recording.plan)[:, recording.usable]
    slope = (predicted[1:] - predicted[0]) / _DIFFERENCE
    weight = likelihood.weights(recording.readings[recording.usable] - predicted[:1])[0]
    covariance = np.linalg.inv((slope * weight) @ slope.T + np.diag(1.0 / wide))
    return StudentTDensity(at, np.asarray(np.linalg.cholesky(_WIDENED**2 * covariance), dtype=np.float64))


def _tempered(log_weight: FloatArray, least: float) -> FloatArray:
    """Scale log weights by the largest power, at most 1, that leaves an effective sample size of `least` or more."""
    low, high = 0.0, 1.0
    if n_effective(log_weight) >= least:
        return log_weight
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if n_effective(middle * log_weight) >= least else (low, middle)
    return low * log_weight


def _fitted_density(y: FloatArray, log_weight: FloatArray, before: StudentTDensity) -> StudentTDensity:
    """Fit a density to weighted draws; with few of them it keeps some of the one before."""
    weight = np.exp(log_weight - logsumexp(log_weight))
    mean = weight @ y
    off = y - mean
    covariance = (off * weight[:, None]).T @ off
    kept = min(1.0, y.shape[1] / n_effective(log_weight))
    covariance = (1.0 - kept) * covariance + kept * before.root @ before.root.T
    return StudentTDensity(mean, np.linalg.cholesky(_WIDENED**2 * covariance))
