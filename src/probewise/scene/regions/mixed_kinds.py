"""Regions whose kind may differ between hypotheses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray, IntArray, frozen_int
from probewise.errors import ParameterError, ShapeError
from probewise.scene.albedo import Region
from probewise.scene.regions.checks import RegionBatch
from probewise.scene.regions.geometry import edge_distance, outlines


@dataclass(frozen=True, eq=False)
class RegionsOfMixedKinds(RegionBatch):
    """Regions whose kind may differ between hypotheses, as for a set of shapes.

    `which`, shape (n_regions,), is the index of each hypothesis' part; part k holds, in
    order, the regions of the hypotheses with which == k.
    """

    which: IntArray
    parts: tuple[Region, ...]

    def __post_init__(self) -> None:
        which = frozen_int(self.which)
        object.__setattr__(self, "which", which)
        for k, part in enumerate(self.parts):
            wanted = int(np.sum(which == k))
            if wanted and part.n_regions != wanted:
                raise ShapeError(f"part {k} holds {part.n_regions} regions; allowed: {wanted}, one per {k} in which")
        if which.ndim != 1 or (which.size and (which.min() < 0 or which.max() >= len(self.parts))):
            raise ParameterError("which", which.tolist(), f"0 to {len(self.parts) - 1}, one per hypothesis")

    def rows_and_regions(self) -> list[tuple[IntArray, Region]]:
        """List, for each part that occurs, the row numbers of its hypotheses in `which`, and their region."""
        pairs = [(np.flatnonzero(self.which == k), part) for k, part in enumerate(self.parts)]
        return [(rows, part) for rows, part in pairs if rows.size]

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        out = np.empty((self.n_regions, len(points_mm)))
        for rows, part in self.rows_and_regions():
            out[rows] = part.albedo(points_mm)
        return out

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        out = np.empty((self.n_regions, len(centers_mm)))
        for rows, part in self.rows_and_regions():
            out[rows] = part.coverage(centers_mm, pixel_mm, turn_rad)
        return out


@outlines.register
def _outlines_of_mixed_kinds(region: RegionsOfMixedKinds, *, n_vertices: int = 96) -> list[FloatArray]:
    traces: list[FloatArray] = [np.empty((0, 2))] * region.n_regions
    for rows, part in region.rows_and_regions():
        for row, trace in zip(rows, outlines(part, n_vertices=n_vertices), strict=True):
            traces[int(row)] = trace
    return traces


@edge_distance.register
def _edge_distance_of_mixed_kinds(region: RegionsOfMixedKinds, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    shape = (region.n_regions, max(x_mm.shape[1], y_mm.shape[1]))
    x_mm, y_mm = np.broadcast_to(x_mm, shape), np.broadcast_to(y_mm, shape)
    out = np.empty(shape)
    for rows, part in region.rows_and_regions():
        out[rows] = edge_distance(part, x_mm[rows], y_mm[rows])
    return out
