"""Protocols of what lies under the sensor: an albedo region, a shape, a scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from probewise._arrays import FloatArray
from probewise._kinds import require_like
from probewise.priors import Prior


class Region(Protocol):
    """An albedo field for each hypothesis: `n_regions` of them, 1 where all share one.

    Regions are small frozen values of batched geometry (scene/regions/). The sensor integrates
    a region in closed form where its kind has one (sensor/gaussian.py), or pixel by pixel through
    `coverage` (sensor/discrete.py).
    """

    @property
    def n_regions(self) -> int:
        """Number of hypotheses, or 1 where all share one region."""
        ...

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """Return the albedo at points, (n_points, 2) lab frame -> (n_regions, n_points)."""
        ...

    def coverage(self, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray) -> FloatArray:
        """Return the mean albedo over each of many square pixels, (n_regions, n_points).

        The pixels have centres `centers_mm` (n_points, 2), side `pixel_mm`, and are turned by `turn_rad` (n_points,).
        """
        ...


class Shape(Protocol):
    """A hypothesis about what lies on the field: named parameters, their prior, and the region they define."""

    @property
    def prior(self) -> Prior:
        """Prior of the shape's parameters, with their names."""
        ...

    def region(self, theta: FloatArray) -> Region:
        """Build the regions of the hypotheses, one per row of theta (n_samples, n_params)."""
        ...


class Scene(Protocol):
    """What lies under the sensor in one plan: a region for each pattern name."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its free parameters; () where everything is known."""
        ...

    def regions(self, theta: FloatArray) -> Mapping[str, Region]:
        """Return by pattern name the regions of the hypotheses, one per row of theta (n_samples, n_params)."""
        ...


def require_shape(shape: object, name: str = "shape") -> None:
    """Raise ParameterError unless `shape` has `prior` and `region`."""
    require_like(name, shape, ("prior", "region"), "a shape such as Circle() or Rectangle(), of probewise.scene")
