"""Remove the label switching of an SSF's Gaussians: the same evidence, with one mode instead of N!.

The likelihood of exchangeable Gaussians has every mode N! times. (The prior of three or more shares, given by their
ratios to the first, is not quite the same for all orders.) Folded onto the order nearest to a point, with the prior
density of all orders summed, the posterior has each mode once, and sampling need not hop between modes.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray, read_only_floats
from probewise.diagnosis.evidence.hypothesis_problem import HypothesisProblem, StandardNormal
from probewise.diagnosis.fitting.coordinates import GaussianMixtureSensor


@dataclass(frozen=True, eq=False)
class FoldedNormal(StandardNormal):
    """A standard normal prior, folded onto the order of a sensor's Gaussians that is nearest to a point.

    The density of a point is the sum of the normal's densities over all orders (permutations of the Gaussians).

    Parameters
    ----------
    n_params
        Number of coordinates.
    sensor
        Sensor with exchangeable Gaussians; its coordinates come first.
    near
        The point, (n_params,).
    """

    sensor: GaussianMixtureSensor
    near: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "near", read_only_floats(self.near))

    @cached_property
    def _reordering_maps(self) -> tuple[FloatArray, FloatArray]:
        """Maps z @ turn + shift to every other order: turn (n_others, n_own, n_own), shift (n_others, 1, n_own)."""
        n_own = self.sensor.n_params
        orders = list(itertools.permutations(range(self.sensor.n_gaussians)))[1:]
        shift = np.stack([self.sensor.permuted(np.zeros((1, n_own)), order) for order in orders])
        return np.stack([self.sensor.permuted(np.eye(n_own), order) for order in orders]) - shift, shift

    def _reordered_with_distances(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z in every order, (n_orders, n_samples, n_params), and distances from the point; as given is first."""
        turn, shift = self._reordering_maps
        images = np.repeat(z[None], len(turn) + 1, axis=0)
        n_own = self.sensor.n_params
        images[1:, :, :n_own] = z[:, :n_own] @ turn + shift
        return images, np.linalg.norm(images - self.near, axis=2)

    def fold(self, z: FloatArray) -> FloatArray:
        """Reorder each sample's Gaussians to be nearest to the point, (n_samples, n_params) both ways."""
        images, far = self._reordered_with_distances(z)
        return np.asarray(images[np.argmin(far, axis=0), np.arange(len(z))])

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        """Map the unit cube to folded coordinates, (n_samples, n_params) both ways."""
        return self.fold(super().from_unit_cube(u))

    def log_prob(self, theta: FloatArray) -> FloatArray:
        """Return the log density summed over all orders, (n_samples,); -inf if another order is nearer."""
        images, far = self._reordered_with_distances(theta)
        density = logsumexp([super(FoldedNormal, self).log_prob(image) for image in images], axis=0)
        return np.where(far[0] <= far[1:].min(axis=0), density, -np.inf)


@dataclass(frozen=True, eq=False)
class FoldedProblem:
    """A `HypothesisProblem` with the folded prior; predictions do not depend on the order of the Gaussians."""

    problem: HypothesisProblem
    prior: FoldedNormal

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Return the log likelihood, (n_samples, n_params) -> (n_samples,)."""
        return self.problem.log_likelihood(theta)


def fold_problem(problem: HypothesisProblem, near: FloatArray) -> HypothesisProblem | FoldedProblem:
    """Fold a problem onto the order of its Gaussians that is nearest to a point, such as its best fit.

    Parameters
    ----------
    problem
        A hypothesis with its recording.
    near
        The point, (n_params,).

    Returns
    -------
    A problem with the same evidence; the problem itself if its sensor has no exchangeable Gaussians.
    """
    sensor = problem.model.sensor
    if not (isinstance(sensor, GaussianMixtureSensor) and sensor.has_exchangeable_gaussians and sensor.n_gaussians > 1):
        return problem
    return FoldedProblem(problem, FoldedNormal(problem.model.n_params, sensor, near))
