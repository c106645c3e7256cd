"""Each Gaussian of an SSF under one name: the same evidence, and one peak where there were as many as orders of them.

The likelihood of exchangeable Gaussians has every peak N! times. (The prior of three shares and more, given by their
ratios to the first, is not quite the same for all orders.) Folded onto the order that is nearest to a point, with the
prior density of all orders summed, the posterior has each peak once. Sampling then has nothing to hop between: of
three Gaussians, one hardly needed, two hundred live points left the log evidence uncertain by five nats, and folded by
one.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import logsumexp, ndtri

from probewise._arrays import FloatArray, frozen
from probewise.diagnosis.evidence.joint import JointProblem, StandardNormal
from probewise.diagnosis.fitting.coordinates import SensorCoordinates

__all__ = ["Folded", "folded"]


@dataclass(frozen=True, eq=False)
class FoldedNormal:
    """A standard normal prior, folded onto the order of a sensor's Gaussians that is nearest to a point.

    Parameters
    ----------
    plain
        What is folded.
    sensor
        Whose Gaussians trade names; its coordinates come first.
    near
        The point, (n_params,).
    """

    plain: StandardNormal
    sensor: SensorCoordinates
    near: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "near", frozen(self.near))

    @property
    def names(self) -> tuple[str, ...]:
        """Those of the coordinates."""
        return self.plain.names

    @property
    def coordinates(self) -> FoldedNormal:
        """Its own."""
        return self

    @cached_property
    def _orders(self) -> list[tuple[int, ...]]:
        """All orders, as they stand first."""
        return list(itertools.permutations(range(self.sensor.n_gaussians)))

    def _images(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Give every order's coordinates, (n_orders, n_samples, n_params), and how far each is from the point."""
        n_own = self.sensor.n_params
        images = np.repeat(z[None], len(self._orders), axis=0)
        for image, order in zip(images[1:], self._orders[1:], strict=True):
            image[:, :n_own] = self.sensor.renamed(z[:, :n_own], order)
        return images, np.linalg.norm(images - self.near, axis=2)

    def fold(self, z: FloatArray) -> FloatArray:
        """Name the Gaussians in the order nearest to the point, (n_samples, n_params) both ways."""
        images, far = self._images(z)
        return np.asarray(images[np.argmin(far, axis=0), np.arange(len(z))])

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        """Map the unit cube to folded coordinates, (n_samples, n_params) both ways."""
        return self.fold(np.asarray(ndtri(u)))

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        """Give one of the points of the unit cube that lead there."""
        return self.plain.to_unit_cube(theta)

    def log_prob(self, theta: FloatArray) -> FloatArray:
        """Log density, (n_samples,): of all orders together, and -inf where another order is nearer."""
        images, far = self._images(theta)
        density = logsumexp([self.plain.log_prob(image) for image in images], axis=0)
        return np.where(far[0] <= far[1:].min(axis=0, initial=math.inf), density, -np.inf)

    def enter(self, theta: FloatArray) -> FloatArray:
        """Leave parameters as they are."""
        return theta

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Leave coordinates as they are, and give their log density."""
        return x, self.log_prob(x)


@dataclass(frozen=True, eq=False)
class Folded:
    """A problem under the folded prior; predictions do not ask for the order of Gaussians."""

    problem: JointProblem
    prior: FoldedNormal

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Ask the problem, (n_samples, n_params) -> (n_samples,)."""
        return self.problem.log_likelihood(theta)


def folded(problem: JointProblem, near: FloatArray) -> JointProblem | Folded:
    """Fold a problem onto the order of its Gaussians that is nearest to a point, such as its best fit.

    Parameters
    ----------
    problem
        As it is.
    near
        The point, (n_params,).

    Returns
    -------
    A problem of the same evidence; the problem itself where its sensor is no mixture whose names can be traded.
    """
    sensor = problem.model.sensor
    if not (isinstance(sensor, SensorCoordinates) and sensor.exchangeable and sensor.n_gaussians > 1):
        return problem
    return Folded(problem, FoldedNormal(problem.prior, sensor, near))
