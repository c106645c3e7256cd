"""The posterior of an effect on the readings, over a grid of one of its parameters, such as a time constant.

The prior of its amplitude is a mixture of normal distributions. Fix one component of it and the value of the gridded
parameter, and replace the simulation by its tangent: all other parameters are then approximately jointly normal, and
their evidence is in closed form. A settling about as slow as what it is added to is an example: its amplitude and time
constant lie on a hyperbola, whose two branches no single normal distribution fits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Self

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.diagnosis.fitting.coordinates import FARTHEST
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.noise.law import NoiseLaw
from probewise.diagnosis.repair.linear_amplitudes import AmplitudeGroup, two_sided_amplitude_groups
from probewise.diagnosis.repair.linear_view import LinearView, acts_on_readings
from probewise.recordings.plan import Recording
from probewise.sensor.stages import effects_with_columns

_REACH = 10.0  # of the grid to either side of the fit, in sds of Laplace's approximation
_WIDER = 3.0  # factor on the reach until both ends of the grid are improbable
_IMPROBABLE = 10.0  # nats below the best node
_N_NODES = 161
_STEP = 1e-5  # for differences
_BLOCK = 2_000_000  # numbers in memory for one block of nodes


@dataclass(frozen=True, eq=False)
class ConditionallyLinearDensity:
    """A density of a fit's coordinates: a grid in one of them, and at each node a mixture of normals in the others.

    Those are the value of the effect's amplitude, in units of its typical size, and the straight coordinates (see
    `LinearView`) of every other parameter.

    Parameters
    ----------
    view
        The tangent of the simulation.
    at
        Index of the coordinate of the grid.
    amplitude
        The amplitude.
    nodes
        The grid, equally spaced, (n_nodes,).
    log_shares
        Log probability of each node and component, (n_nodes, n_components).
    means
        Means of the others, (n_nodes, n_components, n_params - 1).
    roots
        Lower Cholesky factors of their precisions, (n_nodes, n_components, n_params - 1, n_params - 1).
    """

    view: LinearView
    at: int
    amplitude: AmplitudeGroup
    nodes: FloatArray
    log_shares: FloatArray
    means: FloatArray
    roots: FloatArray

    @classmethod
    def of(cls, found: Fit, law: NoiseLaw, recording: Recording, covariance: FloatArray, sd: float) -> Self | None:
        """Return the density over the least known of the coordinates that can be gridded; None if there is none.

        It can be that of an effect on the readings, without change points, with one amplitude of either sign.

        Parameters
        ----------
        found, law, recording
            The fit, the law of its noise, and what was fitted.
        covariance
            Of the coordinates, by Laplace's approximation, (n_params, n_params).
        sd
            Of a whitened reading.
        """
        able = list(_grid_coordinates_with_amplitudes(found))
        if not able:
            return None
        view = LinearView.of(found)
        if view is None:
            return None
        at, amplitude = max(able, key=lambda each: covariance[each[0], each[0]])
        on_grid = partial(cls._on_grid, view, found, law, recording, sd, at, amplitude)
        reach = _REACH * math.sqrt(covariance[at, at])
        low, high = found.z[at] - reach, found.z[at] + reach
        while (out := on_grid(low, high)) is not None and not out._ends_are_improbable and high - low < 2 * FARTHEST:
            reach *= _WIDER
            low, high = max(found.z[at] - reach, -FARTHEST), min(found.z[at] + reach, FARTHEST)
        return None if out is None else on_grid(*out._probable_range)

    @classmethod
    def _on_grid(
        cls,
        view: LinearView,
        found: Fit,
        law: NoiseLaw,
        recording: Recording,
        sd: float,
        at: int,
        amplitude: AmplitudeGroup,
        low: float,
        high: float,
    ) -> Self | None:
        nodes = np.asarray(np.linspace(low, high, _N_NODES), dtype=np.float64)
        rest = np.delete(np.arange(len(found.z)), at)
        own = _number_without(at, amplitude.at[0])
        x = found.z[rest]
        x[own] = amplitude.values(found.z[None, list(amplitude.at)])[0, 0]
        moved = x + np.concatenate([np.zeros((1, len(x))), _STEP * np.eye(len(x))])
        points = np.tile(_inserted(moved, at, amplitude), (len(nodes), 1, 1))
        points[:, :, at] = nodes[:, None]
        sigma = law.likeliest_sigma(law(found.residuals)[:, None])
        n_at_once = max(1, _BLOCK // (len(moved) * len(found.residuals)))
        parts = [
            _quadratic_log_likelihood(view, law, recording, points[first : first + n_at_once], x, sigma, sd)
            for first in range(0, len(nodes), n_at_once)
        ]
        height, downhill, curvature = (np.concatenate(part) for part in zip(*parts, strict=True))
        if not (np.isfinite(height).all() and np.isfinite(curvature).all()):
            return None
        precision = np.ones((len(amplitude.sds), len(x)))
        precision[:, own] = amplitude.sds**-2.0
        every = curvature[:, None] + precision[:, :, None] * np.eye(len(x))
        roots = np.asarray(np.linalg.cholesky(every), dtype=np.float64)
        means = np.linalg.solve(every, downhill[:, None, :, None])[..., 0]
        volume = np.log(np.diagonal(roots, axis1=2, axis2=3)).sum(axis=2) - 0.5 * np.log(precision).sum(axis=1)
        log_prior = -0.5 * nodes**2
        log_shares = (height + log_prior)[:, None] + 0.5 * np.einsum("ncj,nj->nc", means, downhill) - volume
        return cls(view, at, amplitude, nodes, log_shares - logsumexp(log_shares), means, roots)

    @cached_property
    def _own(self) -> int:
        """Number of the amplitude among the coordinates without that of the grid."""
        return _number_without(self.at, self.amplitude.at[0])

    @cached_property
    def _probable_mask(self) -> BoolArray:
        """Mask of the nodes that are not improbable, (n_nodes,)."""
        of_nodes = logsumexp(self.log_shares, axis=1)
        return np.asarray(of_nodes > of_nodes.max() - _IMPROBABLE)

    @property
    def _ends_are_improbable(self) -> bool:
        # Not the outermost nodes alone: between two branches of a hyperbola is a narrow gap.
        n = len(self.nodes) // 8
        return not (self._probable_mask[:n].any() or self._probable_mask[-n:].any())

    @property
    def _probable_range(self) -> tuple[float, float]:
        """The range of the nodes that are not improbable, with one more on either side."""
        first, last = np.flatnonzero(self._probable_mask)[[0, -1]]
        return float(self.nodes[max(first - 1, 0)]), float(self.nodes[min(last + 1, len(self.nodes) - 1)])

    def draw(self, n_samples: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw coordinates, (n_samples, n_params)."""
        shares = np.exp(self.log_shares).ravel()
        node, component = np.divmod(
            rng.choice(len(shares), n_samples, p=shares / shares.sum()), self.log_shares.shape[1]
        )
        eps = rng.standard_normal((n_samples, self.means.shape[2], 1))
        apart = np.linalg.solve(self.roots[node, component].transpose(0, 2, 1), eps)[..., 0]
        value = self.nodes[node] + (rng.random(n_samples) - 0.5) * (self.nodes[1] - self.nodes[0])
        middle = self._interpolated_means(value)[np.arange(n_samples), component]
        out = _inserted(middle + apart, self.at, self.amplitude)
        out[:, self.at] = value
        return self.view.coordinates(out)

    def log_density(self, z: FloatArray) -> FloatArray:
        """Return the log density of coordinates, up to a constant, (n_samples, n_params) -> (n_samples,)."""
        x, at = np.delete(self.view.straightened(z), self.at, axis=1), list(self.amplitude.at)
        x[:, self._own] = self.amplitude.values(z[:, at])[:, 0]
        node = self._nearest_nodes(z[:, self.at])
        apart = x[:, None] - self._interpolated_means(z[:, self.at])
        eps = np.einsum("ncji,ncj->nci", self.roots[node], apart)
        volume = np.log(np.diagonal(self.roots[node], axis1=2, axis2=3)).sum(axis=2)
        in_values = logsumexp(self.log_shares[node] + volume - 0.5 * np.sum(eps**2, axis=2), axis=1)
        # From a density of the amplitude's value to that of its coordinate.
        log_prior = self.amplitude.log_prior_of_value(x[:, self._own])
        with np.errstate(invalid="ignore"):
            out = in_values - 0.5 * z[:, at[0]] ** 2 - log_prior + self.view.log_volume(z)
        # Outside the support of the null's prior: there the posterior is 0, whatever this density.
        return np.where(np.isfinite(out), out, 0.0)

    def _interpolated_means(self, value: FloatArray) -> FloatArray:
        """Return the means of all components at values of the grid's coordinate, (n, n_components, n_params - 1)."""
        position = (value - self.nodes[0]) / (self.nodes[1] - self.nodes[0])
        below = np.clip(np.floor(position), 0, len(self.nodes) - 2).astype(np.int64)
        share = (position - below)[:, None, None]
        return np.asarray((1 - share) * self.means[below] + share * self.means[below + 1])

    def _nearest_nodes(self, value: FloatArray) -> IntArray:
        spacing = self.nodes[1] - self.nodes[0]
        nearest = np.clip(np.rint((value - self.nodes[0]) / spacing), 0, len(self.nodes) - 1)
        return np.asarray(nearest, dtype=np.int64)


def _quadratic_log_likelihood(
    view: LinearView,
    law: NoiseLaw,
    recording: Recording,
    points: FloatArray,
    x: FloatArray,
    sigma: FloatArray,
    sd: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the log likelihood at x = 0, its gradient there and minus its second derivatives, at each node.

    `points` (n_nodes, n_rest + 1, n_params) are the coordinates of x, and of x moved along each of its n_rest axes;
    the result has shapes (n_nodes,), (n_nodes, n_rest), (n_nodes, n_rest, n_rest).
    """
    n, n_moved, n_params = points.shape
    predicted = view.predict(points.reshape(-1, n_params))[:, recording.usable]
    with np.errstate(all="ignore"):  # of predictions that ran away: not finite in the result
        whitened = law((recording.readings[recording.usable] - predicted).T).T.reshape(n, n_moved, -1)
        at_x, sigmas = whitened[:, 0].T, np.broadcast_to(sigma, n)
        height = -law.minus_log_likelihood(at_x, sigmas)
        normal = law.normal_pseudo_residuals(at_x, sigmas).T
        slopes = (whitened[:, :1] - whitened[:, 1:]) / (_STEP * sd)
        curvature, gradient = slopes @ slopes.transpose(0, 2, 1), np.einsum("nij,nj->ni", slopes, normal) / sd
    height = height - gradient @ x - 0.5 * np.einsum("i,nij,j->n", x, curvature, x)
    return height, gradient + curvature @ x, curvature


def _number_without(at: int, other: int) -> int:
    """Return the number of a coordinate among those without the one at `at`."""
    return other - (other > at)


def _inserted(x: FloatArray, at: int, amplitude: AmplitudeGroup) -> FloatArray:
    """Return coordinates, (n, n_params), of all but one in which an amplitude is a value, (n, n_params - 1)."""
    out, own = x.copy(), _number_without(at, amplitude.at[0])
    out[:, [own]] = amplitude.coordinates(x[:, [own]])
    return np.insert(out, at, 0.0, axis=1)


def _grid_coordinates_with_amplitudes(found: Fit) -> Iterator[tuple[int, AmplitudeGroup]]:
    """List the nonlinear coordinates of the effects on the readings that have one amplitude, which has either sign."""
    groups = {group.at: group for group in two_sided_amplitude_groups(found) if len(group.at) == 1}
    for effect, columns in effects_with_columns(found.model.effects, found.model.sensor.n_params):
        amplitudes = tuple(columns.start + k for k in effect.amplitudes)
        if acts_on_readings(effect) and not effect.has_change_point and amplitudes in groups:
            for at in range(columns.start, columns.stop):
                if at not in amplitudes:
                    yield at, groups[amplitudes]
