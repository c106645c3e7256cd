"""Effects on the response curve, which turns the seen white fraction into a signal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.heavy_tailed_prior import LogHeavyTailedPrior
from probewise.effects.vocabulary import NamedEffect, single_column_bank
from probewise.priors import Product
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Stage


@dataclass(frozen=True)
class Nonlinearity(NamedEffect[FloatArray]):
    """A bent response curve: u -> u^gamma, u the seen white fraction clipped to 0..1."""

    typical_log: float = 0.1

    name = "nonlinearity"
    words = "a bent response curve"
    stage = Stage.RESPONSE
    units = ("1",)
    covariates = ("level",)
    amplitudes = ()

    @property
    def nothing(self) -> Mapping[int, float]:
        return {0: 1.0}

    @cached_property
    def prior(self) -> Product:
        return Product({"gamma": LogHeavyTailedPrior(self.typical_log)})

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        return np.asarray(np.clip(value, 0.0, 1.0) ** theta[:, :1])

    def bank(self) -> FloatArray:
        return single_column_bank(np.exp(self.typical_log * np.array([-1.0, 1.0])))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        seen = 100 * 0.5 ** mean[0]
        return (
            f"the response is bent with exponent {value_with_sd(mean[0], sd[0])}: "
            f"a half-white view reads as {seen:.1f} % white"
        )
