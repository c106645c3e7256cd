"""A user's own model, diagnosed like a sensor: any callable of parameters and plan."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from scipy.special import ndtr, ndtri

from probewise._arrays import FloatArray
from probewise._kinds import require_callable
from probewise.diagnosis.fitting.coordinates import LEAST_READINGS
from probewise.diagnosis.fitting.null import Null
from probewise.effects import VOCABULARY, NamedEffect
from probewise.errors import ParameterError, ShapeError
from probewise.priors import Prior, require_prior
from probewise.recordings.plan import Plan
from probewise.sensor import AnyEffect, Stage
from probewise.sensor.stages import effects_with_columns, parameter_names_of_effects

Parameters: TypeAlias = Mapping[str, FloatArray]
"""Parameters by name, each (n_samples, 1)."""

Simulate: TypeAlias = Callable[[Parameters, Plan], FloatArray]
"""Turns parameters and a plan into noise-free readings, (n_samples, n_points)."""

_N_STARTS = 8
_ON_READINGS = (Stage.OFFSET, Stage.LAG, Stage.SATURATION, Stage.NOISE)


@dataclass(frozen=True)
class OwnModel(Null):
    """A null model from a simulator and the prior of its parameters.

    Effects at the stages OFFSET, LAG, SATURATION and NOISE act on its readings. A user's own effect acts at
    `Stage.SCENE` on the parameters: it adds or changes some, which the simulator reads (with a default for missing
    ones, which is the model without the effect).

    Parameters
    ----------
    simulate
        Function of parameters by name, each (n_samples, 1), and a plan; returns readings, (n_samples, n_points).
    prior
        Prior of the parameters.
    """

    simulate: Simulate
    prior: Prior

    def __post_init__(self) -> None:
        order = "in the order OwnModel(simulate, prior)"
        require_callable("simulate", self.simulate, f"a function simulate(parameters, plan), {order}")
        require_prior("prior", self.prior)

    @property
    def n_params(self) -> int:
        """Number of parameters."""
        return len(self.prior.names)

    @cached_property
    def starts(self) -> FloatArray:
        """Starting points: the centre of the prior and quasi-random points, (8, n_params)."""
        from scipy.stats import qmc  # imported here, since it takes a second that a sensor's diagnosis does not need

        spread = qmc.Halton(self.n_params, scramble=False).random(_N_STARTS)[1:]
        return np.concatenate([np.zeros((1, self.n_params)), np.asarray(ndtri(spread), dtype=np.float64)])

    @property
    def least_readings(self) -> int:
        """Fewest usable readings for a verdict: three per parameter, at least 24."""
        return max(LEAST_READINGS, 3 * self.n_params)

    def admits(self, effect: NamedEffect[Any]) -> bool:
        """Return whether an effect acts on the readings, or is the user's own at `Stage.SCENE`."""
        own = effect.stage is Stage.SCENE and effect.name not in VOCABULARY
        return own or effect.stage in _ON_READINGS

    def theta(self, z: FloatArray) -> FloatArray:
        """Map standard-normal coordinates to parameters, (n_samples, n_params) both."""
        return self.prior.from_unit_cube(ndtr(z))

    def coordinates(self, theta: FloatArray) -> FloatArray:
        """Map parameters to standard-normal coordinates, (n_samples, n_params) both."""
        return np.asarray(ndtri(self.prior.to_unit_cube(theta)))

    def chain(self, plan: Plan, effects: Sequence[NamedEffect[Any]], *, n_nodes: int) -> _OwnModelWithEffects:
        """Return the model with effects; `n_nodes` is not used.

        Raises
        ------
        ParameterError
            If an effect acts at a stage that only a light sensor has.
        """
        wrong = [effect.name for effect in effects if not self.admits(effect)]
        if wrong:
            raise ParameterError("effects", wrong, "effects on the readings, or at Stage.SCENE on the parameters")
        return _OwnModelWithEffects(self, tuple(sorted(effects, key=lambda e: (e.stage, e.name))))


@dataclass(frozen=True)
class _OwnModelWithEffects:
    """A user's simulator with effects, as a chain: parameters, readings, offsets, lag, saturation."""

    model: OwnModel
    effects: tuple[AnyEffect, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The model's parameters, then each effect's as "effect.parameter"."""
        return (*self.model.prior.names, *parameter_names_of_effects(self.effects))

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        return self.readings_from_simulated_view(self.simulated_view(theta, plan), theta, plan)

    def simulated_view(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Simulate the readings before any effect on them, with the effects on the parameters: (n_samples, n_points).

        Raises
        ------
        ShapeError
            If the simulator's readings have another shape than (n_samples, n_points).
        """
        parameters: Parameters = {name: theta[:, k : k + 1] for k, name in enumerate(self.model.prior.names)}
        for effect, columns in self._effects_and_columns:
            if effect.stage is Stage.SCENE:
                parameters = effect.apply(parameters, theta[:, columns], plan)
        readings = np.asarray(self.model.simulate(parameters, plan), dtype=np.float64)
        if readings.shape != (len(theta), len(plan)):
            raise ShapeError(f"simulate gives {readings.shape}; allowed: {(len(theta), len(plan))}, samples x readings")
        return readings

    def readings_from_simulated_view(self, view: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        """Return a result of `simulated_view` with the effects on readings applied, (n_samples, n_points)."""
        for effect, columns in self._effects_and_columns:
            if Stage.OFFSET <= effect.stage <= Stage.SATURATION:
                view = effect.apply(view, theta[:, columns], plan)
        return view

    @cached_property
    def _effects_and_columns(self) -> list[tuple[AnyEffect, slice]]:
        return effects_with_columns(self.effects, self.model.n_params)
