"""Patterns that do not lie where the recording's description says: effects on the scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.linear import LinearEffect, ScanGroupEffect, scans_in_words
from probewise.effects.motion import scan_indicator
from probewise.recordings.patterns import HalfPlane, Ramp, Stripes
from probewise.recordings.plan import Plan
from probewise.sensor.stages import SceneView, Stage


@dataclass(frozen=True)
class EdgeMisplacement(LinearEffect[SceneView]):
    """Every pattern is shifted by offset_mm: along its normal (half-plane, stripes, ramp), or along X (all others)."""

    typical_mm: float = 0.3

    name = "edge_misplacement"
    words = "misplaced edges"
    stage = Stage.SCENE
    units = ("mm",)
    covariates = ("slope",)
    parameters = ("offset_mm",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical offset to 0.3 % of the length of the longest scan."""
        return cls(typical_mm=0.003 * extent.length_mm)

    def apply(self, value: SceneView, theta: FloatArray, plan: Plan) -> SceneView:
        return _with_shifted_patterns(value, theta * np.ones(len(plan)), plan)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return f"the printed edges lie {value_with_sd(mean[0], sd[0])} mm from their described place, in all scans"


@dataclass(frozen=True)
class ScanMisplacement(ScanGroupEffect[SceneView]):
    """In one scan the pattern is shifted by offset_mm: along its normal (half-plane, stripes, ramp), or along X."""

    typical_mm: float = 0.3

    name = "scan_misplacement"
    words = "a misplaced pattern in one scan"
    stage = Stage.SCENE
    units = ("mm",)
    covariates = ("scan", "slope")
    parameters = ("offset_mm",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Set the typical offset to 0.3 % of the length of the longest scan; None for a single scan."""
        names = tuple(dict.fromkeys(extent.plan.scan_names))
        if len(names) < 2:
            return None
        return cls(choices=tuple((name,) for name in names), typical_mm=0.003 * extent.length_mm)

    def apply(self, value: SceneView, theta: FloatArray, plan: Plan) -> SceneView:
        return _with_shifted_patterns(value, theta * scan_indicator(plan, self.scans), plan)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"in {scans_in_words(self.scans)} the pattern lies {value_with_sd(mean[0], sd[0])} mm from where it lies "
            "in the others"
        )


def _with_shifted_patterns(view: SceneView, by_mm: FloatArray, plan: Plan) -> SceneView:
    """Return the view with each reading's pattern shifted by `by_mm`, (n_samples, n_points).

    The shift is along the normal of a half-plane, stripes or a ramp, and along X otherwise.
    """
    angle = np.zeros(len(plan))
    for name, rows in plan.rows_by_pattern():
        pattern = plan.patterns.get(name)
        if isinstance(pattern, HalfPlane | Stripes | Ramp):
            angle[rows] = pattern.normal_rad
    return replace(view, dx_mm=view.dx_mm + by_mm * np.cos(angle), dy_mm=view.dy_mm + by_mm * np.sin(angle))
