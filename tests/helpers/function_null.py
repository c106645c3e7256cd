"""A null model from a function of named parameters and a plan, for tests of the engine that need no sensor."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from probewise.diagnosis.fit import Null
from probewise.sensor import Stage
from probewise.sensor.stages import effects_with_columns, parameter_names_of_effects

_ON_READINGS = (Stage.OFFSET, Stage.LAG, Stage.SATURATION, Stage.NOISE)


@dataclass(frozen=True)
class FunctionNull(Null):
    """`simulate(parameters, plan)` gives readings, (n_samples, n_points), of parameters (n_samples, 1) by name."""

    simulate: object
    prior: object
    least_readings: int = 24

    @property
    def n_params(self):
        return len(self.prior.names)

    @property
    def starts(self):
        return np.zeros((1, self.n_params))

    def admits(self, effect):
        return effect.stage in _ON_READINGS

    def theta(self, z):
        return self.prior.from_unit_cube(ndtr(z))

    def coordinates(self, theta):
        return np.asarray(ndtri(self.prior.to_unit_cube(theta)))

    def chain(self, plan, effects, *, n_nodes):
        return _FunctionChain(self, tuple(sorted(effects, key=lambda e: (e.stage, e.name))))


@dataclass(frozen=True)
class _FunctionChain:
    null: FunctionNull
    effects: tuple

    @property
    def names(self):
        return (*self.null.prior.names, *parameter_names_of_effects(self.effects))

    def predict(self, theta, plan):
        return self.readings_from_simulated_view(self.simulated_view(theta, plan), theta, plan)

    def simulated_view(self, theta, plan):
        parameters = {name: theta[:, k : k + 1] for k, name in enumerate(self.null.prior.names)}
        return np.asarray(self.null.simulate(parameters, plan) + np.zeros((len(theta), len(plan))))

    def readings_from_simulated_view(self, view, theta, plan):
        for effect, columns in effects_with_columns(self.effects, self.null.n_params):
            if Stage.OFFSET <= effect.stage <= Stage.SATURATION:
                view = effect.apply(view, theta[:, columns], plan)
        return view
