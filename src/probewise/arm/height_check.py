"""A check of the sensor's height by its light: over white, a lower sensor reads more.

The decrease of the reading with height is measured at one place. A reading elsewhere over the same white then gives the
sensor's height there, to be compared with the height by the motors' counters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from probewise._arrays import FloatArray
from probewise.errors import ParameterError

_DEGREE = 2
_TELLS = 5.0  # sds by which readings at the lowest and at the highest height must differ
LEAST_P = 1e-3  # p-value below which the light contradicts the counters
ROUNDING_MM = 0.2  # sd of a height that whole counts leave


@dataclass(frozen=True, eq=False)
class HeightCheck:
    """Heights measured by the light, compared with those by the motors' counters."""

    per_mm: float  # relative decrease of a reading per mm, at the lowest of the heights at the first place
    off_mm: FloatArray  # by the light, relative to the first place, minus by the counters, elsewhere, (n_places,)
    sd_mm: FloatArray
    p_value: float  # chi-square: the probability of larger `off_mm` if the counters are right


def check_heights(curve: FloatArray, others: FloatArray) -> HeightCheck:
    """Compare heights measured by the light with those by the motors' counters.

    `curve`, (n, 3): height by the counters, mean reading over white and its standard error, at three heights or more of
    the first place; `others`, (n_places, 3), the same elsewhere over the same white. Raises ParameterError for readings
    at the first place that do not fall with the height by five sds or more.
    """
    height, value, error = curve.T
    low, high = int(height.argmin()), int(height.argmax())
    noise = float(np.hypot(error[low], error[high]))
    uninformative = ParameterError(
        "readings over white",
        f"{value[low]:.3g} at {height[low]:.0f} mm and {value[high]:.3g} at {height[high]:.0f} mm",
        f"readings that fall with the height by {_TELLS:g} sds ({_TELLS * noise:.2g}) or more: is the LED lit, the "
        "sheet white, the room dark?",
    )
    if value[low] - value[high] < _TELLS * noise or min(value.min(), others[:, 1].min()) <= 0:
        raise uninformative
    # The logarithm by that of the height: light that falls with its square is a straight line, other light bends it
    # (the room's, and the LED's near the surface, which the sensor shades).
    lowest_mm, y = float(height.min()), np.log(value)

    def fit_curve(error: FloatArray) -> tuple[FloatArray, FloatArray]:
        design = np.vander(np.log(height / lowest_mm), _DEGREE + 1)
        covariance = np.asarray(np.linalg.inv(design.T @ (design / error[:, None] ** 2)), dtype=np.float64)
        return covariance @ design.T @ (y / error**2), covariance

    def log_slope_per_mm(coefficients: FloatArray, height_mm: FloatArray) -> FloatArray:
        within = np.clip(height_mm, lowest_mm, height[high])  # beyond the curve it goes on as it ends
        return np.asarray(np.polyval(np.polyder(coefficients), np.log(within / lowest_mm)) / height_mm)

    # Whole counts leave the heights of the curve open too.
    own = error / value
    coefficients, covariance = fit_curve(np.hypot(own, ROUNDING_MM * log_slope_per_mm(fit_curve(own)[0], height)))
    if (log_slope_per_mm(coefficients, height) >= 0).any():
        raise uninformative
    told, read, read_error = others.T
    steep = log_slope_per_mm(coefficients, told)
    basis = np.vander(np.log(told / lowest_mm), _DEGREE + 1)
    off = (np.log(read) - basis @ coefficients) / steep
    shared = basis / steep[:, None]
    own = read_error / read / steep
    joint = shared @ covariance @ shared.T + np.diag(own**2 + ROUNDING_MM**2)
    p_value = float(chdtrc(len(off), off @ np.linalg.solve(joint, off)))
    return HeightCheck(
        float(-log_slope_per_mm(coefficients, height[[low]])[0]), off, np.sqrt(np.diagonal(joint)), p_value
    )
