"""Effects on the gain, which turns the seen light into a signal."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.heavy_tailed_prior import HeavyTailedPrior
from probewise.effects.linear import LinearEffect
from probewise.effects.origin import CountsTimeFromOrigin
from probewise.effects.vocabulary import NamedEffect, single_column_bank
from probewise.priors import LogUniform, Product
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Stage

_BATTERY = "battery_mv"
_REFERENCE_MV = 8000.0


@dataclass(frozen=True)
class GainDrift(CountsTimeFromOrigin, NamedEffect[FloatArray]):
    """A lamp that warms up: signal x (1 + frac exp(-t / tau_s)), t the plan's time since `origin`, 0 before it."""

    typical: float = 0.02
    shortest_s: float = 5.0
    longest_s: float = 5000.0

    name = "gain_drift"
    words = "a gain that drifts"
    stage = Stage.GAIN
    units = ("1", "s")
    covariates = ("time",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with time constants from a hundredth of the recording's duration to twice the duration."""
        duration_s = extent.duration_s
        return cls(shortest_s=0.01 * duration_s, longest_s=2 * duration_s, origin=extent.origin)

    @cached_property
    def prior(self) -> Product:
        return Product({"frac": HeavyTailedPrior(self.typical), "tau_s": LogUniform(self.shortest_s, self.longest_s)})

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        # A negative time would let the exponential overflow.
        fade = np.exp(-np.maximum(self.origin.seconds(plan), 0.0) / theta[:, 1:2])
        return np.asarray(value * (1 + theta[:, :1] * fade))

    def bank(self) -> FloatArray:
        return single_column_bank(self.typical, np.geomspace(self.shortest_s * 1.5, self.longest_s / 1.5, 7))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        side = "too strong" if mean[0] > 0 else "too weak"
        return (
            f"the signal starts {value_with_sd(abs(mean[0]), sd[0], factor=100)} % {side} at time 0 and settles "
            f"with a time constant of {value_with_sd(mean[1], sd[1])} s: the lamp warms up"
        )


@dataclass(frozen=True)
class BatterySag(LinearEffect[FloatArray]):
    """A lamp that dims with its battery: signal x (1 + per_volt (V - V0)), V from `battery_mv`, V0 = 8 V.

    Between recorded voltages V is interpolated in time, and beyond them it is the nearest one; it is V0 if there is
    none.
    """

    typical_per_volt: float = 0.05

    name = "battery_sag"
    words = "a signal that follows the battery"
    stage = Stage.GAIN
    units = ("1/V",)
    covariates = (_BATTERY,)
    reads = (_BATTERY,)
    parameters = ("per_volt",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical change to 2 % over the recorded voltages; None if there are none or all are equal."""
        millivolts = extent.plan.covariates.get(_BATTERY, np.empty(0))
        recorded = (millivolts[np.isfinite(millivolts)] - _REFERENCE_MV) / 1000
        fall = float(np.ptp(recorded)) if recorded.size else 0.0
        return cls(typical_per_volt=0.02 / fall) if fall > 0 else None

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        return np.asarray(value * (1 + theta[:, :1] * _volts_above_reference(plan)))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        way = "loses" if mean[0] > 0 else "gains"
        return (
            f"the signal {way} {value_with_sd(abs(mean[0]), sd[0], factor=100)} % for each volt that the battery "
            "falls: the lamp follows the battery"
        )


def _volts_above_reference(plan: Plan) -> FloatArray:
    """Return the battery voltage minus V0 in V, (n_points,), interpolated where it is missing; 0 if all are."""
    millivolts = plan.covariates.get(_BATTERY, np.full(len(plan), np.nan))
    known = np.flatnonzero(np.isfinite(millivolts))
    if not known.size:
        return np.zeros(len(plan))
    above = (millivolts - _REFERENCE_MV) / 1000
    known = known[np.argsort(plan.time_s[known], kind="stable")]
    # A missing voltage is no other voltage: at V0 the gain would jump where the logging stops.
    return np.where(np.isfinite(above), above, np.interp(plan.time_s, plan.time_s[known], above[known]))
