"""Errors of the sensor's orientation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.extent import Extent
from probewise.effects.heavy_tailed import HeavyTailed
from probewise.effects.motion import in_scans, mountings
from probewise.effects.vocabulary import NamedEffect, give_or_take
from probewise.priors import Product
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Poses, Stage

__all__ = ["OrientationError", "ScanAngleError"]


@dataclass(frozen=True)
class OrientationError(NamedEffect[Poses]):
    """The sensor is turned by deg more than was commanded, in all scans, anticlockwise."""

    typical_deg: float = 3.0

    name: ClassVar[str] = "orientation_error"
    stage: ClassVar[Stage] = Stage.POSE
    units: ClassVar[tuple[str, ...]] = ("deg",)
    covariates: ClassVar[tuple[str, ...]] = ("orientation",)
    amplitudes: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Keep the default scale: three degrees are typical of a mount set by eye."""
        return cls()

    @cached_property
    def prior(self) -> Product:
        """The angle, of either sign."""
        return Product({"deg": HeavyTailed(self.typical_deg)})

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        """Add the angle to every pose."""
        return replace(value, orientation_rad=value.orientation_rad + np.radians(theta))

    def is_of_the_ssf(self, plan: Plan) -> bool:
        """Return True: turning the sensor turns its SSF, so calibration absorbs it."""
        return True

    def bank(self) -> FloatArray:
        """One entry: the change is linear in a small angle."""
        return np.full((1, 1, 1), self.typical_deg)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say by how many degrees."""
        return (
            f"the sensor is turned {give_or_take(mean[0], sd[0])} degrees further anticlockwise than was commanded, "
            "in all scans"
        )


@dataclass(frozen=True)
class ScanAngleError(NamedEffect[Poses]):
    """The sensor is turned by deg more than was commanded in one mounting (scans of one orientation) or one scan.

    `scans` are the affected scans; `choices` are the candidate groups of scans.
    """

    typical_deg: float = 3.0
    scans: tuple[str, ...] = ()
    choices: tuple[tuple[str, ...], ...] = ()

    name: ClassVar[str] = "scan_angle_error"
    stage: ClassVar[Stage] = Stage.POSE
    units: ClassVar[tuple[str, ...]] = ("deg",)
    covariates: ClassVar[tuple[str, ...]] = ("scan", "orientation")
    amplitudes: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Take each mounting and each scan as a candidate; None where there is only one."""
        choices = mountings(extent.plan)
        return cls(choices=choices) if choices else None

    @cached_property
    def prior(self) -> Product:
        """The angle, of either sign."""
        return Product({"deg": HeavyTailed(self.typical_deg)})

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        """Add the angle to the poses of the affected scans."""
        return replace(value, orientation_rad=value.orientation_rad + np.radians(theta) * in_scans(plan, self.scans))

    def variants(self) -> tuple[Self, ...]:
        """One variant for each mounting and each scan."""
        return tuple(replace(self, scans=choice) for choice in self.choices)

    def bank(self) -> FloatArray:
        """One small angle, and two large ones of either sign."""
        return self.typical_deg * np.array([1.0, -8.0, 8.0, -14.0, 14.0])[:, None, None]

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say by how many degrees, and in which scans."""
        return (
            f"in {', '.join(self.scans)} the sensor is turned {give_or_take(mean[0], sd[0])} degrees further "
            "anticlockwise than was commanded"
        )
