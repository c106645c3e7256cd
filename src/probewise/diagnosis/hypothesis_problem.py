"""A hypothesis as an inference problem for `probewise.nested`: a model in its coordinates, and a recording.

The likelihood of exchangeable Gaussians has every mode N! times. (The prior of three or more shares, given by their
ratios to the first, is not quite the same for all orders.) Folded onto the order nearest to a point, with the prior
density of all orders summed, the posterior has each mode once, and sampling need not hop between modes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
from scipy.special import logsumexp, ndtr, ndtri

from probewise._arrays import FloatArray, read_only_floats
from probewise.diagnosis.evidence import NoiseEvidence
from probewise.diagnosis.fit import FARTHEST, Model
from probewise.diagnosis.noise_law import NoiseLaw
from probewise.diagnosis.sensors import CalibratedSensor
from probewise.recordings.plan import Recording

NUMBERS = 4_000_000
"""Readings that are predicted at once."""

_HELD = 0.999  # share of the evidence in the noise nodes that are kept; the likelihood is rescaled for the rest


@dataclass(frozen=True, eq=False)
class StandardNormal:
    """The prior of a model's coordinates: independent standard normals, in which chains step directly."""

    n_params: int

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"z_{k + 1}" for k in range(self.n_params))

    @property
    def coordinates(self) -> StandardNormal:
        return self

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        return np.asarray(ndtri(u))

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        return np.asarray(ndtr(theta))

    def log_prob(self, theta: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * np.sum(theta**2 + math.log(2 * math.pi), axis=1))

    def enter(self, theta: FloatArray) -> FloatArray:
        return theta

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        return x, self.log_prob(x)


@dataclass(frozen=True, eq=False)
class HypothesisProblem:
    """A model in its coordinates with a recording; noise sd and parameters of the noise model are marginalised.

    Predictions of many samples are made in blocks, to fit in memory.

    `model`, `recording`: model and data; `noise`: evidence of a fit by node of the noise model (a set of its
    parameters); the probable nodes are averaged over; `near`: a point, (n_params,), such as its best fit, onto the
    nearest order of whose Gaussians the prior is folded. Predictions do not depend on the order, nor does the evidence.
    """

    model: Model
    recording: Recording
    noise: NoiseEvidence
    near: FloatArray | None = None

    @cached_property
    def prior(self) -> StandardNormal:
        """The prior of the model's coordinates, folded only if its sensor has exchangeable Gaussians."""
        sensor, n_params = self.model.sensor, self.model.n_params
        if self.near is None or not sensor.has_exchangeable_gaussians or sensor.n_gaussians < 2:
            return StandardNormal(n_params)
        return FoldedNormal(n_params, cast(CalibratedSensor, sensor), self.near)

    def predict(self, z: FloatArray) -> FloatArray:
        """Return the readings of all rows, (n_samples, n_params) -> (n_samples, n_points)."""
        return self._in_blocks(self.model.predict, z)

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Return the log likelihood, averaged over the kept noise nodes: (n_samples, n_params) -> (n_samples,)."""
        return self._in_blocks(self._log_likelihood_of_block, theta)

    def _in_blocks(self, function: Callable[[FloatArray], FloatArray], z: FloatArray) -> FloatArray:
        blocks = np.array_split(z, max(-(-len(z) * len(self.recording) // NUMBERS), 1))
        return np.concatenate([function(block) for block in blocks])

    def _log_likelihood_of_block(self, theta: FloatArray) -> FloatArray:
        usable = self.recording.usable
        predicted = self.model.predict(np.clip(theta, -FARTHEST, FARTHEST))[:, usable]
        nodes, kept = self.noise.nodes, self._kept_node_indices
        laws, log_share = [nodes.laws[node] for node in kept], -math.log(float(self.noise.weights[kept].sum()))
        with np.errstate(all="ignore"):  # of predictions that ran away: impossible below
            residuals = (self.recording.readings[usable] - predicted).T
            terms = [
                log_weight + log_likelihood_marginal_over_sigma(law, law(residuals))
                for log_weight, law in zip(nodes.log_weights[kept], laws, strict=True)
            ]
            out = np.asarray(logsumexp(terms, axis=0)) + log_share
        return np.where(np.isfinite(out), out, -np.inf)

    @cached_property
    def _kept_node_indices(self) -> list[int]:
        order = np.argsort(-self.noise.weights)
        n_kept = int(np.searchsorted(np.cumsum(self.noise.weights[order]), _HELD)) + 1
        kept: list[int] = order[:n_kept].tolist()
        return kept


def log_likelihood_marginal_over_sigma(law: NoiseLaw, whitened: FloatArray) -> FloatArray:
    """Return the log likelihood of whitened residuals (n_points, n_samples) under one noise distribution: (n_samples,).

    Log sigma, with a flat prior, is integrated out by Laplace's method about its peak.
    """
    n_points = law.n_kept
    sigma = law.likeliest_sigma(whitened)
    curvature = (
        law.whitened_density.log_sigma_curvature(whitened, sigma, n_points)
        if not law.whitened_density.is_normal
        else 2.0 * n_points
    )
    peak = -law.minus_log_likelihood(whitened, sigma) - 0.5 * n_points * math.log(2 * math.pi)
    return np.asarray(peak + 0.5 * np.log(2 * math.pi / curvature) - law.half_log_det() + law.log_extra)


@dataclass(frozen=True, eq=False)
class FoldedNormal(StandardNormal):
    """A standard normal prior, folded onto the order of a sensor's Gaussians that is nearest to a point.

    The density of a point is the sum of the normal's densities over all orders (permutations of the Gaussians).

    `n_params`: number of coordinates; `sensor`: sensor with exchangeable Gaussians; its coordinates come first; `near`:
    the point, (n_params,).
    """

    sensor: CalibratedSensor
    near: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "near", read_only_floats(self.near))

    @cached_property
    def _reordering_maps(self) -> tuple[FloatArray, FloatArray]:
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
        return self.fold(super().from_unit_cube(u))

    def log_prob(self, theta: FloatArray) -> FloatArray:
        images, far = self._reordered_with_distances(theta)
        density = logsumexp([super(FoldedNormal, self).log_prob(image) for image in images], axis=0)
        return np.where(far[0] <= far[1:].min(axis=0), density, -np.inf)
