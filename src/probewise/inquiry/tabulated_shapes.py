"""Tabulated response of a known sensor to ellipses and convex polygons, by tables of the unit Gaussian."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
from scipy.special import ndtri

from probewise._arrays import FloatArray, IntArray
from probewise.inquiry.ellipses import Ellipses
from probewise.inquiry.grid import Grid
from probewise.inquiry.polygons import EdgesInFootprintSds
from probewise.inquiry.scanlines import ROWS, Interval, ScanlineIntervals, to_int32, to_single_precision
from probewise.inquiry.unit_gaussian import REACH
from probewise.scene import EllipseRegion, PolygonRegion, Region, RegionsOfMixedKinds
from probewise.sensor import FixedMixture


class _CrossedShapes(Protocol):
    """Shapes of one kind (ellipses or polygons), each intersected by a row of places."""

    def interval_deeper_than(self, reach: float) -> Interval:
        """Return the interval of x (both ends) deeper than `reach` sds inside; if negative, up to that far outside."""
        ...

    def footprint_share(self, crossing: IntArray, x_mm: FloatArray) -> FloatArray:
        """Return the share of the footprint over the shape at `x_mm` of the crossings `crossing`, (n_pairs,) each."""
        ...


class _ShapesOfOneKind(Protocol):
    """Shapes of one kind (ellipses or polygons) under a footprint."""

    @property
    def y_range_mm(self) -> FloatArray:
        """Lowest and highest y of each shape, (2, n_shapes)."""
        ...

    def crossed_by_rows(self, which: IntArray, y_mm: FloatArray) -> _CrossedShapes:
        """Intersect each shape of `which` (by number) with a horizontal row at `y_mm`; both (n_crossings,)."""
        ...


@dataclass(frozen=True, eq=False)
class TabulatedShapes:
    """Shapes of hypotheses, grouped by kind for fast computation of the light from a footprint.

    `parts`: for each kind the indices of its hypotheses and their geometry in the lab frame. `footprint_mm`: the
    largest offset of a Gaussian from the sensor, and its largest sd.
    """

    n_shapes: int
    parts: tuple[tuple[IntArray, _ShapesOfOneKind], ...]
    footprint_mm: tuple[float, float]

    @classmethod
    def of(cls, region: Region, footprint: FixedMixture) -> Self | None:
        """Build from the regions of hypotheses; None unless all are white ellipses or convex polygons."""
        parts = []
        for rows, part in _rows_and_regions_by_kind(region):
            kind = _shapes_of_one_kind(part, footprint)
            if kind is None:
                return None
            parts.append((rows, kind))
        off = np.linalg.norm(footprint.means_mm, axis=1).max()
        widest = np.sqrt(np.linalg.eigvalsh(footprint.covs_mm2).max())
        return cls(region.n_regions, tuple(parts), (float(off), float(widest)))

    def footprint_share(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Return the share of the footprint over every shape at places, (n_places,) -> (n_shapes, n_places)."""
        out = np.empty((self.n_shapes, len(x_mm)))
        for rows, kind in self.parts:
            every = np.repeat(np.arange(len(rows)), len(x_mm))
            crossed = kind.crossed_by_rows(every, np.tile(to_single_precision(y_mm), len(rows)))
            seen = crossed.footprint_share(np.arange(len(every)), np.tile(to_single_precision(x_mm), len(rows)))
            out[rows] = seen.reshape(len(rows), len(x_mm))
        return out

    def level_histogram(
        self, weight: FloatArray, grid: Grid, dark: float, bright: float, levels: FloatArray
    ) -> FloatArray:
        """Return the weighted histogram of predicted levels at every place of a grid, (n_places, n_levels).

        `weight`: of each shape, (n_shapes,); each row of the result has the same sum. `dark`, `bright`: readings
        outside and inside. `levels`: evenly spaced, (n_levels,), from the darkest to the brightest; a reading counts
        for the nearest.
        """
        n_levels = len(levels)
        first, per_level = float(levels[0]), 1.0 / float(levels[1] - levels[0])
        lowest, per_share = (dark - first) * per_level, (bright - dark) * per_level
        ends = round(lowest), round(lowest + per_share)
        # Beyond this distance the nearest level is constant: a quarter of a level, since two edges may add up.
        reach = min(REACH, -float(ndtri(0.25 / max(abs(per_share), 1.0))))
        pad_mm = self.footprint_mm[0] + reach * self.footprint_mm[1]
        mass = np.zeros((grid.n_places, n_levels))
        for rows, kind in self.parts:
            own = weight[rows]
            bottom, top = kind.y_range_mm + np.array([[-pad_mm], [pad_mm]], dtype=np.float32)
            for start in range(0, grid.n_y, ROWS):
                y_mm = to_single_precision(grid.y_mm[start : start + ROWS])
                row, which = np.nonzero((y_mm[:, None] >= bottom) & (y_mm[:, None] <= top) & (own > 0))
                crossed = kind.crossed_by_rows(which, y_mm[row])
                intervals = ScanlineIntervals.from_interval_ends(
                    grid,
                    len(y_mm),
                    row,
                    which,
                    crossed.interval_deeper_than(-reach),
                    crossed.interval_deeper_than(reach),
                )
                ring = intervals.places_near_edges()
                seen = crossed.footprint_share(ring.interval, to_single_precision(grid.x_mm)[ring.column])
                level = to_int32(lowest + per_share * seen + 0.5)
                block = slice(start * grid.n_x, (start + ROWS) * grid.n_x)
                mass[block] += intervals.level_histogram(own, ring, level, ends, n_levels)
        return mass


def _rows_and_regions_by_kind(region: Region) -> Iterator[tuple[IntArray, Region]]:
    """Yield the regions of each kind, with the indices of their hypotheses."""
    if isinstance(region, RegionsOfMixedKinds):
        yield from region.rows_and_regions()
    else:
        yield np.arange(region.n_regions), region


def _shapes_of_one_kind(region: Region, footprint: FixedMixture) -> _ShapesOfOneKind | None:
    """Build the geometry of regions under a footprint; None unless they are white ellipses or convex polygons."""
    if not isinstance(region, (EllipseRegion, PolygonRegion)) or (region.outside, region.inside) != (0.0, 1.0):
        return None
    return (
        Ellipses.of(region, footprint)
        if isinstance(region, EllipseRegion)
        else EdgesInFootprintSds.of(region, footprint)
    )
