"""The interface of null models, and of their predictions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

from probewise._arrays import FloatArray
from probewise.effects import NamedEffect
from probewise.recordings.plan import Plan
from probewise.sensor import AnyEffect


class Predictor(Protocol):
    """A model with its effects: a sensor's chain, or a user's own simulator.

    Columns of theta are named by `names`: the model's own, then each effect's in the order of `effects`.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, one per column of theta."""
        ...

    @property
    def effects(self) -> tuple[AnyEffect, ...]:
        """The model's effects, in the order in which they act."""
        ...

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Return noise-free readings, theta (n_samples, n_params) -> (n_samples, n_points)."""
        ...

    def simulated_view(self, theta: FloatArray, plan: Plan) -> Any:
        """Simulate the stages before `Stage.SEEN`: a sensor's view of the scene, for theta (1 or n_samples, n_params).

        For a simulator, these are its own readings, with the effects on inputs, parameters and rates.
        """
        ...

    def readings_from_simulated_view(self, view: Any, theta: FloatArray, plan: Plan) -> FloatArray:
        """Apply the effects from `Stage.SEEN` on to a result of `simulated_view`: readings (n_samples, n_points)."""
        ...


class Null(Protocol):
    """A model to be diagnosed, in coordinates in which its prior is a standard normal.

    The sensor of the paper (`GaussianMixtureSensor`), one with a free-form SSF (`FreeFormSensor`), a sensor over an
    unknown shape (`SensorAndShape`), or a simulator of a table (`systems.System`).
    """

    @property
    def n_params(self) -> int:
        """Number of coordinates."""
        ...

    @property
    def n_gaussians(self) -> int:
        """Number of Gaussians of its SSF; by default 0, for no SSF."""
        return 0

    @property
    def effective_n_gaussians(self) -> int:
        """Number of Gaussians that its SSF counts as, the measure of its complexity; by default 0."""
        return 0

    @property
    def ssf_in_words(self) -> str:
        """Description of its SSF, in words; by default empty."""
        return ""

    @property
    def has_exchangeable_gaussians(self) -> bool:
        """Whether permuting the Gaussians of its SSF changes neither prior nor predictions; by default False."""
        return False

    @property
    def predicts_in_bulk(self) -> bool:
        """Whether predictions of many samples cost little more than one; by default False."""
        return False

    @property
    def predicts_cheaply_nearby(self) -> bool:
        """Whether predictions near a point cost little once it was predicted itself; by default False."""
        return False

    @property
    def may_be_far_off(self) -> bool:
        """Whether a fit without a missing effect may be so far off that screening about it is no guide; else False."""
        return False

    @property
    def starts(self) -> FloatArray:
        """Coordinates to fit from, (n_starts, n_params)."""
        ...

    @property
    def nuisance_names(self) -> tuple[str, ...]:
        """Names of parameters that apply to this recording only, such as those of a shape; by default none.

        They are not part of a written sensor model.
        """
        return ()

    @property
    def least_readings(self) -> int:
        """Fewest usable readings for a verdict."""
        ...

    def admits(self, effect: NamedEffect[Any]) -> bool:
        """Return whether this model has the stage at which an effect acts."""
        ...

    def theta(self, z: FloatArray) -> FloatArray:
        """Map coordinates z, (n_samples, n_params), to the model's own parameters: theta without the effects'."""
        ...

    def coordinates(self, theta: FloatArray) -> FloatArray | None:
        """Map parameters of its own to coordinates, each of one parameter, (n_samples, n_params) both.

        None, the default, where a parameter has more than one coordinate, or is bounded by others.
        """
        return None

    def chain(self, plan: Plan, effects: Sequence[NamedEffect[Any]], *, n_nodes: int) -> Predictor:
        """Build the model of a plan's readings, with effects; `n_nodes` for curved edges, as in `sensor.Chain`."""
        ...


def log_multiplicity(null: Null) -> float:
    """Return log N! for N exchangeable Gaussians, whose permutations are modes of equal height; otherwise 0."""
    return math.lgamma(null.n_gaussians + 1) if null.has_exchangeable_gaussians else 0.0
