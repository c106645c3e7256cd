"""What changes at one moment and has no name in the vocabulary: the arm is knocked, the signal jumps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.extent import Extent
from probewise.effects.heavy_tailed import HeavyTailed
from probewise.effects.moments import SinceAMoment, moments_of
from probewise.effects.vocabulary import give_or_take
from probewise.priors import Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Poses, Stage

__all__ = ["ArmKnock", "GainStep"]


@dataclass(frozen=True)
class ArmKnock(SinceAMoment[Poses]):
    """The arm is pushed: from at_s on every place is (dx_mm, dy_mm) off, and the sensor turned by turn_deg."""

    typical_mm: float = 0.3
    typical_deg: ClassVar[float] = 2.0

    name: ClassVar[str] = "arm_knock"
    stage: ClassVar[Stage] = Stage.POSE
    units: ClassVar[tuple[str, ...]] = ("mm", "mm", "deg", "s")
    covariates: ClassVar[tuple[str, ...]] = ("time", "slope")
    amplitudes: ClassVar[tuple[int, ...]] = (0, 1, 2)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Take half a percent of the longest scan as typical; look between any two readings."""
        moments = moments_of(extent)
        return None if moments is None else cls(moments, typical_mm=0.005 * extent.length_mm)

    @cached_property
    def prior(self) -> Product:
        """Shift along X and along Y, turn, and the moment."""
        shift, turn = HeavyTailed(self.typical_mm), HeavyTailed(self.typical_deg)
        return Product({"dx_mm": shift, "dy_mm": shift, "turn_deg": turn, "at_s": Uniform(*self.open_s)})

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        """Shift the places of the readings taken after the moment, and turn the sensor there."""
        since = self.since(theta, plan)
        return replace(
            value,
            x_mm=value.x_mm + theta[:, :1] * since,
            y_mm=value.y_mm + theta[:, 1:2] * since,
            orientation_rad=value.orientation_rad + np.deg2rad(theta[:, 2:3]) * since,
        )

    def bank(self) -> FloatArray:
        """One setting of three columns, in the middle of the time left open."""
        sizes = np.diag([self.typical_mm, self.typical_mm, self.typical_deg])
        return np.concatenate([sizes, np.full((3, 1), sum(self.open_s) / 2)], axis=1)[None, :, :]

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say when, and how far."""
        return (
            f"from {give_or_take(mean[3], sd[3])} s on every place is off by {give_or_take(mean[0], sd[0])} mm along X "
            f"and {give_or_take(mean[1], sd[1])} mm along Y, and the sensor turned by {give_or_take(mean[2], sd[2])} "
            "degrees: arm or paper was pushed"
        )


@dataclass(frozen=True)
class GainStep(SinceAMoment[FloatArray]):
    """Lamp or lens changes at once: signal x (1 + frac 1(t > at_s))."""

    typical: float = 0.02

    name: ClassVar[str] = "gain_step"
    stage: ClassVar[Stage] = Stage.GAIN
    units: ClassVar[tuple[str, ...]] = ("1", "s")
    covariates: ClassVar[tuple[str, ...]] = ("time", "level")
    amplitudes: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Look between any two readings of the recording."""
        moments = moments_of(extent)
        return None if moments is None else cls(moments)

    @cached_property
    def prior(self) -> Product:
        """Share, of either sign, and the moment."""
        return Product({"frac": HeavyTailed(self.typical), "at_s": Uniform(*self.open_s)})

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        """Scale the signal of the readings taken after the moment, (n_samples, n_points)."""
        return np.asarray(value * (1 + theta[:, :1] * self.since(theta, plan)))

    def bank(self) -> FloatArray:
        """One setting, in the middle of the time left open."""
        return np.array([[[self.typical, sum(self.open_s) / 2]]])

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say when, and by how many percent."""
        way = "stronger" if mean[0] > 0 else "weaker"
        return (
            f"from {give_or_take(mean[1], sd[1])} s on the signal is {give_or_take(abs(mean[0]), sd[0], factor=100)} % "
            f"{way}: lamp or lens changed at once"
        )
