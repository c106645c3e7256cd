"""The paper's sum over a discrete SSF matrix (paper, eq. 9), for any field and any region.

The second of two independent routes to the response; the other, the closed forms of `probewise.sensor.gaussian`, shares
only the regions' albedo at points. The albedo of a pixel is its covered share, from 89 places in it.
"""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ShapeError
from probewise.scene.regions import Region
from probewise.sensor.ssf import SSFField
from probewise.sensor.stages import Poses

_PLACES_AT_ONCE = 2**18
# A Fibonacci lattice in the unit square, whose places are even along either side: a straight edge cuts off a share that
# is right to a hundredth.
_N_PLACES = 89
_PLACES = (np.stack([np.arange(89), 55 * np.arange(89) % 89], axis=1) + 0.5) / _N_PLACES - 0.5


def mean_albedo_by_pixels(region: Region, field: SSFField, poses: Poses) -> FloatArray:
    """Compute the response of a discrete SSF: the sum of its pixels' values times the mean albedo of each pixel.

    Returns response R, shape (n_samples, n_points); n_samples is 1 where it is the same for all hypotheses. Raises
    ShapeError if poses and region hold different numbers of hypotheses, neither of them 1.

    `region`: albedo field of each hypothesis (n_regions of them, n_samples or 1); `field`: the discrete SSF in the
    sensor frame; its pixels turn with the sensor; `poses`: where the sensor stands; arrays broadcast to (n_samples,
    n_points).
    """
    x, y, turn = np.broadcast_arrays(*poses.arrays)
    n_poses, n_points = x.shape
    if n_poses not in (1, region.n_regions) and region.n_regions != 1:
        raise ShapeError(f"poses of {n_poses} hypotheses, {region.n_regions} regions; allowed: equal numbers, or 1")
    if n_poses > 1:
        # Each hypothesis has its own poses: evaluate one hypothesis at a time.
        out = np.empty((n_poses, n_points))
        for i in range(n_poses):
            one = Poses(x[i : i + 1], y[i : i + 1], turn[i : i + 1])
            found = mean_albedo_by_pixels(region, field, one)
            out[i] = found[i if len(found) > 1 else 0]
        return out
    values = field.values.ravel()
    kept = np.abs(values) > 1e-12 * np.abs(values).max()
    places = (field.centers_mm[kept][:, None] + field.pixel_mm * _PLACES).reshape(-1, 2)  # in the sensor frame
    weights = np.repeat(values[kept] / _N_PLACES, _N_PLACES)
    out = np.empty((region.n_regions, n_points))
    block = max(1, _PLACES_AT_ONCE // (len(weights) * region.n_regions))
    for start in range(0, n_points, block):
        rows = slice(start, start + block)
        cosine, sine = np.cos(turn[0, rows])[:, None], np.sin(turn[0, rows])[:, None]
        lab_x = x[0, rows, None] + cosine * places[:, 0] - sine * places[:, 1]
        lab_y = y[0, rows, None] + sine * places[:, 0] + cosine * places[:, 1]
        albedo = region.albedo(np.stack([lab_x.ravel(), lab_y.ravel()], axis=-1))
        out[:, rows] = albedo.reshape(len(albedo), -1, len(weights)) @ weights
    return out
