"""Uncertain parameters of an arm's geometry, and their effect on the sensor's place."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray
from probewise.arm.geometry import Geometry, forward_kinematics_mm

FITTED = (
    *("base home", "shoulder home", "elbow home", "upper link", "lower link"),
    *("base x", "base y", "shoulder forward", "shoulder height"),
)
"""Fitted parameters, angles in radians, lengths in mm; the sensor's own lengths are collinear with the shoulder's."""

RULER_SDS = np.array([*np.radians([5.0, 5.0, 5.0]), 5.0, 5.0, 10.0, 10.0, 10.0, 10.0])
"""Prior sd of each, as measured with a ruler and by eye."""


def fitted_parameter_values(geometry: Geometry) -> FloatArray:
    """Return the values of the parameters `FITTED`, (9,)."""
    homes = [joint.home_rad for joint in geometry.joints]
    return np.array([*homes, *geometry.links_mm, *geometry.axis_mm, *geometry.shoulder_mm])


def places_at_parameters(geometry: Geometry, values: FloatArray, turned_rad: FloatArray) -> FloatArray:
    """Return x, y, height of the sensor, (n, 3), for values of `FITTED`, (9,), and joint angles from home, (n, 3)."""
    return forward_kinematics_mm(
        values[:3] + turned_rad,
        values[3:5],
        values[5:7],
        values[7:9],
        geometry.sensor_mm,
        elbow_is_relative=geometry.elbow_is_relative,
    )


def place_jacobian(geometry: Geometry, places_mm: FloatArray) -> FloatArray:
    """Return the derivatives of the sensor's place and height by each parameter `FITTED`, joint angles from home fixed.

    Parameters
    ----------
    geometry
        The nominal geometry.
    places_mm
        Places of the sensor by the nominal geometry, (n, 2), at the reading height.

    Returns
    -------
    Shape (n, 3, 9): x, y and height by the parameters of `FITTED`; NaN at a place out of reach.
    """
    values = fitted_parameter_values(geometry)
    turned = geometry.angles_rad(places_mm, geometry.read_height_mm) - values[:3]
    slopes = np.empty((len(turned), 3, len(values)))
    for k, step in enumerate(RULER_SDS * 1e-4):
        up, down = values.copy(), values.copy()
        up[k] += step
        down[k] -= step
        above, below = places_at_parameters(geometry, up, turned), places_at_parameters(geometry, down, turned)
        slopes[:, :, k] = (above - below) / (2 * step)
    return slopes
