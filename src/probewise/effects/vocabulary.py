"""What every named effect offers besides its function, and the scale that its prior hangs on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self, TypeVar

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.recordings.plan import Recording
from probewise.sensor.stages import Effect

__all__ = ["Extent", "NamedEffect", "give_or_take"]

V = TypeVar("V")


@dataclass(frozen=True)
class Extent:
    """How far a recording reaches: what makes an effect's typical size a number in its unit."""

    low: float
    high: float
    length_mm: float
    duration_s: float

    def __post_init__(self) -> None:
        if not (self.low < self.high and self.length_mm > 0 and self.duration_s > 0):
            raise ParameterError(
                "Extent", (self.low, self.high, self.length_mm, self.duration_s), "low < high, length and duration > 0"
            )

    @property
    def span(self) -> float:
        """Range of the readings, in their unit."""
        return self.high - self.low

    @classmethod
    def of(cls, recording: Recording) -> Self:
        """Measure the extent of a recording: range of its usable readings, longest scan, last time.

        Raises
        ------
        ParameterError
            If there is no usable reading.
        """
        readings, plan = recording.readings[recording.usable], recording.plan
        if readings.size == 0:
            raise ParameterError("usable readings", 0, "at least one; the recording holds none")
        low, high = float(readings.min()), float(readings.max())
        tiny = max(abs(low), abs(high), 1.0) * 1e-6
        lengths = [
            float(np.hypot(np.ptp(plan.x_mm[rows]), np.ptp(plan.y_mm[rows])))
            for rows in plan.rows_by_scan()
            if rows.size
        ]
        duration_s = float(np.ptp(plan.time_s))
        return cls(low, max(high, low + tiny), max(*lengths, 0.0) or 1.0, duration_s or 1.0)


class NamedEffect(Effect[V], Protocol[V]):
    """An effect of the vocabulary: what the diagnosis needs to look for it and to speak of it.

    A new effect is one class of this kind and one line in `VOCABULARY`.
    """

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each parameter, in the order of `prior.names`."""
        ...

    @property
    def covariates(self) -> tuple[str, ...]:
        """Covariates in which its residual shows."""
        ...

    @property
    def amplitudes(self) -> tuple[int, ...]:
        """Which parameters are amplitudes: the readings change in proportion to first order, 0 means absent."""
        ...

    @classmethod
    def for_extent(cls, extent: Extent) -> Self:
        """Build it with a prior fit for a recording of this extent."""
        ...

    def bank(self) -> FloatArray:
        """Lay out settings to look for it with, shape (n_bank, n_columns, n_params).

        Each entry spans, by its columns, the readings' change to first order; entries differ in
        what is not linear. Effects on the noise: equally weighted nodes of the prior.
        """
        ...

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say in plain words what it does, with its numbers, each of shape (n_params,)."""
        ...


def give_or_take(mean: float, sd: float, *, factor: float = 1.0) -> str:
    """Write mean ± sd with as many digits as the sd deserves."""
    mean, sd = factor * mean, factor * sd
    if not (np.isfinite(sd) and sd > 0):
        return f"{mean:.4g}"
    digits = int(np.clip(1 - np.floor(np.log10(sd)), 0, 8))
    return f"{mean:.{digits}f} ± {sd:.{digits}f}"
