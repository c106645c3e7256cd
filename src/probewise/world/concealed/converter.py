"""From the signal to the number: inertia, a ceiling, coarse steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from probewise._arrays import FloatArray
from probewise.world.concealed.stages import Stage
from probewise.world.rows import Rows

__all__ = ["Lag", "Quantisation", "Saturation"]


@dataclass(frozen=True)
class Lag:
    """The reading limps behind with a time constant; the first one of a scan does not."""

    name: ClassVar[str] = "lag"
    stage: ClassVar[Stage] = "lag"
    tau_s: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Mix each reading with the one before: v_k = a v_(k-1) + (1 - a) y_k, a = exp(-(t_k - t_(k-1))/tau)."""
        kept = np.exp(-np.diff(rows.time_s, prepend=-np.inf) / self.tau_s)
        kept[rows.starts_scan()] = 0.0
        out = values.copy()
        for k in range(1, len(out)):
            out[k] = kept[k] * out[k - 1] + (1 - kept[k]) * values[k]
        return out


@dataclass(frozen=True)
class Saturation:
    """The converter ends at a level; `softness` (reading units, 0 = a sharp corner) rounds the corner."""

    name: ClassVar[str] = "saturation"
    stage: ClassVar[Stage] = "saturation"
    level: float
    softness: float = 0.0

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Let no reading pass the level."""
        if self.softness == 0:
            return np.minimum(values, self.level)
        return self.level - self.softness * np.logaddexp(0.0, (self.level - values) / self.softness)


@dataclass(frozen=True)
class Quantisation:
    """The number is rounded coarsely, and nobody says so."""

    name: ClassVar[str] = "quantisation"
    stage: ClassVar[Stage] = "quantisation"
    step: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Round to multiples of the step."""
        return np.asarray(self.step * np.round(values / self.step))
