"""Errors of the sensor's orientation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.linear import LinearEffect, ScanGroupEffect, scans_in_words
from probewise.effects.motion import candidate_scan_groups, scan_indicator
from probewise.effects.vocabulary import single_column_bank
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Poses, Stage


@dataclass(frozen=True)
class OrientationError(LinearEffect[Poses]):
    """The sensor is turned by deg more than was commanded, in all scans, anticlockwise."""

    typical_deg: float = 3.0

    name = "orientation_error"
    words = "a wrong sensor angle in all scans"
    stage = Stage.POSE
    units = ("deg",)
    covariates = ("orientation",)
    parameters = ("deg",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with its default scale: three degrees are typical of a mount set by eye."""
        return cls()

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        return replace(value, orientation_rad=value.orientation_rad + np.radians(theta))

    def is_absorbed_by_ssf(self, plan: Plan) -> bool:
        """Return True: turning the sensor turns its SSF, so calibration absorbs it."""
        return True

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return f"in all scans the sensor is turned {_extra_turn_in_words(mean[0], sd[0])}"


@dataclass(frozen=True)
class ScanAngleError(ScanGroupEffect[Poses]):
    """The sensor is turned by deg more than was commanded in one mounting (scans of one orientation) or one scan."""

    typical_deg: float = 3.0

    name = "scan_angle_error"
    words = "a wrong sensor angle in some scans"
    stage = Stage.POSE
    units = ("deg",)
    covariates = ("scan", "orientation")
    parameters = ("deg",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with each mounting and each scan as a candidate; None for a single scan."""
        choices = candidate_scan_groups(extent.plan)
        return cls(choices=choices) if choices else None

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        return replace(
            value, orientation_rad=value.orientation_rad + np.radians(theta) * scan_indicator(plan, self.scans)
        )

    def bank(self) -> FloatArray:
        return single_column_bank(self.typical_deg * np.array([1.0, -8.0, 8.0, -14.0, 14.0]))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return f"in {scans_in_words(self.scans)} the sensor is turned {_extra_turn_in_words(mean[0], sd[0])}"


def _extra_turn_in_words(deg: float, sd: float) -> str:
    way = "anticlockwise" if deg > 0 else "clockwise"
    return f"{value_with_sd(abs(deg), sd)} degrees further {way} than commanded"
