"""Effects on the response curve, which turns the seen white fraction into a signal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.extent import Extent
from probewise.effects.heavy_tailed import LogHeavyTailed
from probewise.effects.vocabulary import NamedEffect, give_or_take
from probewise.priors import Product
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Stage

__all__ = ["Nonlinearity"]


@dataclass(frozen=True)
class Nonlinearity(NamedEffect[FloatArray]):
    """A bent response curve: u -> u^gamma, u the seen white fraction clipped to 0..1."""

    typical_log: float = 0.1

    name: ClassVar[str] = "nonlinearity"
    stage: ClassVar[Stage] = Stage.RESPONSE
    units: ClassVar[tuple[str, ...]] = ("1",)
    covariates: ClassVar[tuple[str, ...]] = ("level",)
    amplitudes: ClassVar[tuple[int, ...]] = ()

    @property
    def nothing(self) -> Mapping[int, float]:
        """An exponent of one."""
        return {0: 1.0}

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Keep the default scale: the exponent is a pure number."""
        return cls()

    @cached_property
    def prior(self) -> Product:
        """The exponent, its logarithm heavy-tailed about 0."""
        return Product({"gamma": LogHeavyTailed(self.typical_log)})

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        """Raise the seen fraction to the power gamma, (n_samples, n_points)."""
        return np.asarray(np.clip(value, 0.0, 1.0) ** theta[:, :1])

    def bank(self) -> FloatArray:
        """Two entries, one on each side of the straight line."""
        return np.exp(self.typical_log * np.array([-1.0, 1.0]))[:, None, None]

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say what a half-white view reads as."""
        seen = 100 * 0.5 ** mean[0]
        return (
            f"the response is bent with exponent {give_or_take(mean[0], sd[0])}: "
            f"a half-white view reads as {seen:.1f} % white"
        )
