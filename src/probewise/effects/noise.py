"""How readings scatter: effects on the noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.vocabulary import Extent, give_or_take
from probewise.priors import Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import NoiseLevel, Stage

__all__ = ["CorrelatedNoise"]


@dataclass(frozen=True)
class CorrelatedNoise:
    """Noise with a memory, AR(1) within a scan: e_k = rho e_(k-1) + new noise."""

    lowest: float = -0.5
    highest: float = 0.95

    name: ClassVar[str] = "correlated_noise"
    stage: ClassVar[Stage] = Stage.NOISE
    units: ClassVar[tuple[str, ...]] = ("1",)
    covariates: ClassVar[tuple[str, ...]] = ("scan",)
    amplitudes: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self:
        """Need no scale: a correlation is a pure number."""
        return cls()

    @cached_property
    def prior(self) -> Product:
        """The correlation of neighbours, even over its range."""
        return Product({"rho": Uniform(self.lowest, self.highest)})

    def apply(self, value: NoiseLevel, theta: FloatArray, plan: Plan) -> NoiseLevel:
        """Set the correlation; the sd of one reading stays."""
        return replace(value, rho=theta[:, :1])

    def bank(self) -> FloatArray:
        """Equally weighted nodes of the prior, close enough to integrate over a posterior of a thousand readings."""
        n_nodes = 36
        return self.prior.from_unit_cube((np.arange(n_nodes)[:, None] + 0.5) / n_nodes)[:, None, :]

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say how alike neighbours are."""
        return (
            f"the noise of neighbouring readings of a scan correlates by {give_or_take(mean[0], sd[0])}: "
            "readings repeat each other's errors"
        )
