"""Effects between light and signal: response curve and gain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.world.concealed.stages import Stage
from probewise.world.rows import Rows


@dataclass(frozen=True)
class Nonlinearity:
    """A response that is the `gamma`-th power of the light."""

    name: ClassVar[str] = "nonlinearity"
    stage: ClassVar[Stage] = "response"
    gamma: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return np.asarray(np.power(np.maximum(values, 0.0), self.gamma), dtype=np.float64)


@dataclass(frozen=True)
class GainDrift:
    """Warm-up of the LED: the signal is wrong by a fraction `frac` at time 0 and settles with time constant `tau_s`."""

    name: ClassVar[str] = "gain_drift"
    stage: ClassVar[Stage] = "gain"
    frac: float
    tau_s: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values * (1 + self.frac * np.exp(-rows.time_s / self.tau_s))


@dataclass(frozen=True)
class BatterySag:
    """LED brightness that follows the battery: the signal times 1 + `per_volt` (volts of `battery_mv` - `full_v`)."""

    name: ClassVar[str] = "battery_sag"
    stage: ClassVar[Stage] = "gain"
    per_volt: float
    full_v: float = 8.3

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        if "battery_mv" not in rows.covariates:
            raise ParameterError("covariates", ", ".join(rows.covariates) or "none", "battery_mv among them")
        return values * (1 + self.per_volt * (rows.covariates["battery_mv"] / 1000 - self.full_v))
