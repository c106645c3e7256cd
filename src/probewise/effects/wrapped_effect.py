"""Base of effects that wrap another effect and change its parameters, its prior, or its time."""

from __future__ import annotations

from typing import TypeVar

from probewise._arrays import FloatArray
from probewise.priors import Prior
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Effect, Stage

V = TypeVar("V")


class WrappedEffect(Effect[V]):
    """An effect that has everything from `effect`, except what a subclass overrides."""

    effect: Effect[V]

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def stage(self) -> Stage:
        return self.effect.stage

    @property
    def prior(self) -> Prior:
        """The prior of the wrapped effect."""
        return self.effect.prior

    def apply(self, value: V, theta: FloatArray, plan: Plan) -> V:
        return self.effect.apply(value, theta, plan)
