"""Effects on the footprint: displacement, height, blur, halo; and on the seen fraction, the shadow of an edge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from probewise._arrays import FloatArray
from probewise.world.concealed.stages import FootprintPart, Stage
from probewise.world.rows import Rows
from probewise.world.spots import Blob, blurred, gaussian_spot


@dataclass(frozen=True)
class SensorTilt:
    """A tilted sensor: it moves the footprint by `dx_mm`, `dy_mm` in the lab frame, whatever the orientation."""

    name: ClassVar[str] = "sensor_tilt"
    stage: ClassVar[Stage] = "tilt"
    dx_mm: float
    dy_mm: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return np.asarray(values + np.array([self.dx_mm, self.dy_mm]))


@dataclass(frozen=True)
class HeightGradient:
    """A sloping table: the sensor's height grows by `mm_per_mm` per mm of X."""

    name: ClassVar[str] = "height_gradient"
    stage: ClassVar[Stage] = "height"
    mm_per_mm: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.mm_per_mm * rows.place_mm[:, 0]


@dataclass(frozen=True)
class HeightOffset:
    """A height offset of the sensor by `mm` in the scans named in `scans`."""

    name: ClassVar[str] = "height_offset"
    stage: ClassVar[Stage] = "height"
    mm: float
    scans: tuple[str, ...]

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        return values + self.mm * rows.in_scans_mask(self.scans)


@dataclass(frozen=True)
class EdgeBlur:
    """Soft printed edges: a Gaussian blur of sd `sd_mm`, here applied to the footprint, which is equivalent."""

    name: ClassVar[str] = "edge_blur"
    stage: ClassVar[Stage] = "footprint"
    sd_mm: float

    def change_footprint(self, parts: Sequence[FootprintPart]) -> tuple[FootprintPart, ...]:
        return tuple(replace(g, spot=blurred(g.spot, self.sd_mm)) for g in parts)


@dataclass(frozen=True)
class Halo:
    """A halo: a `share` of the light comes through a wide Gaussian of sd `r_mm` about the footprint's centre."""

    name: ClassVar[str] = "halo"
    stage: ClassVar[Stage] = "footprint"
    share: float
    r_mm: float

    def change_footprint(self, parts: Sequence[FootprintPart]) -> tuple[FootprintPart, ...]:
        middle = np.sum([g.share * g.spot.moments()[0] for g in parts], axis=0)
        blob = Blob(1.0, (float(middle[0]), float(middle[1])), (self.r_mm, self.r_mm))
        # Rays resolve edges within pixels; the wide Gaussian is nearly linear over a third of its sd.
        skirt = gaussian_spot([blob], pixel_mm=self.r_mm / 3)
        return (*(replace(g, share=g.share * (1 - self.share)) for g in parts), FootprintPart(self.share, skirt))


@dataclass(frozen=True)
class ExtraGaussian:
    """A round Gaussian at `u_mm`, `v_mm` in the sensor frame with a `share` of the light; not a physical fault."""

    name: ClassVar[str] = "ssf_order"
    stage: ClassVar[Stage] = "footprint"
    share: float
    u_mm: float
    v_mm: float
    sd_mm: float

    def change_footprint(self, parts: Sequence[FootprintPart]) -> tuple[FootprintPart, ...]:
        blob = Blob(1.0, (self.u_mm, self.v_mm), (self.sd_mm, self.sd_mm))
        more = gaussian_spot([blob], pixel_mm=parts[0].spot.pixel_mm)
        return (*(replace(g, share=g.share * (1 - self.share)) for g in parts), FootprintPart(self.share, more))


@dataclass(frozen=True)
class EdgeShadow:
    """Shadow along edges of the pattern: the seen fraction falls by `amp` exp(-d^2 / 2 `w`^2), d mm from an edge."""

    name: ClassVar[str] = "edge_shadow"
    stage: ClassVar[Stage] = "seen"
    amp: float
    w: float

    def change(self, values: FloatArray, rows: Rows) -> FloatArray:
        """Subtract amp exp(-d^2 / 2 w^2) from the seen fraction; d is the distance to the nearest edge."""
        return values - self.amp * np.exp(-((rows.edge_mm / self.w) ** 2) / 2)
