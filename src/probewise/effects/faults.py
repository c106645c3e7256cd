"""Single faulty readings: heavy-tailed noise, and readings lost to one value."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.noise_distribution import FittedReadings
from probewise.effects.vocabulary import NoiseEffect
from probewise.priors import LogUniform, Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import NoiseParameters, Stage

_FAR = 4.0  # noise sds beyond which a reading may be lost rather than noisy
LARGEST_SIZE = 40.0
"""Largest sd of outlying readings, in noise sds; readings too far out for it are lost ones (`diagnosis.residuals`)."""

MOST_OUTLYING = 0.2
"""Largest share of outlying or of lost readings."""

_NEAR_END = 1e-4  # of the range of a lost reading's value: distance of the bank's values from its ends


@dataclass(frozen=True)
class Outliers(NoiseEffect):
    """A heavy tail: with probability `share`, a reading's noise is `size` times as wide (sd)."""

    name = "outliers"
    words = "outlying readings"
    stage = Stage.NOISE
    units = ("1", "noise sd")
    covariates = ("level", "time")
    nodes_per_parameter = (4, 4)

    @cached_property
    def prior(self) -> Product:
        return Product({"share": LogUniform(2e-3, MOST_OUTLYING), "size": LogUniform(2.5, LARGEST_SIZE)})

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        return replace(value, wide_share=theta[:, :1], wide_times=theta[:, 1:2])

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"outliers: {value_with_sd(mean[0], sd[0], factor=100)} % of the readings scatter "
            f"{value_with_sd(mean[1], sd[1])} times as widely as the others"
        )


@dataclass(frozen=True)
class Dropouts(NoiseEffect):
    """Lost readings: with probability `share` a reading is `value`, whatever lies under the sensor.

    `lowest` and `highest` bound that value; `ends` are those of the instrument's declared range, its likeliest values.
    `lost`: what the readings read that are lost beyond doubt, of `n_readings` in all, and `distance`, the norm of their
    residuals in noise sds. They are left out of the recording, so that the noise of the others does not change; where
    they differ, `value` is any of theirs.
    """

    lowest: float = -50.0
    highest: float = 150.0
    ends: tuple[float, ...] = ()
    unit: str = field(default="", kw_only=True)
    lost: tuple[float, ...] = field(default=(), kw_only=True)
    n_readings: int = field(default=0, kw_only=True)
    distance: float = field(default=0.0, kw_only=True)

    name = "dropouts"
    words = "lost readings"
    stage = Stage.NOISE
    units = ("1", "reading")
    covariates = ("level", "time")
    nodes_per_parameter = ()  # they depend on the readings, and the share's lie close

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with values within the readings' range, 1 % wider each way, and with the declared ends."""
        low, high = extent.low - 0.01 * extent.span, extent.high + 0.01 * extent.span
        return cls(low, high, extent.plan.instrumentation.declared_ends, unit=extent.reading_unit)

    @classmethod
    def of_lost_readings(cls, lost: FloatArray, n_readings: int, distance: float, unit: str) -> Self:
        """Return the effect that lost these of `n_readings` readings; `distance` as above."""
        wide = 0.01 * max(float(np.ptp(lost)), float(np.abs(lost).max()), 1e-300)
        low, high = float(lost.min()) - wide, float(lost.max()) + wide
        return cls(low, high, unit=unit, lost=tuple(lost.tolist()), n_readings=n_readings, distance=distance)

    @property
    def parameters_known_before_fit(self) -> FloatArray | None:
        """The share of the readings that are `lost`, and the commonest value; None without them."""
        if not self.lost:
            return None
        return np.array([len(self.lost) / self.n_readings, max(self.lost, key=self.lost.count)])

    def draws_about(self, nodes: FloatArray, *, rng: np.random.Generator) -> FloatArray | None:
        """Draw the share that the number of `lost` readings tells (Jeffreys prior), and one of their values."""
        if not self.lost:
            return None
        n, n_lost = len(nodes), len(self.lost)
        share = rng.beta(n_lost + 0.5, self.n_readings - n_lost + 0.5, n)
        return np.stack([share, rng.choice(self.lost, n)], axis=1)

    @cached_property
    def prior(self) -> Product:
        return Product({"share": LogUniform(2e-3, MOST_OUTLYING), "value": Uniform(self.lowest, self.highest)})

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        return replace(value, lost_share=theta[:, :1], lost_value=theta[:, 1:2])

    def bank(self) -> FloatArray:
        near = _NEAR_END * (self.highest - self.lowest)
        ends = (self.lowest + near, self.highest - near)
        return np.array([[[share, end]] for share in (0.01, 0.05) for end in ends])

    def nodes(self, residuals: FloatArray, rows: FittedReadings) -> FloatArray:
        """Return twelve pairs (share, value), (12, 2), with the commonest value of readings beyond four noise sds.

        There is no node, (0, 2), unless an outlying value occurs twice or is an end of the declared range.
        """
        far = rows.readings[np.abs(residuals) > _FAR]
        # Floats differ in their last digits, so the value is one of the readings, not their mean.
        n_alike = (np.abs(far[:, None] - far) <= 1e-6 * rows.sd).sum(axis=0)
        at_end = (np.abs(far[:, None] - np.array(self.ends)) <= 1e-6 * rows.sd).any(axis=1)
        if not (at_end | (n_alike > 1)).any():
            return np.zeros((0, 2))
        value = far[int(np.argmax(n_alike + 0.5 * at_end))]
        shares = LogUniform(2e-3, MOST_OUTLYING).from_unit((np.arange(12) + 0.5) / 12)
        return np.stack([shares, np.full(12, value)], axis=1)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        exact = f"{mean[1]:z.12g} {self.unit}".rstrip()  # lost readings have one value, to the last digit
        value = value_with_sd(mean[1], sd[1], self.unit) if sd[1] > 0 else exact
        share = value_with_sd(mean[0], sd[0], factor=100)
        if len({*self.lost}) > 1:
            values = [f"{each:.12g}" for each in sorted({*self.lost})]
            value = f"{', '.join(values[:-1])} or {values[-1]} {self.unit}".rstrip()
        return f"readings are lost: {share} % of them read {value}, whatever the true value"
