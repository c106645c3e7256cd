"""Patterns that do not lie where the description says: effects on the scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.extent import Extent
from probewise.effects.heavy_tailed import HeavyTailed
from probewise.effects.moves import in_scans
from probewise.effects.vocabulary import NamedEffect, give_or_take
from probewise.priors import Product
from probewise.recordings.patterns import HalfPlane, Ramp, Stripes
from probewise.recordings.plan import Plan
from probewise.sensor.stages import SceneView, Stage

__all__ = ["EdgeMisplacement", "ScanMisplacement"]


@dataclass(frozen=True)
class EdgeMisplacement(NamedEffect[SceneView]):
    """Every pattern lies offset_mm further along its edge's normal, or along X where it has more than one edge."""

    typical_mm: float = 0.3

    name: ClassVar[str] = "edge_misplacement"
    stage: ClassVar[Stage] = Stage.SCENE
    units: ClassVar[tuple[str, ...]] = ("mm",)
    covariates: ClassVar[tuple[str, ...]] = ("slope",)
    amplitudes: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Take three thousandths of the longest scan as typical."""
        return cls(typical_mm=0.003 * extent.length_mm)

    @cached_property
    def prior(self) -> Product:
        """How far, to either side."""
        return Product({"offset_mm": HeavyTailed(self.typical_mm)})

    def apply(self, value: SceneView, theta: FloatArray, plan: Plan) -> SceneView:
        """Move the patterns."""
        return _moved(value, theta * np.ones(len(plan)), plan)

    def bank(self) -> FloatArray:
        """One setting: linear in the offset."""
        return np.full((1, 1, 1), self.typical_mm)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say how far off the pattern lies."""
        return f"the printed edges lie {give_or_take(mean[0], sd[0])} mm from where they are said to be, in all scans"


@dataclass(frozen=True)
class ScanMisplacement(NamedEffect[SceneView]):
    """The same in one scan: its pattern lies offset_mm further along its edge's normal, or along X.

    `scans` names that scan, `choices` are all that it might be.
    """

    typical_mm: float = 0.3
    scans: tuple[str, ...] = ()
    choices: tuple[tuple[str, ...], ...] = ()

    name: ClassVar[str] = "scan_misplacement"
    stage: ClassVar[Stage] = Stage.SCENE
    units: ClassVar[tuple[str, ...]] = ("mm",)
    covariates: ClassVar[tuple[str, ...]] = ("scan", "slope")
    amplitudes: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Take three thousandths of the longest scan as typical, where there is more than one."""
        names = tuple(dict.fromkeys(extent.plan.scan_names))
        return cls(0.003 * extent.length_mm, (), tuple((name,) for name in names)) if len(names) > 1 else None

    @cached_property
    def prior(self) -> Product:
        """How far, to either side."""
        return Product({"offset_mm": HeavyTailed(self.typical_mm)})

    def apply(self, value: SceneView, theta: FloatArray, plan: Plan) -> SceneView:
        """Move the patterns under that scan."""
        return _moved(value, theta * in_scans(plan, self.scans), plan)

    def variants(self) -> tuple[Self, ...]:
        """Choose the scan."""
        return tuple(replace(self, scans=choice) for choice in self.choices)

    def bank(self) -> FloatArray:
        """One setting: linear in the offset."""
        return np.full((1, 1, 1), self.typical_mm)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say how far off the pattern lies, and in which scan."""
        return (
            f"in scan {', '.join(self.scans)} the pattern lies {give_or_take(mean[0], sd[0])} mm from where it lay "
            "in the others"
        )


def _moved(view: SceneView, by_mm: FloatArray, plan: Plan) -> SceneView:
    """Move each reading's pattern by so much, (n_samples, n_points)."""
    angle = np.zeros(len(plan))
    for name, rows in plan.rows_by_pattern():
        pattern = plan.patterns.get(name)
        if isinstance(pattern, HalfPlane | Stripes | Ramp):
            angle[rows] = pattern.normal_rad
    return replace(view, dx_mm=view.dx_mm + by_mm * np.cos(angle), dy_mm=view.dy_mm + by_mm * np.sin(angle))
