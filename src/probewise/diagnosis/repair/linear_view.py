"""A model whose simulation is linearised; its effects on the readings are applied exactly."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.fitting.fit import Fit, Model, difference_points_and_steps
from probewise.effects import NamedEffect
from probewise.sensor import Stage

_STEP = 1e-6  # of a coordinate, for differences


@dataclass(frozen=True, eq=False)
class LinearView:
    """The tangent of what a model simulates before its effects on the readings.

    It is linear in straight coordinates. For a parameter of the null (the model without effects) that is a linear
    function of the parameter; for one of an effect it is its coordinate, whose prior is standard normal. Many
    simulations are linear in a parameter, such as a starting level, but not in the coordinate of its uniform prior.

    Parameters
    ----------
    model
        The model.
    z
        Coordinates at which the tangent touches, (n_params,).
    view
        What is simulated there, (n_points,).
    slopes
        Its derivatives, (n_params, n_points); 0 for coordinates of effects on the readings.
    """

    model: Model
    z: FloatArray
    view: FloatArray
    slopes: FloatArray

    @classmethod
    def of(cls, found: Fit) -> Self | None:
        """Return the tangent at a fit; None if the model does not simulate readings, or not all of them are finite.

        A light sensor simulates what each of its Gaussians sees. Also None where parameters have no coordinates of
        their own (`Null.coordinates`).
        """
        model, is_upstream = found.model, np.ones(found.model.n_params, dtype=np.bool_)
        for effect in filter(acts_on_readings, model.effects):
            is_upstream[model.coordinate_slice(effect.name)] = False
        upstream = np.flatnonzero(is_upstream)
        points, steps = difference_points_and_steps(found.z)
        theta = model.sensor.theta(found.z[None, : model.sensor.n_params])
        if model.sensor.coordinates(theta) is None:
            return None
        views = model.chain.simulated_view(model.theta(points[[0, *(1 + upstream)]]), model.plan)
        if not isinstance(views, np.ndarray) or not np.isfinite(views).all():
            return None
        slopes = np.zeros((model.n_params, views.shape[1]))
        slopes[upstream] = (views[1:] - views[0]) / steps[upstream, None]
        return cls(model, found.z, views[0], slopes)

    @cached_property
    def _n_own(self) -> int:
        return self.model.sensor.n_params

    def _theta_by_coordinates(self, z: FloatArray) -> FloatArray:
        """Return the derivative of each of the null's parameters by its coordinate, (n_samples, n_own)."""
        theta = self.model.sensor.theta
        return np.asarray((theta(z[:, : self._n_own] + _STEP) - theta(z[:, : self._n_own] - _STEP)) / (2 * _STEP))

    @cached_property
    def _theta_and_derivatives(self) -> tuple[FloatArray, FloatArray]:
        z = self.z[None]
        return self.model.sensor.theta(z[:, : self._n_own]), self._theta_by_coordinates(z)

    def straightened(self, z: FloatArray) -> FloatArray:
        """Return the straight coordinates of coordinates, (n_samples, n_params) both."""
        theta, derivatives = self._theta_and_derivatives
        own = self.z[: self._n_own] + (self.model.sensor.theta(z[:, : self._n_own]) - theta) / derivatives
        return np.concatenate([own, z[:, self._n_own :]], axis=1)

    def coordinates(self, straight: FloatArray) -> FloatArray:
        """Return the coordinates of straight ones, (n_samples, n_params) both; infinite outside the prior's support."""
        theta, derivatives = self._theta_and_derivatives
        own = self.model.sensor.coordinates(theta + (straight[:, : self._n_own] - self.z[: self._n_own]) * derivatives)
        assert own is not None
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


def acts_on_readings(effect: NamedEffect[Any]) -> bool:
    """Return whether an effect changes readings that are simulated already."""
    return effect.stage >= Stage.SEEN
