"""Draws from the linearised posterior of a fit, in which amplitudes are linear in their value.

Readings are linear in an amplitude, but the coordinate of an amplitude with a heavy-tailed prior is a steep function of
its value about 0: a normal distribution of the coordinate there becomes one of values that is far too wide. Values with
one scale in common lie on arcs in their coordinates. Both priors are mixtures of normal distributions. Given the
components, the values are jointly normal; given the values, the components are independent. They are drawn in turn
(Gibbs sampling).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy.special import ndtr, ndtri

from probewise._arrays import FloatArray
from probewise.diagnosis.fitting.coordinates import FARTHEST
from probewise.diagnosis.fitting.fit import Fit
from probewise.effects import HeavyTailedPrior, NamedEffect
from probewise.effects.priors import SharedScalePrior
from probewise.priors import Prior, Product
from probewise.sensor.stages import effects_with_columns

_STRAIGHT = 0.2  # sd of a coordinate within which its value is as good as linear in it
_SWEEPS = 10
_STEP = 1e-6
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

    def log_prior_of_value(self, values: FloatArray) -> FloatArray:
        """Return the log prior density of values of one amplitude, in typical sizes, (n_samples,), up to a constant."""
        return np.asarray(self.prior.log_prob(values[:, None] * self.typical))

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

        Parameters
        ----------
        found
            The fit.
        slopes, residual
            Whitened slopes (n_points, n_params) and residuals (n_points,), in noise sds.
        """
        z_sd = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes + np.eye(len(found.z)))))
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

    def log_density(self, z: FloatArray) -> FloatArray:
        """Return the log density of coordinates, unnormalised, (n_samples, n_params) -> (n_samples,)."""
        x = z.copy()
        for group in self.groups:
            x[:, list(group.at)] = group.values(z[:, list(group.at)])
        likelihood = x @ self.downhill - 0.5 * np.einsum("ni,ij,nj->n", x, self.curvature, x)
        return np.asarray(likelihood - 0.5 * np.sum(z**2, axis=1))


def two_sided_amplitude_groups(found: Fit) -> Iterator[AmplitudeGroup]:
    """List the amplitudes of a fit's effects that may have either sign, values with one scale together."""
    for effect, columns in effects_with_columns(found.model.effects, found.model.sensor.n_params):
        own = effect.prior
        if isinstance(own, SharedScalePrior):
            every = tuple(range(columns.start, columns.stop))
            yield AmplitudeGroup(every, own, own.typical, own.component_sds / own.typical)
        for k, one in _two_sided_priors(effect).items():
            alone = Product({own.names[k]: one})
            yield AmplitudeGroup((columns.start + k,), alone, one.typical, one.component_sds / one.typical)


def _two_sided_priors(effect: NamedEffect[Any]) -> dict[int, HeavyTailedPrior]:
    """Return the heavy-tailed priors of the amplitudes that may have either sign, by the number of the parameter."""
    marginals = list(getattr(effect.prior, "marginals", {}).values())
    own = {k: marginals[k] for k in effect.amplitudes if k < len(marginals)}
    return {k: prior for k, prior in own.items() if isinstance(prior, HeavyTailedPrior) and not prior.positive}
