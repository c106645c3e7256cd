"""The kinds of hypotheses that a run weighs against each other: one for each shape that may lie there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray, IntArray, frozen
from probewise.inference.problem import Likelihood, SensorProblem
from probewise.priors import Joint, Prior
from probewise.recordings.plan import Plan, Recording
from probewise.scene.albedo import Shape
from probewise.scene.shapes import AnyOf
from probewise.sensor.stages import SensorModel

__all__ = ["Kind", "kinds_of"]


@dataclass(frozen=True, eq=False)
class Kind:
    """Hypotheses that share their parameters and differ in their values: a model of its own, with its own evidence.

    Attributes
    ----------
    name
        What the kind is called; empty where there is no other.
    log_prior
        Natural log of its probability before the first reading.
    prior, model, likelihood
        Of its own parameters.
    placed
        Writes its hypotheses, (n, n_own), as hypotheses of the whole experiment, (n, n_params): what they
        do not say follows the prior.
    whole_names
        Names of the experiment's parameters.
    """

    name: str
    log_prior: float
    prior: Prior
    model: SensorModel
    likelihood: Likelihood
    placed: Callable[[FloatArray, np.random.Generator], FloatArray]
    whole_names: tuple[str, ...]

    def problem(self, recording: Recording) -> SensorProblem:
        """Set up the inference of this kind from a recording."""
        return SensorProblem(self.prior, self.model, self.likelihood, recording)


def kinds_of(
    shape: Shape, sensor_prior: Prior | None, prior: Prior, model: SensorModel, likelihood: Likelihood
) -> Sequence[Kind]:
    """List the kinds of an experiment.

    Parameters
    ----------
    shape
        What may lie there: each shape of a set is a kind.
    sensor_prior
        Of the parameters before the shape's, which every kind has; or None.
    prior, model, likelihood
        Of all parameters of the experiment.
    """
    if not isinstance(shape, AnyOf):
        return (Kind("", 0.0, prior, model, likelihood, _as_they_are, prior.names),)
    n_sensor = 0 if sensor_prior is None else len(sensor_prior.names)
    kinds = []
    for k, (name, member) in enumerate(shape.shapes.items()):
        columns = np.concatenate([np.arange(n_sensor), n_sensor + shape.prior.columns[k]])
        own = member.prior if sensor_prior is None else Joint((sensor_prior, member.prior))
        middle = prior.from_unit_cube(np.full((1, len(prior.names)), 0.5))[0]
        middle[n_sensor] = k + 0.5
        part = _Part(model, own.names, columns, frozen(middle))
        place = _Place(prior, n_sensor, k, columns)
        kinds.append(Kind(name, float(np.log(shape.weights[k])), own, part, likelihood, place, prior.names))
    return tuple(kinds)


def _as_they_are(theta: FloatArray, rng: np.random.Generator) -> FloatArray:
    return theta


@dataclass(frozen=True, eq=False)
class _Part:
    """A model of which some parameters are asked; the others, which make no difference, stay as they are."""

    whole: SensorModel
    names: tuple[str, ...]
    columns: IntArray
    others: FloatArray

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """See `SensorModel.predict`."""
        full = np.tile(self.others, (len(theta), 1))
        full[:, self.columns] = theta
        return self.whole.predict(full, plan)


@dataclass(frozen=True, eq=False)
class _Place:
    """Writes hypotheses of one shape among those of a set."""

    prior: Prior
    shape_column: int
    number: int
    columns: IntArray

    def __call__(self, theta: FloatArray, rng: np.random.Generator) -> FloatArray:
        u = rng.random((len(theta), len(self.prior.names)))
        full = self.prior.from_unit_cube(u)
        full[:, self.shape_column] = self.number + u[:, self.shape_column]
        full[:, self.columns] = theta
        return np.asarray(full)
