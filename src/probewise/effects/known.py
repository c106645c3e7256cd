"""An effect with fixed parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.wrapped import Wrapped
from probewise.errors import ParameterError
from probewise.priors import Empty
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Effect

__all__ = ["Known"]

V = TypeVar("V")


@dataclass(frozen=True)
class Known(Wrapped[V]):
    """Fix an effect's parameters, so that the robot can use a repaired sensor like any other.

    `values` are in the order of `effect.prior.names`.
    """

    effect: Effect[V]
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.values) != len(self.effect.prior.names):
            raise ParameterError("values", self.values, f"one number for each of {self.effect.prior.names}")

    @property
    def prior(self) -> Empty:
        """The empty prior: no free parameters."""
        return Empty()

    def apply(self, value: V, theta: FloatArray, plan: Plan) -> V:
        """Apply the effect with the fixed values; theta is (n_samples, 0)."""
        return self.effect.apply(value, np.array([self.values]), plan)
