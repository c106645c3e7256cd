"""Errors of the sensor's height: a higher sensor has a wider footprint and a weaker signal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.linear import LinearEffect, ScanGroupEffect, scans_in_words
from probewise.effects.motion import candidate_scan_groups, scan_indicator
from probewise.effects.origin import CountsPlaceFromOrigin
from probewise.recordings.plan import Plan
from probewise.sensor.commanded import footprint_at_added_height
from probewise.sensor.stages import Footprint, Stage

_USUAL_MM = 14.0  # the height assumed where a recording gives none


@dataclass(frozen=True)
class HeightGradient(CountsPlaceFromOrigin, LinearEffect[Footprint]):
    """A table that slopes: mm_per_mm X adds to the height; footprint x h/h0, signal x (h0/h)^2.

    h = h0 + mm_per_mm X with h0 of the recording's description, or 14 mm where it gives none; where a height is
    commanded, h is that height + mm_per_mm X. X counts from `origin`.
    """

    typical: float = 0.001

    name = "height_gradient"
    words = "a sloping table"
    stage = Stage.FOOTPRINT
    units = ("mm/mm",)
    covariates = ("place",)
    parameters = ("mm_per_mm",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical slope to 1 % of the height over the longest scan."""
        typical = 0.01 * _nominal_height_mm(extent.plan) / extent.length_mm
        return cls(typical=typical, origin=extent.origin)

    def apply(self, value: Footprint, theta: FloatArray, plan: Plan) -> Footprint:
        added = theta[:, :1] * (plan.x_mm - self.origin.x_mm) / _nominal_height_mm(plan)
        return footprint_at_added_height(value, added, plan)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        way = "grows" if mean[0] > 0 else "shrinks"
        return (
            f"the sensor's height above the surface {way} by {value_with_sd(abs(mean[0]), sd[0], factor=100)} mm per "
            "100 mm along X: the table slopes"
        )


@dataclass(frozen=True)
class HeightOffset(ScanGroupEffect[Footprint]):
    """One mounting or scan at another height: mm adds to the height there; footprint x h/h0, signal x (h0/h)^2.

    h0 and h are those of `HeightGradient`.
    """

    typical_mm: float = 0.15

    name = "height_offset"
    words = "another sensor height in some scans"
    stage = Stage.FOOTPRINT
    units = ("mm",)
    covariates = ("scan",)
    parameters = ("mm",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical offset to 1 % of the height; None for a single scan."""
        choices = candidate_scan_groups(extent.plan)
        return cls(choices=choices, typical_mm=0.01 * _nominal_height_mm(extent.plan)) if choices else None

    def apply(self, value: Footprint, theta: FloatArray, plan: Plan) -> Footprint:
        added = theta * scan_indicator(plan, self.scans) / _nominal_height_mm(plan)
        return footprint_at_added_height(value, added, plan)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        way = "higher" if mean[0] > 0 else "lower"
        much = value_with_sd(abs(mean[0]), sd[0])
        return f"in {scans_in_words(self.scans)} the sensor hangs {much} mm {way} than in the others"


def _nominal_height_mm(plan: Plan) -> float:
    """Return the height in the recording's description, or 14 mm where it gives none."""
    return plan.instrumentation.height_mm or _USUAL_MM
