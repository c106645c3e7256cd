"""Response of a known footprint to convex polygons, from the two nearest edges."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Self

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.inquiry.scanlines import Interval, to_single_precision
from probewise.inquiry.unit_gaussian import N_OPENINGS, mass_within_corner
from probewise.scene import PolygonRegion
from probewise.sensor import FixedMixture

_MOST_EDGES = 8
_LEAST = np.float32(1e-9)


@dataclass(frozen=True, eq=False)
class EdgesInFootprintSds:
    """Edges of polygons as half-planes, in sds of each Gaussian of the footprint across the edge.

    Distance inside edge k = across x + up y + offset, arrays (n_gaussians, n_edges, n_polygons), for the sensor at
    (x, y). `opening` (n_gaussians, 2^n_edges, n_polygons), at 2^k + 2^m, numbers the corner of edges k and m; see
    `mass_within_corner`. `share` is the weight of each Gaussian. `y_range_mm` (2, n_polygons) are the lowest and the
    highest corner.
    """

    y_range_mm: FloatArray
    share: FloatArray
    across: FloatArray
    up: FloatArray
    offset: FloatArray
    opening: IntArray

    @classmethod
    def of(cls, region: PolygonRegion, footprint: FixedMixture) -> Self | None:
        """Build from n_polygons convex polygons, of up to eight edges, under a lab-frame footprint; None for others."""
        edges = region.edges_mm
        n_edges = edges.shape[1]
        along = edges[:, :, 1] - edges[:, :, 0]
        following = np.roll(along, -1, axis=1)
        turning = along[..., 0] * following[..., 1] - along[..., 1] * following[..., 0]
        closed = np.array_equal(edges[:, :, 1], np.roll(edges[:, :, 0], -1, axis=1))
        if not closed or n_edges > _MOST_EDGES or (turning <= 0).any():
            return None
        normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        covariance = np.einsum("pki,gij,plj->gklp", normal, footprint.covs_mm2, normal, optimize=True)
        sd = np.sqrt(np.einsum("gkkp->gkp", covariance))
        slant = np.arcsin(np.clip(covariance / (sd[:, :, None] * sd[:, None]), -1.0, 1.0))
        kind = np.minimum(np.floor((slant / np.pi + 0.5) * N_OPENINGS), N_OPENINGS - 1)
        opening = np.zeros((len(sd), 2**n_edges, len(edges)), dtype=np.int64)
        for k, m in combinations(range(n_edges), 2):
            opening[:, 2**k + 2**m] = kind[:, k, m]
        from_start = footprint.means_mm[:, None, None] - edges[:, :, 0]
        return cls(
            to_single_precision(np.stack([edges[:, :, 0, 1].min(axis=1), edges[:, :, 0, 1].max(axis=1)])),
            to_single_precision(footprint.weights),
            to_single_precision(normal[..., 0].T / sd),
            to_single_precision(normal[..., 1].T / sd),
            to_single_precision(np.einsum("gpki,pki->gkp", from_start, normal) / sd),
            opening,
        )

    def crossed_by_rows(self, which: IntArray, y_mm: FloatArray) -> CrossedPolygons:
        """Intersect each polygon of `which` (by number) with a horizontal row at `y_mm`; both (n_crossings,)."""
        slope, up, offset = (values.take(which, axis=-1) for values in (self.across, self.up, self.offset))
        return CrossedPolygons(self.share, slope, up * y_mm + offset, self.opening, which)


@dataclass(frozen=True, eq=False)
class CrossedPolygons:
    """Polygons `which`, (n_crossings,), intersected by rows.

    Distance inside edge k = slope x + base, (n_gaussians, n_edges, n_crossings).
    """

    share: FloatArray
    slope: FloatArray
    base: FloatArray
    opening: IntArray
    which: IntArray

    def interval_deeper_than(self, reach: float) -> Interval:
        """Return the interval of x (both ends) deeper than `reach` sds inside; if negative, up to that far outside.

        For several Gaussians, the outermost counts outside the polygon, and the innermost inside.
        """
        slope = np.where(np.abs(self.slope) < _LEAST, _LEAST, self.slope)
        at = (np.float32(reach) - self.base) / slope
        rises = slope > 0
        low, high = np.where(rises, at, -np.inf), np.where(rises, np.inf, at)
        outermost, innermost = (np.min, np.max) if reach < 0 else (np.max, np.min)
        return outermost(low, axis=0).max(axis=0), innermost(high, axis=0).min(axis=0)

    def footprint_share(self, crossing: IntArray, x_mm: FloatArray) -> FloatArray:
        """Return the share of the footprint over the polygon at `x_mm` of the crossings `crossing`, (n_pairs,) each."""
        which = self.which.take(crossing)
        out = to_single_precision(np.zeros(x_mm.shape))
        for share, slope, base, opening in zip(self.share, self.slope, self.base, self.opening, strict=True):
            inside = []
            for a, b in zip(slope, base, strict=True):
                distance = a.take(crossing)
                distance *= x_mm
                distance += b.take(crossing)
                inside.append(distance)
            nearest, second = np.minimum(*inside[:2]), np.maximum(*inside[:2])
            for distance in inside[2:]:
                second = np.minimum(second, np.maximum(nearest, distance))
                nearest = np.minimum(nearest, distance)
            edges = np.zeros(nearest.shape, dtype=np.uint8)
            for k, distance in enumerate(inside):
                edges |= (distance <= second).view(np.uint8) << np.uint8(k)
            out = out + share * mass_within_corner(
                nearest, second, opening.take(edges * np.int64(opening.shape[1]) + which)
            )
        return out
