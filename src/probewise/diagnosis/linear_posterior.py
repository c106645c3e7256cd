"""Amplitudes of a fit, in which its model is linear: the linearised posterior of their values, and its other branches.

The coordinate of an amplitude with a heavy-tailed prior is a steep function of its value about 0: a normal distribution
of the coordinate there becomes one of values that is far too wide. Values with one scale in common lie on arcs in their
coordinates. Both priors are mixtures of normal distributions. Given the components, the values are jointly normal;
given the values, the components are independent. They are drawn in turn (Gibbs sampling).

A size and a shape, such as a time constant, have a posterior that is bent, and may have a branch of either sign. A
simulator that is called for each sample is replaced by its tangent there, about which the effect itself stays exact.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.special import ndtr, ndtri

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.fit import FARTHEST, Fit, Model, difference_points_and_steps, fit_each_start, with_prior
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
    """Amplitudes with one component of the mixture in common: one alone, or values with one scale."""

    at: list[int]  # their coordinates
    prior: Prior
    typical: float  # the unit of their values here
    sds: FloatArray  # of the components, in typical sizes, (n_components,)

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


def sizes_with_shape(found: Fit) -> list[int]:
    """List the coordinates of sizes of either sign, one of an effect on the readings, beside which it has a shape."""
    sizes, out = {group.at[0] for group in _two_sided_amplitude_groups(found) if len(group.at) == 1}, list[int]()
    for effect, columns in effects_with_columns(found.model.effects, found.model.sensor.n_params):
        own = {columns.start + k for k in effect.amplitudes}
        is_shaped = len(effect.prior.names) > 1 and not effect.has_change_point
        if is_shaped and acts_on_readings(effect) and len(own) == 1 and own <= sizes:
            out.extend(own)
    return out


def acts_on_readings(effect: Effect) -> bool:
    """Return whether an effect changes readings that are simulated already."""
    return effect.stage >= Stage.SEEN


_CREDIBLE = 10.0  # nats below the best mode, up to which another one counts


def modes_of_opposite_sign(model: Model | TangentModel, found: Fit, recording: Recording, law: NoiseLaw) -> list[Fit]:
    """Return fits where the size of an effect on the readings has the other sign than in a fit, if about as probable.

    A settling about as slow as what it is added to is an example: its size and time constant lie on a hyperbola, of
    which no walk from one branch finds the other.
    """
    sizes, own = sizes_with_shape(found), np.arange(len(found.z))
    starts = [np.where(own == at, -found.z, found.z) for at in sizes]
    fits = fit_each_start(cast(Model, model), recording, starts, law)
    return [
        other
        for at, other in zip(sizes, fits, strict=True)
        if other.objective < found.objective + _CREDIBLE and other.z[at] * found.z[at] < 0
    ]


class TangentModel:
    """A model of a simulator, with its tangent at a fit in place of what it simulates before effects on the readings.

    The tangent is taken in parameters of the null (the model without effects) and in coordinates of effects: many
    simulations are linear in a parameter, such as a starting level, but not in the coordinate of its uniform prior.
    """

    predicts_in_bulk, predicts_dearly = True, False

    def __init__(self, found: Fit, system: System) -> None:
        self.model, self.system, self.z, self.n_params = found.model, system, found.z, found.model.n_params
        upstream = np.ones(self.n_params, dtype=np.bool_)
        for effect in filter(acts_on_readings, self.model.effects):
            upstream[self.model.coordinate_slice(effect.name)] = False
        points, steps = difference_points_and_steps(found.z)
        views = self.model.chain.simulated_view(self.model.theta(points[np.append(True, upstream)]), self.model.plan)
        self.view, self.is_finite = views[0], bool(np.isfinite(views).all())
        self.slopes = np.zeros((self.n_params, views.shape[1]))  # 0 for coordinates of effects on the readings
        with np.errstate(invalid="ignore"):
            self.slopes[upstream] = (views[1:] - views[0]) / steps[upstream, None]
        own = found.z[None, : system.n_params]
        self.theta = system.theta(own)
        self.derivatives = (system.theta(own + _STEP) - system.theta(own - _STEP)) / (2 * _STEP)

    @property
    def sensor(self) -> TangentModel:
        """What tells that many predictions cost little: the model itself."""
        return self

    def predict_rows(self, rows: IntArray, z: FloatArray) -> FloatArray:
        """Return approximate readings of some rows, (n_samples, n_params) -> (n_samples, n_rows)."""
        moved, n_own = z - self.z, self.system.n_params
        moved[:, :n_own] = (self.system.theta(z[:, :n_own]) - self.theta) / self.derivatives
        view = self.view + moved @ self.slopes
        return self.model.chain.readings_from_simulated_view(view, self.model.theta(z), self.model.plan)[:, rows]
