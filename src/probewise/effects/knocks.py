"""Changes at one time that are outside the vocabulary: the arm is knocked, or the gain jumps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.change_points import ChangePointEffect, change_point_times
from probewise.effects.extent import Extent
from probewise.effects.heavy_tailed import HeavyTailed
from probewise.effects.vocabulary import give_or_take
from probewise.priors import Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Poses, Stage

__all__ = ["ArmKnock", "GainStep"]


@dataclass(frozen=True)
class ArmKnock(ChangePointEffect[Poses]):
    """The arm is pushed: after at_s every position is off by (dx_mm, dy_mm) and the sensor is turned by turn_deg."""

    typical_mm: float = 0.3
    typical_deg: ClassVar[float] = 2.0

    name: ClassVar[str] = "arm_knock"
    stage: ClassVar[Stage] = Stage.POSE
    units: ClassVar[tuple[str, ...]] = ("mm", "mm", "deg", "s")
    covariates: ClassVar[tuple[str, ...]] = ("time", "slope")
    amplitudes: ClassVar[tuple[int, ...]] = (0, 1, 2)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical shift to 0.5 % of the longest scan; None where all readings share one time."""
        times = change_point_times(extent)
        return None if times is None else cls(times, typical_mm=0.005 * extent.length_mm)

    @cached_property
    def prior(self) -> Product:
        """Shift along X and along Y, turn, and time of the knock."""
        shift, turn = HeavyTailed(self.typical_mm), HeavyTailed(self.typical_deg)
        return Product({"dx_mm": shift, "dy_mm": shift, "turn_deg": turn, "at_s": Uniform(*self.open_s)})

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        """Shift and turn the poses of the readings taken after the knock."""
        since = self.since(theta, plan)
        return replace(
            value,
            x_mm=value.x_mm + theta[:, :1] * since,
            y_mm=value.y_mm + theta[:, 1:2] * since,
            orientation_rad=value.orientation_rad + np.deg2rad(theta[:, 2:3]) * since,
        )

    def bank(self) -> FloatArray:
        """One entry of three columns, its time in the middle of the open interval."""
        sizes = np.diag([self.typical_mm, self.typical_mm, self.typical_deg])
        return np.concatenate([sizes, np.full((3, 1), sum(self.open_s) / 2)], axis=1)[None, :, :]

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say when, and how far."""
        return (
            f"from {give_or_take(mean[3], sd[3])} s on, all positions are off by {give_or_take(mean[0], sd[0])} mm "
            f"along X and {give_or_take(mean[1], sd[1])} mm along Y, and the sensor is turned by "
            f"{give_or_take(mean[2], sd[2])} degrees: the arm or the paper was pushed"
        )


@dataclass(frozen=True)
class GainStep(ChangePointEffect[FloatArray]):
    """The lamp or lens changes suddenly: signal x (1 + frac 1(t > at_s))."""

    typical: float = 0.02

    name: ClassVar[str] = "gain_jump"
    stage: ClassVar[Stage] = Stage.GAIN
    units: ClassVar[tuple[str, ...]] = ("1", "s")
    covariates: ClassVar[tuple[str, ...]] = ("time", "level")
    amplitudes: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Search all times between readings; None where all readings share one time."""
        times = change_point_times(extent)
        return None if times is None else cls(times)

    @cached_property
    def prior(self) -> Product:
        """Relative change, of either sign, and its time."""
        return Product({"frac": HeavyTailed(self.typical), "at_s": Uniform(*self.open_s)})

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        """Scale the signal of the readings taken after the step, (n_samples, n_points)."""
        return np.asarray(value * (1 + theta[:, :1] * self.since(theta, plan)))

    def bank(self) -> FloatArray:
        """One entry, its time in the middle of the open interval."""
        return np.array([[[self.typical, sum(self.open_s) / 2]]])

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say when, and by how many percent."""
        way = "stronger" if mean[0] > 0 else "weaker"
        return (
            f"from {give_or_take(mean[1], sd[1])} s on, the signal is {give_or_take(abs(mean[0]), sd[0], factor=100)} "
            f"% {way}: the lamp or the lens changed suddenly"
        )
