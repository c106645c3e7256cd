"""Evidence of an order from the peak of its likelihood: importance sampling with a Student-t about the peak.

The first density has the peak's curvature (Laplace); its weighted draws shape the next (population Monte Carlo, Cappé,
Guillin, Marin & Robert 2004). Gaussians have no labels, so the density is averaged over their orders.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri, gammaln, logsumexp

from probewise._arrays import BoolArray, FloatArray
from probewise.calibration.label_symmetric_coordinates import LabelSymmetricCoordinates
from probewise.calibration.priors import SSFPrior
from probewise.calibration.reference_density import propose_independently
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
    """A multivariate Student-t of 8 degrees of freedom: mean, (d,), and Cholesky root of its scale matrix, (d, d)."""

    mean: FloatArray
    root: FloatArray

    def draw(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw points, (n, d)."""
        white = rng.standard_normal((n, len(self.mean)))
        white *= np.sqrt(_DEGREES_OF_FREEDOM / rng.chisquare(_DEGREES_OF_FREEDOM, size=(n, 1)))
        return np.asarray(self.mean + white @ self.root.T)

    @property
    def log_density_enclosing_nine_tenths(self) -> float:
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
    """A Student-t about a peak, averaged over the labels of the Gaussians, usable as a `ReferenceDensity`.

    `one`: the Student-t for one order of the labels, in the coordinates `space`.
    """

    space: LabelSymmetricCoordinates
    one: StudentTDensity

    @property
    def prior(self) -> SSFPrior:
        """The prior of N Gaussians."""
        return self.space.prior

    def draw_and_keep_within_prior(
        self, n: int, *, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Make `n` draws; return coordinates, parameters and log density over the prior's of those within the prior."""
        y = self.one.draw(n, rng)
        theta, log_prior = self.space.leave(y, rng.random(n))
        inside = np.isfinite(log_prior)
        return y[inside], theta[inside], self._log_density_in_coordinates(y[inside]) - log_prior[inside]

    def draw(self, rest: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Draw as many parameters as `rest` has rows, (n, 6 N + 2); nan where outside the prior."""
        y = self.one.draw(len(rest), rng)
        theta, log_prior = self.space.leave(y, rng.random(len(rest)))
        theta[~np.isfinite(log_prior)] = np.nan
        return theta

    def widened(self, factor: float) -> PeakDensity:
        """Return the density with all sds multiplied by a factor."""
        return PeakDensity(self.space, StudentTDensity(self.one.mean, factor * self.one.root))

    def fitted_to(self, theta: FloatArray) -> PeakDensity:
        """Fit a density to samples, (n, 6 N + 2), each with the labels that are most probable under this one.

        The new density's sds are 1.27 times those of the samples.
        """
        y = self.space.enter(theta)
        labelled = np.stack([self.space.apply_label_permutation(y, change) for change in self.space.label_permutations])
        best = np.argmax([self.one.log_density(each) for each in labelled], axis=0)
        own = labelled[best, np.arange(len(y))]
        root = np.linalg.cholesky(_WIDENED**2 * np.cov(own, rowvar=False))
        return PeakDensity(self.space, StudentTDensity(own.mean(axis=0), np.asarray(root, dtype=np.float64)))

    def near_peak_mask(self, y: FloatArray) -> BoolArray:
        """Return a mask of coordinates, (n, d) -> (n,), in the densest 90 % of draws for some order of the labels."""
        each = [
            self.one.log_density(self.space.apply_label_permutation(y, change))
            for change in self.space.label_permutations
        ]
        return np.asarray(np.max(each, axis=0) > self.one.log_density_enclosing_nine_tenths)

    def log_density_over_prior(self, theta: FloatArray) -> FloatArray:
        """Return the log of this density divided by the prior's, (n, 6 N + 2) -> (n,)."""
        y = self.space.enter(theta)
        return self._log_density_in_coordinates(y) - self.space.leave(y)[1]

    def propose_moves(self, here: FloatArray, *, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Propose a draw of this density to each particle, both (n, 6 N + 2), nan where outside the prior.

        Also return log density over prior at the particles minus that at the draws, (n,); -inf where there is no draw.
        """
        return propose_independently(self, here, rng=rng)

    def _log_density_in_coordinates(self, y: FloatArray) -> FloatArray:
        """Log density, averaged over the labels, (n, 6 N + 1) -> (n,)."""
        each = [
            self.one.log_density(self.space.apply_label_permutation(y, change))
            for change in self.space.label_permutations
        ]
        return np.asarray(logsumexp(each, axis=0) - math.log(len(each)))


def fit_density_about_peak(
    problem: SensorProblem, peak: FloatArray, *, rng: np.random.Generator, n_pilots: int = _N_PILOTS
) -> tuple[PeakDensity, int]:
    """Fit a density to the posterior about a peak of the likelihood `peak`, (6 N + 2,), in four rounds of draws.

    `problem` has an `SSFPrior` of uniform light and a `StudentT` likelihood, else ParameterError. `n_pilots`: draws of
    each round. Return the density, and the number of likelihood evaluations.
    """
    prior = problem.prior
    if not isinstance(prior, SSFPrior):
        raise ParameterError("problem.prior", prior, "an SSFPrior")
    space = LabelSymmetricCoordinates(prior)
    density, n_calls = _laplace_density(problem, space, peak), 0
    for _ in range(_N_ROUNDS):
        y, theta, log_density = PeakDensity(space, density).draw_and_keep_within_prior(n_pilots, rng=rng)
        n_calls += len(y)
        if len(y) < 2 * y.shape[1]:
            density = StudentTDensity(density.mean, 0.5 * density.root)
            continue
        log_weight = problem.log_likelihood(theta) - log_density
        density = _refitted_density(
            y, _temper_log_weights_to_n_effective(log_weight, _LEAST_PER_COORDINATE * y.shape[1]), density
        )
    return PeakDensity(space, density), n_calls


def share_missed_about_peak(
    problem: SensorProblem,
    density: PeakDensity,
    theta: FloatArray,
    log_z: float,
    *,
    n_draws: int,
    rng: np.random.Generator,
) -> float:
    """Estimate the share of the evidence that lies about a peak but has no samples; 0 or more.

    Two standard errors are subtracted. `problem` has an `SSFPrior` of uniform light; `density` is about the peak.
    `theta`: samples of the posterior, (n, 6 N + 2), according to which ln of the evidence is `log_z`. `n_draws`: draws
    from `density`.
    """
    y, drawn, log_density = density.draw_and_keep_within_prior(n_draws, rng=rng)
    near = density.near_peak_mask(y)
    weight = np.exp(problem.log_likelihood(drawn[near]) - log_density[near] - log_z) if near.any() else np.zeros(1)
    about = float(weight.sum()) / n_draws
    error = math.sqrt(max(float((weight**2).sum()) / n_draws - about**2, 0.0) / n_draws)
    missed = max(about - 2.0 * error - float(density.near_peak_mask(density.space.enter(theta)).mean()), 0.0)
    return missed / (1.0 + missed)


def _laplace_density(problem: SensorProblem, space: LabelSymmetricCoordinates, peak: FloatArray) -> StudentTDensity:
    """Make a density of the peak's curvature, with the prior's width along coordinates of little information."""
    prior, likelihood, recording = space.prior, problem.likelihood, problem.recording
    if not isinstance(likelihood, StudentT):
        raise ParameterError("problem.likelihood", likelihood, "a StudentT")
    at = space.enter(peak[None])[0]
    d = len(at)
    wide = space.enter(prior.from_unit_cube(np.random.default_rng(0).random((500, len(prior.names))))).var(axis=0)
    theta, _ = space.leave(at + _DIFFERENCE * np.concatenate([np.zeros((1, d)), np.eye(d)]))
    predicted = problem.model.predict(theta, recording.plan)[:, recording.usable]
    slope = (predicted[1:] - predicted[0]) / _DIFFERENCE
    weight = likelihood.inverse_noise_variance(recording.readings[recording.usable] - predicted[:1])[0]
    covariance = np.linalg.inv((slope * weight) @ slope.T + np.diag(1.0 / wide))
    return StudentTDensity(at, np.asarray(np.linalg.cholesky(_WIDENED**2 * covariance), dtype=np.float64))


def _temper_log_weights_to_n_effective(log_weight: FloatArray, least: float) -> FloatArray:
    """Scale log weights by the largest power, at most 1, that leaves an effective sample size of `least` or more."""
    low, high = 0.0, 1.0
    if n_effective(log_weight) >= least:
        return log_weight
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if n_effective(middle * log_weight) >= least else (low, middle)
    return low * log_weight


def _refitted_density(y: FloatArray, log_weight: FloatArray, before: StudentTDensity) -> StudentTDensity:
    """Fit a density to weighted draws; the fewer are effective, the more of the covariance of `before` is kept."""
    weight = np.exp(log_weight - logsumexp(log_weight))
    mean = weight @ y
    off = y - mean
    covariance = (off * weight[:, None]).T @ off
    kept = min(1.0, y.shape[1] / n_effective(log_weight))
    covariance = (1.0 - kept) * covariance + kept * before.root @ before.root.T
    return StudentTDensity(mean, np.linalg.cholesky(_WIDENED**2 * covariance))
