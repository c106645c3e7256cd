"""Effects whose parameters are known: fixed, or with the prior that an earlier run leaves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import require
from probewise.priors import Marginal, Prior, Product
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
    def form(self) -> str:
        return str(getattr(self.effect, "form", ""))

    @property
    def prior(self) -> Prior:
        return self.effect.prior

    def apply(self, value: V, theta: FloatArray, plan: Plan) -> V:
        return self.effect.apply(value, theta, plan)


@dataclass(frozen=True)
class Known(WrappedEffect[V]):
    """An effect with fixed parameters, none of them free; `values` are in the order of `effect.prior.names`."""

    effect: Effect[V]
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        names = self.effect.prior.names
        require(len(self.values) == len(names), "values", self.values, f"one number for each of {names}")

    @property
    def prior(self) -> Product:
        return Product({})

    def apply(self, value: V, theta: FloatArray, plan: Plan) -> V:
        """Apply the effect with the fixed values; theta is (n_samples, 0)."""
        return self.effect.apply(value, np.array([self.values]), plan)


@dataclass(frozen=True)
class Informed(WrappedEffect[V]):
    """An effect with the prior `own`, from earlier knowledge of its parameters, in place of the usual prior."""

    effect: Effect[V]
    own: Prior

    @property
    def prior(self) -> Prior:
        return self.own


@dataclass(frozen=True)
class Estimated(Known[V]):
    """An effect fixed at an estimate of its parameters, which also holds their uncertainty.

    `marginals` are the distributions of the parameters, in the order of `values`. A run that trusts its sensor uses the
    values; one that doubts it infers the parameters along with the shape (`informed`).
    """

    marginals: tuple[Marginal, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        as_many = len(self.marginals) == len(self.values)
        require(as_many, "marginals", self.marginals, "as many as values, one for each")

    @property
    def informed(self) -> Informed[V]:
        """The effect with free parameters again, and `marginals` as its prior."""
        return Informed(self.effect, Product(dict(zip(self.effect.prior.names, self.marginals, strict=True))))
