"""Effects between signal and recorded number: lag, saturation, quantisation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from probewise._arrays import FloatArray
from probewise.world.concealed.stages import Stage
from probewise.world.rows import Rows


@dataclass(frozen=True)
class Lag:
    """A first-order lag with time constant `tau_s`, which starts anew with each scan."""

    name: ClassVar[str] = "lag"
    stage: ClassVar[Stage] = "lag"
    tau_s: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Mix each reading with the one before: v_k = a v_(k-1) + (1 - a) y_k, a = exp(-(t_k - t_(k-1))/tau)."""
        kept = np.exp(-np.diff(rows.time_s, prepend=-np.inf) / self.tau_s)
        kept[rows.scan_start_mask()] = 0.0
        out = values.copy()
        for k in range(1, len(out)):
            out[k] = kept[k] * out[k - 1] + (1 - kept[k]) * values[k]
        return out


@dataclass(frozen=True)
class Saturation:
    """Saturation at a level; `softness` (reading units, 0 for a sharp corner) rounds the corner."""

    name: ClassVar[str] = "saturation"
    stage: ClassVar[Stage] = "saturation"
    level: float
    softness: float = 0.0

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        if self.softness == 0:
            return np.minimum(values, self.level)
        return self.level - self.softness * np.logaddexp(0.0, (self.level - values) / self.softness)


@dataclass(frozen=True)
class Quantisation:
    """Rounding to multiples of `step` (reading units) that the plan does not declare."""

    name: ClassVar[str] = "quantisation"
    stage: ClassVar[Stage] = "quantisation"
    step: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return np.asarray(self.step * np.round(values / self.step))
