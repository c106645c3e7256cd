"""How strongly the light is turned into a signal: effects on the gain."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.heavy_tailed import HeavyTailed
from probewise.effects.vocabulary import Extent, give_or_take
from probewise.priors import LogUniform, Product
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Stage

__all__ = ["GainDrift"]


@dataclass(frozen=True)
class GainDrift:
    """Warming up of the lamp: signal x (1 + frac exp(-t / tau_s)), t as in `time_s`."""

    typical: float = 0.02
    shortest_s: float = 5.0
    longest_s: float = 5000.0

    name: ClassVar[str] = "gain_drift"
    stage: ClassVar[Stage] = Stage.GAIN
    units: ClassVar[tuple[str, ...]] = ("1", "s")
    covariates: ClassVar[tuple[str, ...]] = ("time",)
    amplitudes: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self:
        """Look for time constants from a hundredth to twice the recording's duration."""
        return cls(shortest_s=0.01 * extent.duration_s, longest_s=2 * extent.duration_s)

    @cached_property
    def prior(self) -> Product:
        """Share at time 0, of either sign, and time constant."""
        return Product({"frac": HeavyTailed(self.typical), "tau_s": LogUniform(self.shortest_s, self.longest_s)})

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        """Scale the signal, (n_samples, n_points), never the dark level."""
        # A time before 0 would let the exponential overflow; nothing warms up backwards.
        fade = np.exp(-np.maximum(plan.time_s, 0.0) / theta[:, 1:2])
        return np.asarray(value * (1 + theta[:, :1] * fade))

    def bank(self) -> FloatArray:
        """One column each for seven time constants."""
        taus = np.geomspace(self.shortest_s * 1.5, self.longest_s / 1.5, 7)
        return np.stack([np.full(7, self.typical), taus], axis=-1)[:, None, :]

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say by how many percent the signal starts off, and how long that lasts."""
        side = "too strong" if mean[0] > 0 else "too weak"
        return (
            f"the signal starts {give_or_take(abs(mean[0]), sd[0], factor=100)} % {side} at time 0 and settles "
            f"with a time constant of {give_or_take(mean[1], sd[1])} s: the lamp warms up"
        )
