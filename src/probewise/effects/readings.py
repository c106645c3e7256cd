"""Memory in the readings: hysteresis in the direction of motion, a time lag, and an overshoot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.decaying_sum import decaying_sum
from probewise.effects.extent import Extent
from probewise.effects.heavy_tailed_prior import HeavyTailedPrior
from probewise.effects.linear import LinearEffect
from probewise.effects.motion import sign_of_motion
from probewise.effects.vocabulary import NamedEffect, single_column_bank
from probewise.priors import LogUniform, Product
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Stage

_IN_DIRECTION = {-1.0: "of backward motion", 0.0: "at rest", 1.0: "of forward motion"}


@dataclass(frozen=True)
class Hysteresis(LinearEffect[FloatArray]):
    """A reading that depends on the direction of motion: reading + amp d.

    d is the sign of the last motion along X, or along Y if X did not change; 0 without motion.
    """

    typical: float = 0.5
    unit: str = field(default="", kw_only=True)
    directions: tuple[float, ...] = field(default=(-1.0, 1.0), kw_only=True)  # the signs of motion in the recording

    name = "hysteresis"
    words = "an offset that depends on the direction"
    stage = Stage.OFFSET
    units = ("reading",)
    covariates = ("direction",)
    parameters = ("amp",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical amplitude to 1 % of the readings' range; None where the direction never changes."""
        signs = tuple(np.unique(sign_of_motion(extent.plan)).tolist())
        return cls(0.01 * extent.span, unit=extent.reading_unit, directions=signs) if len(signs) > 1 else None

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        return np.asarray(value + theta[:, :1] * sign_of_motion(plan))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        way, least, most = "higher" if mean[0] > 0 else "lower", self.directions[0], self.directions[-1]
        size = value_with_sd(abs(mean[0]), sd[0], self.unit, factor=most - least)
        return (
            f"readings {_IN_DIRECTION[most]} are {size} {way} than those {_IN_DIRECTION[least]}, over black and white "
            "alike: hysteresis"
        )


@dataclass(frozen=True)
class Lag(NamedEffect[FloatArray]):
    """First-order lag of the electronics: v_k = a v_(k-1) + (1 - a) y_k with a = exp(-(t_k - t_(k-1)) / tau_s).

    Here y_k are the readings without lag. The first reading of a scan has no lag.
    """

    shortest_s: float = 0.2
    longest_s: float = 20.0

    name = "lag"
    words = "a sensor that follows slowly"
    stage = Stage.LAG
    units = ("s",)
    covariates = ("slope", "direction")
    amplitudes = ()

    @property
    def nothing(self) -> Mapping[int, float]:
        return {0: 0.0}

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with time constants from a sixth of the median time between readings to thirty times it."""
        return cls(shortest_s=extent.gap_s / 6, longest_s=30 * extent.gap_s)

    @cached_property
    def prior(self) -> Product:
        return Product({"tau_s": LogUniform(self.shortest_s, self.longest_s)})

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        """Return the lagged readings, (n_samples, n_points)."""
        same = np.diff(plan.scan, prepend=-1) == 0
        waited_s = np.where(same, np.maximum(np.diff(plan.time_s, prepend=0.0), 0.0), np.inf)
        tau_s = theta[:, :1]
        kept = np.where(tau_s > 0, np.exp(-waited_s / np.where(tau_s > 0, tau_s, 1.0)), 0.0)  # 0 where a scan begins
        return decaying_sum((1 - kept) * value, kept, longest=int(np.bincount(plan.scan).max(initial=1)))

    def bank(self) -> FloatArray:
        return single_column_bank(np.geomspace(self.shortest_s * 1.5, self.longest_s / 3, 7))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"each reading keeps part of the previous one, with a time constant of {value_with_sd(mean[0], sd[0])} s: "
            "the electronics lag"
        )


@dataclass(frozen=True)
class Overshoot(NamedEffect[FloatArray]):
    """An overshoot: at each rise the detector reads too high by `share` times the rise, an excess that decays.

    y_k + share x sum over j <= k of max(y_j - y_(j-1), 0) exp(-(t_k - t_j) / tau_s), y the readings without it. If
    `share` is negative, that fraction of each rise arrives late. Falls cause nothing.
    """

    typical: float = 0.02
    shortest_s: float = 0.2
    longest_s: float = 20.0

    name = "overshoot"
    words = "an overshoot where the light grows"
    stage = Stage.OFFSET
    units = ("1", "s")
    covariates = ("time", "direction", "level")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with time constants from the median time between readings to thirty times it.

        None if all readings share one time.
        """
        if not np.any(np.diff(extent.plan.time_s) > 0):
            return None
        return cls(shortest_s=extent.gap_s, longest_s=30 * extent.gap_s)

    @cached_property
    def prior(self) -> Product:
        return Product({"share": HeavyTailedPrior(self.typical), "tau_s": LogUniform(self.shortest_s, self.longest_s)})

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        waited_s = np.maximum(np.diff(plan.time_s, prepend=plan.time_s[:1]), 0.0)
        rise = np.maximum(np.diff(value, axis=1, prepend=value[:, :1]), 0.0)
        decayed = decaying_sum(rise, np.exp(-waited_s / theta[:, 1:2]), longest=value.shape[1])
        return np.asarray(value + theta[:, :1] * decayed)

    def bank(self) -> FloatArray:
        return single_column_bank(self.typical, np.geomspace(self.shortest_s * 1.5, self.longest_s / 1.5, 6))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        share, tau = value_with_sd(abs(mean[0]), sd[0], factor=100), value_with_sd(mean[1], sd[1])
        if mean[0] > 0:
            return f"each rise of the signal overshoots by {share} %, which decay with a time constant of {tau} s"
        return f"{share} % of each rise of the signal comes late, with a time constant of {tau} s"
