"""What is believed to be the whole truth until shown otherwise, and how the diagnosis talks to it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

from probewise._arrays import FloatArray
from probewise.effects import NamedEffect
from probewise.recordings.plan import Plan
from probewise.sensor import AnyEffect

__all__ = ["Null", "Predictor", "log_multiplicity"]


class Predictor(Protocol):
    """A model with its effects: a sensor's chain, or a user's own simulator.

    Columns of theta are named by `names`: the model's own, then each effect's in the order of `effects`.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, one a column of theta."""
        ...

    @property
    def effects(self) -> tuple[AnyEffect, ...]:
        """Its effects, in the order in which they act."""
        ...

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Noise-free readings, theta (n_samples, n_params) -> (n_samples, n_points)."""
        ...

    def look(self, theta: FloatArray, plan: Plan) -> Any:
        """Go the way up to the stage SEEN; of one hypothesis or of all."""
        ...

    def read(self, view: Any, theta: FloatArray, plan: Plan) -> FloatArray:
        """Go on from what `look` gave, with the effects from SEEN on: (n_samples, n_points)."""
        ...


class Null(Protocol):
    """A model to be diagnosed, in coordinates in which its prior is a standard normal.

    The sensor of the paper (`SensorCoordinates`), one whose SSF has any form (`FreeForm`), a sensor
    over a shape that is not known (`SensorAndShape`), or any simulator (`OwnModel`).
    """

    @property
    def n_params(self) -> int:
        """Number of coordinates."""
        ...

    @property
    def n_gaussians(self) -> int:
        """Number of Gaussians of its SSF; by default 0, there is none."""
        return 0

    @property
    def degrees_of_freedom(self) -> int:
        """Effective degrees of freedom of its SSF, counted in Gaussians; by default none."""
        return 0

    @property
    def form(self) -> str:
        """What its SSF is, in words; by default nothing."""
        return ""

    @property
    def exchangeable(self) -> bool:
        """Whether the Gaussians of its SSF can trade names; by default there are none."""
        return False

    @property
    def in_bulk(self) -> bool:
        """Whether predictions of many samples cost little more than one; by default they do not."""
        return False

    @property
    def starts(self) -> FloatArray:
        """Coordinates to fit from, (n_starts, n_params)."""
        ...

    @property
    def nuisance(self) -> tuple[str, ...]:
        """Names of parameters that belong to this recording alone, such as a shape's; by default none.

        No sensor model keeps them.
        """
        return ()

    @property
    def least_readings(self) -> int:
        """Fewest usable readings that a verdict is given on."""
        ...

    def admits(self, effect: NamedEffect[Any]) -> bool:
        """Tell whether an effect acts at a stage that this model has."""
        ...

    def theta(self, z: FloatArray) -> FloatArray:
        """Map coordinates, (n_samples, n_params), to the columns that precede the effects'."""
        ...

    def chain(self, plan: Plan, effects: Sequence[NamedEffect[Any]], *, n_nodes: int) -> Predictor:
        """Build the model of a plan's readings, with effects; `n_nodes` over curved edges, as `sensor.Chain` has it."""
        ...


def log_multiplicity(null: Null) -> float:
    """Log of the number of peaks of the posterior that are one and the same sensor, taken to be of the same height."""
    return math.lgamma(null.n_gaussians + 1) if null.exchangeable else 0.0
