"""Posteriors in closed form of a fit whose model is partly linear: in amplitudes, and in what it simulates.

Readings are linear in an amplitude, but the coordinate of an amplitude with a heavy-tailed prior is a steep function of
its value about 0: a normal distribution of the coordinate there becomes one of values that is far too wide. Values with
one scale in common lie on arcs in their coordinates. Both priors are mixtures of normal distributions. Given the
components, the values are jointly normal; given the values, the components are independent. They are drawn in turn
(Gibbs sampling, `draws_of_linear_amplitudes`).

Fix one component of an amplitude and the value of another parameter of the effect, such as a time constant, and replace
the simulation by its tangent (`LinearView`): all other parameters are then approximately jointly normal, and their
evidence is in closed form (`ConditionallyLinearDensity`). A settling about as slow as what it is added to is an
example: its amplitude and time constant lie on a hyperbola, whose two branches no single normal distribution fits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.special import logsumexp, ndtr, ndtri

from probewise._arrays import FloatArray
from probewise.diagnosis.fit import DIFFERENCE, FARTHEST, Fit, difference_points_and_steps, with_prior
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
class _AmplitudeGroup:
    """Amplitudes with one component of the mixture in common: one alone, or values with one scale.

    `at` (n,): numbers of their coordinates; `prior`: theirs; `typical`: the unit of their values here; `sds`
    (n_components,): sds of the components, in typical sizes.
    """

    at: list[int]
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


def _two_sided_amplitude_groups(found: Fit) -> Iterator[_AmplitudeGroup]:
    """List the amplitudes of a fit's effects that may have either sign, values with one scale together."""
    for effect, columns in effects_with_columns(found.model.effects, found.model.sensor.n_params):
        own = effect.prior
        if isinstance(own, SharedScalePrior):
            every = [*range(columns.start, columns.stop)]
            yield _AmplitudeGroup(every, own, own.typical, own.component_sds / own.typical)
        marginals = list(getattr(own, "marginals", {}).values())
        for k in (k for k in effect.amplitudes if k < len(marginals)):
            one = marginals[k]
            if isinstance(one, HeavyTailedPrior) and not one.positive:
                alone = Product({own.names[k]: one})
                yield _AmplitudeGroup([columns.start + k], alone, one.typical, one.component_sds / one.typical)


def draws_of_linear_amplitudes(
    found: Fit, slopes: FloatArray, residual: FloatArray, n_samples: int, *, rng: np.random.Generator
) -> FloatArray | None:
    """Draw coordinates, (n_samples, n_params), from the linearised posterior of a fit, each the end of its own chain.

    None if no amplitude is wide in its coordinate. `slopes`, `residual`: whitened slopes (n_points, n_params) and
    residuals (n_points,), in noise sds. The unknowns x are the values of these amplitudes, in typical sizes, and the
    coordinates of all else.
    """
    z_sd = np.sqrt(np.diag(np.linalg.inv(with_prior(slopes.T @ slopes))))
    groups = [group for group in _two_sided_amplitude_groups(found) if np.any(z_sd[group.at] > _STRAIGHT)]
    if not groups:
        return None
    x, by_x = found.z.copy(), slopes.copy()
    for group in groups:
        at, steps = group.at, _STEP * np.eye(len(group.at))
        x[at] = group.values(found.z[None, at])[0]
        values_by_z = (group.values(found.z[at] + steps) - group.values(found.z[at] - steps)).T / (2 * _STEP)
        by_x[:, at] = np.linalg.solve(values_by_z.T, slopes[:, at].T).T
    curvature, downhill = by_x.T @ by_x, by_x.T @ (residual + by_x @ x)  # the latter at x = 0
    drawn, precision, own = np.tile(x, (n_samples, 1)), np.ones((n_samples, len(x))), np.arange(len(x))
    for _ in range(_SWEEPS):
        for group in groups:
            squares = np.sum(drawn[:, group.at] ** 2, axis=1)
            log_weight = -0.5 * squares[:, None] / group.sds**2 - len(group.at) * np.log(group.sds)
            component = np.argmax(log_weight + rng.gumbel(size=log_weight.shape), axis=1)
            precision[:, group.at] = group.sds[component, None] ** -2
        every = np.repeat(curvature[None], n_samples, axis=0)
        every[:, own, own] += precision + _ROUNDING * np.diag(curvature)
        # Of the mean plus a draw of covariance 1 / every: one solution with a right side of covariance `every`.
        noise = np.einsum("nij,nj->ni", np.linalg.cholesky(every), rng.standard_normal(drawn.shape))
        drawn = np.linalg.solve(every, (downhill + noise)[:, :, None])[:, :, 0]
    for group in groups:
        drawn[:, group.at] = group.coordinates(drawn[:, group.at])
    return drawn


class LinearView:
    """The tangent, at a fit, of what a simulator gives before the effects on its readings.

    It is linear in straight coordinates. For a parameter of the null (the model without effects) that is a linear
    function of the parameter; for one of an effect it is its coordinate, whose prior is standard normal. Many
    simulations are linear in a parameter, such as a starting level, but not in the coordinate of its uniform prior.
    """

    def __init__(self, found: Fit, system: System) -> None:
        self.model, self.system, self.z = found.model, system, found.z
        is_upstream = np.ones(found.model.n_params, dtype=np.bool_)
        for effect in filter(_acts_on_readings, self.model.effects):
            is_upstream[self.model.coordinate_slice(effect.name)] = False
        upstream = np.flatnonzero(is_upstream)
        points, steps = difference_points_and_steps(found.z)
        theta = self.model.theta(points[[0, *(1 + upstream)]])
        views = self.model.chain.simulated_view(theta, self.model.plan)
        self.view, self.is_finite = views[0], bool(np.isfinite(views).all())
        self.slopes = np.zeros((self.model.n_params, views.shape[1]))  # 0 for coordinates of effects on the readings
        with np.errstate(invalid="ignore"):
            self.slopes[upstream] = (views[1:] - views[0]) / steps[upstream, None]
        self.theta, self.derivatives = system.theta(self._own(found.z[None])), self._theta_by_z(found.z[None])

    def _own(self, z: FloatArray) -> FloatArray:
        return z[:, : self.system.n_params]

    def _theta_by_z(self, z: FloatArray) -> FloatArray:
        theta, own = self.system.theta, self._own(z)
        return np.asarray((theta(own + _STEP) - theta(own - _STEP)) / (2 * _STEP))

    def straightened(self, z: FloatArray) -> FloatArray:
        """Return the straight coordinates of coordinates, (n_samples, n_params) both."""
        own = self._own(self.z[None]) + (self.system.theta(self._own(z)) - self.theta) / self.derivatives
        return np.concatenate([own, z[:, self.system.n_params :]], axis=1)

    def coordinates(self, straight: FloatArray) -> FloatArray:
        """Return the coordinates of straight ones, (n_samples, n_params) both; infinite outside the prior's support."""
        theta = self.theta + (self._own(straight) - self._own(self.z[None])) * self.derivatives
        return np.concatenate([self.system.coordinates(theta), straight[:, self.system.n_params :]], axis=1)

    def log_volume(self, z: FloatArray) -> FloatArray:
        """Return the log of the volume of straight coordinates per volume of coordinates, (n_samples,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            stretched = np.log(np.abs(self._theta_by_z(z) / self.derivatives))
        return np.asarray(stretched.sum(axis=1))

    def predict(self, z: FloatArray) -> FloatArray:
        """Return approximate readings of each row, (n_samples, n_params) -> (n_samples, n_points)."""
        view = self.view + (self.straightened(z) - self.z) @ self.slopes
        return self.model.chain.readings_from_simulated_view(view, self.model.theta(z), self.model.plan)


def _acts_on_readings(effect: Effect) -> bool:
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

    `at`: index of the coordinate of the grid; `own`: that of the amplitude among the others; `nodes`: the grid, equally
    spaced, (n_nodes,); `log_shares`: log probability of each node and component, (n_nodes, n_components); `means` of
    the others, (n_nodes, n_components, n_params - 1); `roots`: lower Cholesky factors of their precisions.
    """

    view: LinearView
    at: int
    own: int
    amplitude: _AmplitudeGroup
    nodes: FloatArray
    log_shares: FloatArray
    means: FloatArray
    roots: FloatArray

    @classmethod
    def of(cls, found: Fit, law: NoiseLaw, recording: Recording, covariance: FloatArray, sd: float) -> Self | None:
        """Return the density over the least known of the coordinates that can be gridded; None if there is none.

        It can be a nonlinear one of an effect on the readings, without change points, whose one amplitude has either
        sign. None also of a light sensor, which simulates what each of its Gaussians sees, and where not all that is
        simulated is finite.

        `covariance`: of the coordinates, by Laplace's approximation, (n_params, n_params).
        """
        able, system = list(_grid_coordinates_with_amplitudes(found)), found.model.sensor
        if not able or not isinstance(system, System):
            return None
        view = LinearView(found, system)
        if not view.is_finite:
            return None
        at, amplitude = max(able, key=lambda each: covariance[each[0], each[0]])
        own = amplitude.at[0] - (amplitude.at[0] > at)
        x = np.delete(found.z, at)
        x[own] = amplitude.values(found.z[None, amplitude.at])[0, 0]
        moved = x + np.concatenate([np.zeros((1, len(x))), DIFFERENCE * np.eye(len(x))])
        precision = np.ones((len(amplitude.sds), len(x)))
        precision[:, own] = amplitude.sds**-2.0
        sigma, usable = law.likeliest_sigma(law(found.residuals)[:, None]), recording.usable
        n_at_once = max(1, _BLOCK // (len(moved) * len(found.residuals)))

        def quadratic_log_likelihood(nodes: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            """Return the log likelihood at x = 0, its gradient there and minus its second derivatives, by node."""
            points = np.tile(_inserted(moved, at, own, amplitude), (len(nodes), 1, 1))
            points[:, :, at] = nodes[:, None]
            predicted = view.predict(points.reshape(-1, len(found.z)))[:, usable]
            with np.errstate(all="ignore"):  # of predictions that ran away: not finite in the result
                whitened = law((recording.readings[usable] - predicted).T).T.reshape(*points.shape[:2], -1)
                at_x, sigmas = whitened[:, 0].T, np.broadcast_to(sigma, len(nodes))
                height = -law.minus_log_likelihood(at_x, sigmas)
                normal = law.normal_pseudo_residuals(at_x, sigmas).T
                slopes = (whitened[:, :1] - whitened[:, 1:]) / (DIFFERENCE * sd)
                curvature, gradient = slopes @ slopes.transpose(0, 2, 1), np.einsum("nij,nj->ni", slopes, normal) / sd
            height = height - gradient @ x - 0.5 * np.einsum("i,nij,j->n", x, curvature, x)
            return height, gradient + curvature @ x, curvature

        def on_grid(low: float, high: float) -> Self | None:
            nodes = np.asarray(np.linspace(low, high, _N_NODES), dtype=np.float64)
            parts = [quadratic_log_likelihood(nodes[k : k + n_at_once]) for k in range(0, len(nodes), n_at_once)]
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
        x, at = np.delete(self.view.straightened(z), self.at, axis=1), self.amplitude.at
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


def _inserted(x: FloatArray, at: int, own: int, amplitude: _AmplitudeGroup) -> FloatArray:
    out = x.copy()
    out[:, [own]] = amplitude.coordinates(x[:, [own]])
    return np.insert(out, at, 0.0, axis=1)


def _grid_coordinates_with_amplitudes(found: Fit) -> Iterator[tuple[int, _AmplitudeGroup]]:
    """List the nonlinear coordinates of the effects on the readings that have one amplitude, which has either sign."""
    groups = {group.at[0]: group for group in _two_sided_amplitude_groups(found) if len(group.at) == 1}
    for effect, columns in effects_with_columns(found.model.effects, found.model.sensor.n_params):
        amplitudes = [columns.start + k for k in effect.amplitudes]
        if (
            _acts_on_readings(effect)
            and not effect.has_change_point
            and len(amplitudes) == 1
            and amplitudes[0] in groups
        ):
            for at in range(columns.start, columns.stop):
                if at != amplitudes[0]:
                    yield at, groups[amplitudes[0]]
