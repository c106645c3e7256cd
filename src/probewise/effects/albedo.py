"""Surfaces that are not as white or black as they should be: effects on the scene.

Both change every pattern's albedo S, and its mean under a Gaussian footprint N(m, C) has a closed form.
For S times a linear field t.p, by parts (Stein's lemma): E[S t.p] = t.m E[S] + (C t) . dE[S]/dm.
For a Gaussian patch it is the integral of a product of two Gaussians.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.linear import LinearEffect
from probewise.effects.origin import CountsPlaceFromOrigin, Origin
from probewise.effects.patches import PatchEffect, distinct_scan_lines, gaussian_bump
from probewise.recordings.plan import Plan
from probewise.scene.albedo import Region
from probewise.scene.regions import edge_distance
from probewise.sensor.gaussian import LabGaussian, mean_albedo_under_one_gaussian
from probewise.sensor.stages import SceneView, Stage

_STEP = 1e-3  # of a standard deviation, for the central difference: its error is a millionth of this


@dataclass(frozen=True)
class AlbedoGradient(CountsPlaceFromOrigin, LinearEffect[SceneView]):
    """Paper or illumination that is uneven across the table: S (1 + per_mm_x X + per_mm_y Y).

    X and Y are those of the lab frame, from `origin`.
    """

    typical_per_mm: float = 2e-4

    name = "albedo_gradient"
    words = "unevenly white paper"
    stage = Stage.SCENE
    units = ("1/mm", "1/mm")
    covariates = ("place",)
    parameters = ("per_mm_x", "per_mm_y")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with a typical slope of 2 % over the length of the longest scan."""
        return cls(typical_per_mm=0.02 / extent.length_mm, origin=extent.origin)

    def apply(self, value: SceneView, theta: FloatArray, plan: Plan) -> SceneView:
        regions = _regions_with_readings(value, plan)
        return replace(value, regions={name: RegionWithGradient(r, theta, self.origin) for name, r in regions.items()})

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the signal over white changes by {value_with_sd(mean[0], sd[0], factor=1e4)} % per 100 mm along X and by "
            f"{value_with_sd(mean[1], sd[1], factor=1e4)} % per 100 mm along Y, that over black does not: the paper or "
            "its illumination is uneven"
        )


@dataclass(frozen=True)
class AlbedoPatch(PatchEffect[SceneView]):
    """A stain or a bright patch on every pattern: S + albedo exp(-d^2 / 2 r^2), d the distance from (x, y)."""

    typical: float = 0.05

    name = "albedo_patch"
    words = "a stain on the paper"
    stage = Stage.SCENE
    size = "albedo"
    units = ("1", "mm", "mm", "mm")
    covariates = ("place",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with a bank on the straight scans; None without any."""
        lines = distinct_scan_lines(extent.plan)
        return cls(line=lines[0], lines=lines) if lines else None

    def apply(self, value: SceneView, theta: FloatArray, plan: Plan) -> SceneView:
        return replace(
            value, regions={name: RegionWithPatch(r, theta) for name, r in _regions_with_readings(value, plan).items()}
        )

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        kind = "whiter" if mean[0] > 0 else "darker"
        return (
            f"within {value_with_sd(mean[3], sd[3])} mm of the place ({value_with_sd(mean[1], sd[1])}, "
            f"{value_with_sd(mean[2], sd[2])}) mm every pattern is "
            f"{value_with_sd(abs(mean[0]), sd[0], factor=100)} % {kind} than it should be: a stain or a worn area"
        )


@dataclass(frozen=True, eq=False)
class RegionWithGradient:
    """A region whose albedo is multiplied by 1 + per_mm . (X, Y), from `origin`; `per_mm` has shape (n_samples, 2)."""

    region: Region
    per_mm: FloatArray
    origin: Origin = field(default=Origin())

    @property
    def n_regions(self) -> int:
        """Number of regions, one for each sample; 1 where all samples share one."""
        return max(self.region.n_regions, len(self.per_mm))

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Return the albedo at points, (n_points, 2) -> (n_regions, n_points)."""
        return self.region.albedo(points_mm) * self._albedo_factor_at_points(points_mm)

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Return the mean albedo over pixels, the gradient taken at their centres: (n_regions, n_points)."""
        return self.region.coverage(centers_mm, pixel_mm, turn_rad) * self._albedo_factor_at_points(centers_mm)

    def _albedo_factor_at_points(self, points_mm: FloatArray) -> FloatArray:
        return np.asarray(1 + self.per_mm @ (points_mm - [self.origin.x_mm, self.origin.y_mm]).T)


@mean_albedo_under_one_gaussian.register
def _mean_albedo_with_gradient(region: RegionWithGradient, gaussian: LabGaussian, n_nodes: int) -> FloatArray:
    """Return the mean albedo under each Gaussian, (n_samples, n_points), by Stein's lemma.

    The mean is the gradient's factor at the centre times the region's mean albedo, plus a central difference of the
    region's mean along the gradient.
    """
    a, b = region.per_mm[:, :1], region.per_mm[:, 1:]
    x, y = a * gaussian.var_x + b * gaussian.cov_xy, a * gaussian.cov_xy + b * gaussian.var_y  # C t
    rise = np.sqrt(np.maximum(a * x + b * y, 1e-300))  # sd of the field under the footprint, t.C t
    x, y = x / rise * _STEP, y / rise * _STEP

    def mean_albedo_at_shift(sign: float) -> FloatArray:
        moved = replace(gaussian, dx_mm=gaussian.dx_mm + sign * x, dy_mm=gaussian.dy_mm + sign * y)
        return mean_albedo_under_one_gaussian(region.region, moved, n_nodes)

    ahead, behind = mean_albedo_at_shift(1.0), mean_albedo_at_shift(-1.0)
    from_x = gaussian.x_mm + gaussian.dx_mm - region.origin.x_mm
    from_y = gaussian.y_mm + gaussian.dy_mm - region.origin.y_mm
    factor = 1 + a * from_x + b * from_y
    return np.asarray(factor * (ahead + behind) / 2 + rise * (ahead - behind) / (2 * _STEP))


@dataclass(frozen=True, eq=False)
class RegionWithPatch:
    """A region and a bell-shaped patch on it; `patch` holds albedo, x, y, r, (n_samples, 4)."""

    region: Region
    patch: FloatArray

    @property
    def n_regions(self) -> int:
        """Number of regions, one for each sample; 1 where all samples share one."""
        return max(self.region.n_regions, len(self.patch))

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Return the albedo at points, (n_points, 2) -> (n_regions, n_points)."""
        return self.region.albedo(points_mm) + self._added_albedo(points_mm)

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Return the mean albedo over pixels, the patch taken at their centres: (n_regions, n_points)."""
        return self.region.coverage(centers_mm, pixel_mm, turn_rad) + self._added_albedo(centers_mm)

    def _added_albedo(self, points_mm: FloatArray) -> FloatArray:
        albedo, x, y, r = (self.patch[:, k : k + 1] for k in range(4))
        return albedo * gaussian_bump((points_mm[:, 0] - x) ** 2 + (points_mm[:, 1] - y) ** 2, r)


@mean_albedo_under_one_gaussian.register
def _mean_albedo_with_patch(region: RegionWithPatch, gaussian: LabGaussian, n_nodes: int) -> FloatArray:
    """Return the mean albedo under each Gaussian: the region's, plus the patch's, a bell of covariance C + r^2."""
    albedo, x, y, r = (region.patch[:, k : k + 1] for k in range(4))
    from_x, from_y = gaussian.x_mm + gaussian.dx_mm - x, gaussian.y_mm + gaussian.dy_mm - y
    var_x, var_y = gaussian.var_x + r**2, gaussian.var_y + r**2
    det = var_x * var_y - gaussian.cov_xy**2
    distance = (var_y * from_x**2 + var_x * from_y**2 - 2 * gaussian.cov_xy * from_x * from_y) / det
    added = albedo * r**2 / np.sqrt(det) * np.exp(-0.5 * distance)
    return mean_albedo_under_one_gaussian(region.region, gaussian, n_nodes) + added


def _regions_with_readings(view: SceneView, plan: Plan) -> Mapping[str, Region]:
    """Return the regions over which at least one reading is taken, by the pattern's name."""
    return {name: view.regions[name] for name, _ in plan.rows_by_pattern() if name in view.regions}


@edge_distance.register(RegionWithGradient)
@edge_distance.register(RegionWithPatch)
def _distance_to_unchanged_edge(
    region: RegionWithGradient | RegionWithPatch, x_mm: FloatArray, y_mm: FloatArray
) -> FloatArray:
    """Return the distance of points from the nearest edge of the region, which the effect leaves in place, mm."""
    return edge_distance(region.region, x_mm, y_mm)
