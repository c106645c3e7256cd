"""Posteriors in closed form of a fit whose model is partly linear: in amplitudes, and in what it simulates.

Readings are linear in an amplitude, but the coordinate of an amplitude with a heavy-tailed prior is a steep function of
its value about 0: a normal distribution of the coordinate there becomes one of values that is far too wide. Values with
one scale in common lie on arcs in their coordinates. Both priors are mixtures of normal distributions. Given the
components, the values are jointly normal; given the values, the components are independent. They are drawn in turn
(Gibbs sampling, `LinearAmplitudes`).

Fix one component of an amplitude and the value of another parameter of the effect, such as a time constant, and replace
the simulation by its tangent (`LinearView`): all other parameters are then approximately jointly normal, and their
evidence is in closed form (`ConditionallyLinearDensity`). A settling about as slow as what it is added to is an
example: its amplitude and time constant lie on a hyperbola, whose two branches no single normal distribution fits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from scipy.special import logsumexp, ndtr, ndtri

from probewise._arrays import FloatArray
from probewise.diagnosis.fit import DIFFERENCE, FARTHEST, Fit, Model, difference_points_and_steps, with_prior
from probewise.diagnosis.noise import NoiseLaw
from probewise.effects import Effect, HeavyTailedPrior
from probewise.priors import Prior, Product, SharedScalePrior
from probewise.recordings.plan import Recording
from probewise.sensor import Stage
from probewise.sensor.stages import effects_with_columns
from probewise.systems import System

_STRAIGHT = 0.2  # sd of a coordinate within which its value is as good as linear in it
_SWEEPS = 10
_STEP = 1e-6  # of a coordinate, for central differences of priors
_ROUNDING = 1e-12  # of the curvature, by which that of readings fitted exactly may fail to be positive


@dataclass(frozen=True, eq=False)
class AmplitudeGroup:
    """Amplitudes with one component of the mixture in common: one alone, or values with one scale.

    `at` (n,): numbers of their coordinates; `prior`: theirs; `typical`: the unit of their values here; `sds`
    (n_components,): sds of the components, in typical sizes.
    """

    at: tuple[int, ...]
    prior: Prior
    typical: float
    sds: FloatArray

    def values(self, z: FloatArray) -> FloatArray:
        """Return the values, in typical sizes, from coordinates, (n_samples, n) both."""
        return self.prior.from_unit_cube(ndtr(z)) / self.typical

    def coordinates(self, values: FloatArray) -> FloatArray:
        """Return the coordinates of values in typical sizes, (n_samples, n) both."""
        unit = self.prior.to_unit_cube(values * self.typical)
        return np.asarray(np.clip(ndtri(unit), -FARTHEST, FARTHEST))

    def values_by_coordinates(self, z: FloatArray) -> FloatArray:
        """Return the derivatives of the values by the coordinates at z (n,), (n, n)."""
        steps = _STEP * np.eye(len(z))
        return np.asarray((self.values(z + steps) - self.values(z - steps)).T / (2 * _STEP))


@dataclass(frozen=True, eq=False)
class LinearAmplitudes:
    """The linearised posterior of a fit of whose amplitudes some are wide in their coordinate.

    The unknowns x (n_params,) are the values of these amplitudes, in typical sizes, and the coordinates of all else.
    `x`: those of the fit; `curvature` (n_params, n_params) and `downhill` (n_params,) are those of minus the log
    likelihood by x, the latter at x = 0.
    """

    groups: tuple[AmplitudeGroup, ...]
    x: FloatArray
    curvature: FloatArray
    downhill: FloatArray

    @classmethod
    def of(cls, found: Fit, slopes: FloatArray, residual: FloatArray) -> Self | None:
        """Find the amplitudes of a fit that are wide in their coordinate; None if there is none.

        `slopes`, `residual`: whitened slopes (n_points, n_params) and residuals (n_points,), in noise sds.
        """
        z_sd = np.sqrt(np.diag(np.linalg.inv(with_prior(slopes.T @ slopes))))
        groups = tuple(group for group in two_sided_amplitude_groups(found) if np.any(z_sd[list(group.at)] > _STRAIGHT))
        if not groups:
            return None
        x, by_x = found.z.copy(), slopes.copy()
        for group in groups:
            at = list(group.at)
            x[at] = group.values(found.z[None, at])[0]
            by_x[:, at] = np.linalg.solve(group.values_by_coordinates(found.z[at]).T, slopes[:, at].T).T
        return cls(groups, x, by_x.T @ by_x, by_x.T @ (residual + by_x @ x))

    def draw(self, n_samples: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw coordinates, (n_samples, n_params), each the end of a chain of its own."""
        drawn, precision = np.tile(self.x, (n_samples, 1)), np.ones((n_samples, len(self.x)))
        own = np.arange(len(self.x))
        for _ in range(_SWEEPS):
            for group in self.groups:
                at, sds = list(group.at), group.sds
                squares = np.sum(drawn[:, at] ** 2, axis=1)
                log_weight = -0.5 * squares[:, None] / sds**2 - len(at) * np.log(sds)
                component = np.argmax(log_weight + rng.gumbel(size=log_weight.shape), axis=1)
                precision[:, at] = sds[component, None] ** -2
            every = np.repeat(self.curvature[None], n_samples, axis=0)
            every[:, own, own] += precision + _ROUNDING * np.diag(self.curvature)
            # Of the mean plus a draw of covariance 1 / every: one solution with a right side of covariance `every`.
            root = np.linalg.cholesky(every)
            noise = np.einsum("nij,nj->ni", root, rng.standard_normal(drawn.shape))
            drawn = np.linalg.solve(every, (self.downhill + noise)[:, :, None])[:, :, 0]
        for group in self.groups:
            drawn[:, list(group.at)] = group.coordinates(drawn[:, list(group.at)])
        return drawn


def two_sided_amplitude_groups(found: Fit) -> Iterator[AmplitudeGroup]:
    """List the amplitudes of a fit's effects that may have either sign, values with one scale together."""
    for effect, columns in effects_with_columns(found.model.effects, found.model.sensor.n_params):
        own = effect.prior
        if isinstance(own, SharedScalePrior):
            every = tuple(range(columns.start, columns.stop))
            yield AmplitudeGroup(every, own, own.typical, own.component_sds / own.typical)
        marginals = list(getattr(own, "marginals", {}).values())
        for k in (k for k in effect.amplitudes if k < len(marginals)):
            one = marginals[k]
            if isinstance(one, HeavyTailedPrior) and not one.positive:
                alone = Product({own.names[k]: one})
                yield AmplitudeGroup((columns.start + k,), alone, one.typical, one.component_sds / one.typical)


@dataclass(frozen=True, eq=False)
class LinearView:
    """The tangent of what a model simulates before its effects on the readings.

    It is linear in straight coordinates. For a parameter of the null (the model without effects) that is a linear
    function of the parameter; for one of an effect it is its coordinate, whose prior is standard normal. Many
    simulations are linear in a parameter, such as a starting level, but not in the coordinate of its uniform prior.

    `model`: the model, of the simulator `system`; `z`: coordinates at which the tangent touches, (n_params,); `view`:
    what is simulated there, (n_points,); `slopes`: its derivatives, (n_params, n_points); 0 for coordinates of effects
    on the readings.
    """

    model: Model
    system: System
    z: FloatArray
    view: FloatArray
    slopes: FloatArray

    @classmethod
    def of(cls, found: Fit) -> Self | None:
        """Return the tangent at a fit of a simulator; None if not all of its readings are finite, or for a sensor.

        A light sensor simulates what each of its Gaussians sees.
        """
        if not isinstance(found.model.sensor, System):
            return None
        model, is_upstream = found.model, np.ones(found.model.n_params, dtype=np.bool_)
        for effect in filter(acts_on_readings, model.effects):
            is_upstream[model.coordinate_slice(effect.name)] = False
        upstream = np.flatnonzero(is_upstream)
        points, steps = difference_points_and_steps(found.z)
        views = model.chain.simulated_view(model.theta(points[[0, *(1 + upstream)]]), model.plan)
        if not np.isfinite(views).all():
            return None
        slopes = np.zeros((model.n_params, views.shape[1]))
        slopes[upstream] = (views[1:] - views[0]) / steps[upstream, None]
        return cls(model, found.model.sensor, found.z, views[0], slopes)

    @cached_property
    def _n_own(self) -> int:
        return self.system.n_params

    def _theta_by_coordinates(self, z: FloatArray) -> FloatArray:
        theta = self.system.theta
        return np.asarray((theta(z[:, : self._n_own] + _STEP) - theta(z[:, : self._n_own] - _STEP)) / (2 * _STEP))

    @cached_property
    def _theta_and_derivatives(self) -> tuple[FloatArray, FloatArray]:
        z = self.z[None]
        return self.system.theta(z[:, : self._n_own]), self._theta_by_coordinates(z)

    def straightened(self, z: FloatArray) -> FloatArray:
        """Return the straight coordinates of coordinates, (n_samples, n_params) both."""
        theta, derivatives = self._theta_and_derivatives
        own = self.z[: self._n_own] + (self.system.theta(z[:, : self._n_own]) - theta) / derivatives
        return np.concatenate([own, z[:, self._n_own :]], axis=1)

    def coordinates(self, straight: FloatArray) -> FloatArray:
        """Return the coordinates of straight ones, (n_samples, n_params) both; infinite outside the prior's support."""
        theta, derivatives = self._theta_and_derivatives
        own = self.system.coordinates(theta + (straight[:, : self._n_own] - self.z[: self._n_own]) * derivatives)
        return np.concatenate([own, straight[:, self._n_own :]], axis=1)

    def log_volume(self, z: FloatArray) -> FloatArray:
        """Return the log of the volume of straight coordinates per volume of coordinates, (n_samples,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            stretched = np.log(np.abs(self._theta_by_coordinates(z) / self._theta_and_derivatives[1]))
        return np.asarray(stretched.sum(axis=1))

    def predict(self, z: FloatArray) -> FloatArray:
        """Return approximate readings of each row, (n_samples, n_params) -> (n_samples, n_points)."""
        view = self.view + (self.straightened(z) - self.z) @ self.slopes
        return self.model.chain.readings_from_simulated_view(view, self.model.theta(z), self.model.plan)


def acts_on_readings(effect: Effect) -> bool:
    """Return whether an effect changes readings that are simulated already."""
    return effect.stage >= Stage.SEEN


_REACH = 10.0  # of the grid to either side of the fit, in sds of Laplace's approximation
_WIDER = 3.0  # factor on the reach until both ends of the grid are improbable
_IMPROBABLE = 10.0  # nats below the best node
_N_NODES = 161
_BLOCK = 2_000_000  # numbers in memory for one block of nodes


@dataclass(frozen=True, eq=False)
class ConditionallyLinearDensity:
    """A density of a fit's coordinates: a grid in one of them, and at each node a mixture of normals in the others.

    Those are the value of the effect's amplitude, in units of its typical size, and the straight coordinates (see
    `LinearView`) of every other parameter.

    `view`: the tangent of the simulation; `at`: index of the coordinate of the grid; `own`: that of the amplitude among
    the others; `amplitude`: the amplitude; `nodes`: the grid, equally spaced, (n_nodes,); `log_shares`: log probability
    of each node and component, (n_nodes, n_components); `means`: means of the others, (n_nodes, n_components, n_params
    - 1); `roots`: lower Cholesky factors of their precisions, (n_nodes, n_components, n_params - 1, n_params - 1).
    """

    view: LinearView
    at: int
    own: int
    amplitude: AmplitudeGroup
    nodes: FloatArray
    log_shares: FloatArray
    means: FloatArray
    roots: FloatArray

    @classmethod
    def of(cls, found: Fit, law: NoiseLaw, recording: Recording, covariance: FloatArray, sd: float) -> Self | None:
        """Return the density over the least known of the coordinates that can be gridded; None if there is none.

        It can be that of an effect on the readings, without change points, with one amplitude of either sign.

        `covariance`: of the coordinates, by Laplace's approximation, (n_params, n_params).
        """
        able = list(_grid_coordinates_with_amplitudes(found))
        view = LinearView.of(found) if able else None
        if view is None:
            return None
        at, amplitude = max(able, key=lambda each: covariance[each[0], each[0]])
        own = amplitude.at[0] - (amplitude.at[0] > at)
        x = np.delete(found.z, at)
        x[own] = amplitude.values(found.z[None, list(amplitude.at)])[0, 0]
        moved = x + np.concatenate([np.zeros((1, len(x))), DIFFERENCE * np.eye(len(x))])
        precision = np.ones((len(amplitude.sds), len(x)))
        precision[:, own] = amplitude.sds**-2.0
        sigma = law.likeliest_sigma(law(found.residuals)[:, None])
        n_at_once = max(1, _BLOCK // (len(moved) * len(found.residuals)))

        def on_grid(low: float, high: float) -> Self | None:
            nodes = np.asarray(np.linspace(low, high, _N_NODES), dtype=np.float64)
            points = np.tile(_inserted(moved, at, own, amplitude), (len(nodes), 1, 1))
            points[:, :, at] = nodes[:, None]
            parts = [
                _quadratic_log_likelihood(view, law, recording, points[first : first + n_at_once], x, sigma, sd)
                for first in range(0, len(nodes), n_at_once)
            ]
            height, downhill, curvature = (np.concatenate(part) for part in zip(*parts, strict=True))
            if not (np.isfinite(height).all() and np.isfinite(curvature).all()):
                return None
            every = curvature[:, None] + precision[:, :, None] * np.eye(len(x))
            roots = np.asarray(np.linalg.cholesky(every), dtype=np.float64)
            means = np.linalg.solve(every, downhill[:, None, :, None])[..., 0]
            volume = np.log(np.diagonal(roots, axis1=2, axis2=3)).sum(axis=2) - 0.5 * np.log(precision).sum(axis=1)
            log_prior = -0.5 * nodes**2
            log_shares = (height + log_prior)[:, None] + 0.5 * np.einsum("ncj,nj->nc", means, downhill) - volume
            return cls(view, at, own, amplitude, nodes, log_shares - logsumexp(log_shares), means, roots)

        reach = _REACH * math.sqrt(covariance[at, at])
        low, high = found.z[at] - reach, found.z[at] + reach
        while (out := on_grid(low, high)) is not None:
            of_nodes = logsumexp(out.log_shares, axis=1)
            probable = np.flatnonzero(of_nodes > of_nodes.max() - _IMPROBABLE)
            # Not the outermost nodes alone: between two branches of a hyperbola is a narrow gap.
            if (probable[0] >= _N_NODES // 8 and probable[-1] < _N_NODES - _N_NODES // 8) or high - low >= 2 * FARTHEST:
                first, last = max(probable[0] - 1, 0), min(probable[-1] + 1, _N_NODES - 1)  # one more on either side
                return on_grid(float(out.nodes[first]), float(out.nodes[last]))
            reach *= _WIDER
            low, high = max(found.z[at] - reach, -FARTHEST), min(found.z[at] + reach, FARTHEST)
        return None

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
        out = _inserted(middle + apart, self.at, self.own, self.amplitude)
        out[:, self.at] = value
        return self.view.coordinates(out)

    def log_density(self, z: FloatArray) -> FloatArray:
        """Return the log density of coordinates, up to a constant, (n_samples, n_params) -> (n_samples,)."""
        x, at = np.delete(self.view.straightened(z), self.at, axis=1), list(self.amplitude.at)
        x[:, self.own] = self.amplitude.values(z[:, at])[:, 0]
        steps = np.rint((z[:, self.at] - self.nodes[0]) / (self.nodes[1] - self.nodes[0]))
        node = np.clip(steps, 0, len(self.nodes) - 1).astype(np.int64)
        apart = x[:, None] - self._interpolated_means(z[:, self.at])
        eps = np.einsum("ncji,ncj->nci", self.roots[node], apart)
        volume = np.log(np.diagonal(self.roots[node], axis1=2, axis2=3)).sum(axis=2)
        in_values = logsumexp(self.log_shares[node] + volume - 0.5 * np.sum(eps**2, axis=2), axis=1)
        # From a density of the amplitude's value to that of its coordinate.
        log_prior = self.amplitude.prior.log_prob(x[:, [self.own]] * self.amplitude.typical)
        with np.errstate(invalid="ignore"):
            out = in_values - 0.5 * z[:, at[0]] ** 2 - log_prior + self.view.log_volume(z)
        # Outside the support of the null's prior: there the posterior is 0, whatever this density.
        return np.where(np.isfinite(out), out, 0.0)

    def _interpolated_means(self, value: FloatArray) -> FloatArray:
        position = (value - self.nodes[0]) / (self.nodes[1] - self.nodes[0])
        below = np.clip(np.floor(position), 0, len(self.nodes) - 2).astype(np.int64)
        share = (position - below)[:, None, None]
        return np.asarray((1 - share) * self.means[below] + share * self.means[below + 1])


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
        slopes = (whitened[:, :1] - whitened[:, 1:]) / (DIFFERENCE * sd)
        curvature, gradient = slopes @ slopes.transpose(0, 2, 1), np.einsum("nij,nj->ni", slopes, normal) / sd
    height = height - gradient @ x - 0.5 * np.einsum("i,nij,j->n", x, curvature, x)
    return height, gradient + curvature @ x, curvature


def _inserted(x: FloatArray, at: int, own: int, amplitude: AmplitudeGroup) -> FloatArray:
    out = x.copy()
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
