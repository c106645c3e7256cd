"""What is uncertain of an arm's geometry, and what that does to where the sensor stands."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray
from probewise.arm.geometry import Geometry, placed_mm

__all__ = ["FITTED", "RULER_SDS", "places_of", "slopes_mm", "values_of"]

FITTED = (
    *("base home", "shoulder home", "elbow home", "upper link", "lower link"),
    *("base x", "base y", "shoulder forward", "shoulder height"),
)
"""What is fitted, angles in radians, lengths in mm; the sensor's own lengths go with those of the shoulder."""

RULER_SDS = np.array([*np.radians([5.0, 5.0, 5.0]), 5.0, 5.0, 10.0, 10.0, 10.0, 10.0])
"""So well is each known before, from a ruler and by eye."""


def values_of(geometry: Geometry) -> FloatArray:
    """Take the numbers of `FITTED`, (9,)."""
    homes = [joint.home_rad for joint in geometry.joints]
    return np.array([*homes, *geometry.links_mm, *geometry.axis_mm, *geometry.shoulder_mm])


def places_of(geometry: Geometry, values: FloatArray, turned_rad: FloatArray) -> FloatArray:
    """Place the sensor, (n, 3), of an arm of other numbers whose joints have turned so far from home, (n, 3)."""
    return placed_mm(
        values[:3] + turned_rad,
        values[3:5],
        values[5:7],
        values[7:9],
        geometry.sensor_mm,
        elbow_is_relative=geometry.elbow_is_relative,
    )


def slopes_mm(geometry: Geometry, places_mm: FloatArray) -> FloatArray:
    """Tell how the sensor's true place and height change with each number of the geometry.

    Parameters
    ----------
    geometry
        The arm as it is known.
    places_mm
        Where it says that the sensor is, (n, 2), at the height of reading.

    Returns
    -------
    Shape (n, 3, 9): x, y and height by the numbers of `FITTED`; NaN at a place that the arm does not reach.
    """
    values = values_of(geometry)
    turned = geometry.angles_rad(places_mm, geometry.read_height_mm) - values[:3]
    slopes = np.empty((len(turned), 3, len(values)))
    for k, step in enumerate(RULER_SDS * 1e-4):
        up, down = values.copy(), values.copy()
        up[k] += step
        down[k] -= step
        slopes[:, :, k] = (places_of(geometry, up, turned) - places_of(geometry, down, turned)) / (2 * step)
    return slopes
