"""Saturation of the electronics: an effect on the finished reading."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.vocabulary import NamedEffect
from probewise.priors import LogUniform, Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Stage


@dataclass(frozen=True)
class Saturation(NamedEffect[FloatArray]):
    """A soft upper limit: reading -> level - softness log(1 + exp((level - reading) / softness)).

    As the softness goes to zero this is min(reading, level).
    """

    lowest: float = 0.0
    highest: float = 150.0
    sharpest: float = 0.05
    softest: float = 20.0
    unit: str = field(default="", kw_only=True)

    name = "saturation"
    words = "readings cut off at a limit"
    stage = Stage.SATURATION
    units = ("reading", "reading")
    covariates = ("level",)
    amplitudes = ()

    @property
    def nothing(self) -> Mapping[int, float]:
        """A level out of reach, by the index of the level, for any softness."""
        return {0: self.highest + 100 * self.softest}

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with levels from 20 % up the readings' range to 30 % above its top."""
        return cls(
            lowest=extent.low + 0.2 * extent.span,
            highest=extent.high + 0.3 * extent.span,
            sharpest=1e-3 * extent.span,
            softest=0.3 * extent.span,
            unit=extent.reading_unit,
        )

    @cached_property
    def prior(self) -> Product:
        """Prior of the level, uniform where the limit would act, and of the softness, log-uniform."""
        return Product(
            {"level": Uniform(self.lowest, self.highest), "softness": LogUniform(self.sharpest, self.softest)}
        )

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        level, softness = theta[:, :1], theta[:, 1:2]
        return np.asarray(level - softness * np.logaddexp(0.0, (level - value) / softness))

    def bank(self) -> FloatArray:
        """Return 13 entries, (13, 1, 2): nine sharp limits, denser near the top, and four soft ones."""
        span = (self.highest - self.lowest) / 1.1
        top = self.highest - 0.3 * span
        sharp = [(top - share * 0.8 * span, self.sharpest * 5) for share in np.geomspace(0.02, 0.9, 9)]
        soft = [(top + share * span, 0.1 * span) for share in (-0.2, -0.05, 0.1, 0.25)]
        return np.array([*sharp, *soft])[:, None, :]

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        softness = f"{mean[1]:.2g} {self.unit}".rstrip()
        return (
            f"no reading rises above {value_with_sd(mean[0], sd[0], self.unit)}: the electronics saturate, "
            f"from about {softness} below that limit"
        )
