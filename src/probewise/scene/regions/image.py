"""An image of albedos."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray, read_only_floats, require_finite
from probewise.errors import ParameterError, ShapeError


@dataclass(frozen=True, eq=False)
class ImageRegion:
    """One image of albedos: `values` (n_rows, n_columns), first row on top, 0 outside it.

    `pixel_mm` is a pixel's side, `origin_mm` the lower left corner; hypotheses share the image (n_regions is 1).
    """

    values: FloatArray
    pixel_mm: float
    origin_mm: tuple[float, float]

    def __post_init__(self) -> None:
        values = read_only_floats(self.values)
        if values.ndim != 2 or values.size == 0:
            raise ShapeError(f"image has shape {values.shape}; allowed: (n_rows, n_columns), not empty")
        require_finite("image", values)
        if not (0 < self.pixel_mm < math.inf):
            raise ParameterError("pixel_mm", self.pixel_mm, "greater than 0")
        object.__setattr__(self, "values", values)

    @property
    def n_regions(self) -> int:
        """1: all hypotheses share the image."""
        return 1

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        return self._albedo_at(points_mm[:, 0], points_mm[:, 1])[None]

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Return the mean albedo over turned square pixels, (1, n_points): exact if unturned, else by eight strips."""
        cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
        steep, flat = np.maximum(np.abs(cosine), 1e-9), np.maximum(np.abs(sine), 1e-9)
        half = 0.5 * pixel_mm
        height = half * (np.abs(cosine) + np.abs(sine))
        total, area = np.zeros(len(centers_mm)), np.zeros(len(centers_mm))
        n_strips = 8
        for k in range(n_strips):
            low, high = (2 * k / n_strips - 1) * height, (2 * (k + 1) / n_strips - 1) * height
            y = 0.5 * (low + high)
            # Inside the square |c x + s y| and |c y - s x| are at most half a side.
            middle_1, middle_2 = -sine * y * cosine / steep**2, cosine * y * sine / flat**2
            left = np.maximum(middle_1 - half / steep, middle_2 - half / flat)
            right = np.maximum(left, np.minimum(middle_1 + half / steep, middle_2 + half / flat))
            bottom, top = centers_mm[:, 1] + low, centers_mm[:, 1] + high
            near, far = centers_mm[:, 0] + left, centers_mm[:, 0] + right
            total += self._albedo_integral_to_lower_left(far, top) - self._albedo_integral_to_lower_left(near, top)
            total -= self._albedo_integral_to_lower_left(far, bottom) - self._albedo_integral_to_lower_left(
                near, bottom
            )
            area += (right - left) * (high - low)
        return (total / area)[None]

    @cached_property
    def _summed_area_table(self) -> FloatArray:
        """Summed-area table: sums of the pixels to the lower left of each corner, (n_rows + 1, n_columns + 1)."""
        padded = np.zeros((self.values.shape[0] + 1, self.values.shape[1] + 1))
        padded[1:, 1:] = self.values[::-1].cumsum(axis=0).cumsum(axis=1)
        return padded

    def _albedo_integral_to_lower_left(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Return the integral of the albedo to the lower left of each point (x, y), in mm^2."""
        n_rows, n_columns = self.values.shape
        u = np.clip((x_mm - self.origin_mm[0]) / self.pixel_mm, 0, n_columns)
        v = np.clip((y_mm - self.origin_mm[1]) / self.pixel_mm, 0, n_rows)
        i, j = np.minimum(v.astype(np.int64), n_rows - 1), np.minimum(u.astype(np.int64), n_columns - 1)
        u, v, table = u - j, v - i, self._summed_area_table
        lower = (1 - u) * table[i, j] + u * table[i, j + 1]
        upper = (1 - u) * table[i + 1, j] + u * table[i + 1, j + 1]
        return np.asarray(((1 - v) * lower + v * upper) * self.pixel_mm**2)

    def _albedo_at(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        n_rows, n_columns = self.values.shape
        column = np.floor((x_mm - self.origin_mm[0]) / self.pixel_mm).astype(np.int64)
        row = n_rows - 1 - np.floor((y_mm - self.origin_mm[1]) / self.pixel_mm).astype(np.int64)
        within = (column >= 0) & (column < n_columns) & (row >= 0) & (row < n_rows)
        found = self.values[np.where(within, row, 0), np.where(within, column, 0)]
        return np.where(within, found, 0.0)
