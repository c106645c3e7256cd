"""How readings scatter: effects on the noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.extent import Extent
from probewise.effects.vocabulary import NoiseEffect, give_or_take
from probewise.priors import LogUniform, Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import NoiseLevel, Stage

__all__ = ["CorrelatedNoise", "DriftingNoise", "SignalDependentNoise"]


@dataclass(frozen=True)
class CorrelatedNoise(NoiseEffect):
    """Noise with a memory, AR(1) within a scan: e_k = rho e_(k-1) + new noise."""

    lowest: float = -0.5
    highest: float = 0.95

    name: ClassVar[str] = "correlated_noise"
    stage: ClassVar[Stage] = Stage.NOISE
    units: ClassVar[tuple[str, ...]] = ("1",)
    covariates: ClassVar[tuple[str, ...]] = ("scan",)
    amplitudes: ClassVar[tuple[int, ...]] = (0,)
    n_nodes: ClassVar[int] = 28  # close enough to integrate over a posterior of a thousand readings

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Need no scale: a correlation is a pure number."""
        return cls()

    @cached_property
    def prior(self) -> Product:
        """The correlation of neighbours, even over its range."""
        return Product({"rho": Uniform(self.lowest, self.highest)})

    def apply(self, value: NoiseLevel, theta: FloatArray, plan: Plan) -> NoiseLevel:
        """Set the correlation; the sd of one reading stays."""
        return replace(value, rho=theta[:, :1])

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say how alike neighbours are."""
        return (
            f"the noise of neighbouring readings correlates by {give_or_take(mean[0], sd[0])}: "
            "readings repeat each other's errors"
        )


@dataclass(frozen=True)
class SignalDependentNoise(NoiseEffect):
    """Noise that grows with the light: variance x (1 + ratio u), u the seen white fraction."""

    least: float = 0.05
    most: float = 50.0

    name: ClassVar[str] = "signal_dependent_noise"
    stage: ClassVar[Stage] = Stage.NOISE
    units: ClassVar[tuple[str, ...]] = ("1",)
    covariates: ClassVar[tuple[str, ...]] = ("level",)
    amplitudes: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Need no scale: a ratio is a pure number."""
        return cls()

    @cached_property
    def prior(self) -> Product:
        """How much more variance on white, over its orders of magnitude."""
        return Product({"ratio": LogUniform(self.least, self.most)})

    def apply(self, value: NoiseLevel, theta: FloatArray, plan: Plan) -> NoiseLevel:
        """Widen the noise of each reading by what it sees."""
        return replace(value, sd=value.sd * np.sqrt(1 + theta[:, :1] * np.clip(value.seen, 0.0, 1.0)))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say how much louder the highest level is than the lowest."""
        return (
            f"the noise grows with the level: its variance at the highest is {give_or_take(1 + mean[0], sd[0])} times "
            "that at the lowest"
        )


@dataclass(frozen=True)
class DriftingNoise(NoiseEffect):
    """Noise that grows or calms down in time: sd x growth^(time / duration), evenly on a logarithmic scale.

    No physics of the sensor, and no name of the vocabulary's: it keeps tests of the mean honest.
    """

    least: float = 0.2
    most: float = 5.0

    name: ClassVar[str] = "drifting_noise"
    stage: ClassVar[Stage] = Stage.NOISE
    units: ClassVar[tuple[str, ...]] = ("1",)
    covariates: ClassVar[tuple[str, ...]] = ("time",)
    amplitudes: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Need no scale: a growth is a pure number."""
        return cls()

    @cached_property
    def prior(self) -> Product:
        """The sd at the end over that at the start, over its orders of magnitude."""
        return Product({"growth": LogUniform(self.least, self.most)})

    def apply(self, value: NoiseLevel, theta: FloatArray, plan: Plan) -> NoiseLevel:
        """Scale the noise of each reading by its time."""
        elapsed = (plan.time_s - plan.time_s.min()) / (float(np.ptp(plan.time_s)) or 1.0)
        return replace(value, sd=value.sd * theta[:, :1] ** (elapsed - 0.5))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say how the noise has changed."""
        return f"the noise is {give_or_take(mean[0], sd[0])} times as loud at the end as at the start"
