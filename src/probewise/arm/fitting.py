"""Calibration of an arm's geometry (home angles, links, base) from marks to which its sensor was brought.

Each mark gives the angles of the joints from home, the sensor's place and, if the sensor touched the surface, its
height. The prior is the current geometry with the sds of a ruler and the eye, `RULER_SDS`; the fit is by least squares.
Then comes a check of the sensor's height by its light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.special import chdtrc

from probewise._arrays import FloatArray, floats
from probewise._writing import write_text_atomically
from probewise.arm.geometry import (
    FITTED,
    JOINTS,
    RULER_SDS,
    Accuracy,
    Geometry,
    fitted_parameter_values,
    place_jacobian,
    places_at_parameters,
)
from probewise.errors import ParameterError, ProbewiseError, ReachError, require
from probewise.recordings.table import csv_text, number_text, read_table

LEAST_MARKS = 5
"""Least number of marks, with place and height, that determine the nine parameters of the geometry."""

_COLUMNS, _ROWS = ((0.1, 0.53, 0.9), (0.7, 0.3)), (0.12, 0.45, 0.75)
_STEP_MM = 10.0
_TURNED = tuple(f"{joint}_turned_deg" for joint in JOINTS)
_PLACE = ("x_mm", "y_mm", "height_mm")
_LARGEST = 1e4

LEAST_P = 1e-3  # p-value below which the marks disagree, or the light contradicts the counters
MOST_PLACE_SD_MM, MOST_HEIGHT_SD_MM = 4.0, 5.0  # largest sds of a geometry that counts as determined by the marks


def read_turns_and_places(path: Path) -> tuple[FloatArray, FloatArray]:
    """Read marks: joint angles from home in radians, and x, y, height in mm, both (n_marks, 3).

    FileError for a missing column or a cell that is no number; only `height_mm` may be empty, which gives NaN.
    """
    table = read_table(path, wanted=(*_TURNED, *_PLACE))
    table.require_columns(*_TURNED, *_PLACE)
    turned = [table.column_of_numbers(name, largest=_LARGEST) for name in _TURNED]
    place = [table.column_of_numbers(name, missing=name == "height_mm", largest=_LARGEST) for name in _PLACE]
    return np.radians(np.stack(turned, axis=-1)), np.stack(place, axis=-1)


def write_marks(marks: Sequence[Sequence[float]], path: Path) -> None:
    """Write marks for `read_turns_and_places`, a row each: angles from home (rad), x, y, height (mm); atomically."""
    cells = np.array(marks).reshape(-1, 6)
    cells = np.concatenate([np.degrees(cells[:, :3]), cells[:, 3:]], axis=1).round(4)
    columns = dict(zip((*_TURNED, *_PLACE), cells.T.tolist(), strict=True))
    write_text_atomically(path, csv_text({name: [number_text(v) for v in values] for name, values in columns.items()}))


def spread_mark_places(geometry: Geometry) -> FloatArray:
    """Choose five to eight places spread over the arm's reach on the field, in whole steps of 10 mm, in order of use.

    Returns shape (n_marks, 2), in mm. Raises ReachError if fewer than five are within reach.
    """
    width, height = geometry.field_mm
    # Nearly as on a chessboard, so that no two rows have the same base angles; none on a border of A4 pages.
    grid = [(x * width, y * height) for row, y in enumerate(_ROWS) for x in _COLUMNS[row % 2]]
    marks = np.round(np.array(grid) / _STEP_MM) * _STEP_MM
    marks = marks[geometry.contains(marks)]
    if len(marks) < LEAST_MARKS:
        raise ReachError("marks", f"{len(marks)} within reach", f"{LEAST_MARKS} or more on {geometry.sentence()}")
    return marks


class MarksDisagreeError(ProbewiseError, ValueError):
    """Raised if the best fit of a geometry to marks has a p-value below 0.001."""


@dataclass(frozen=True, eq=False)
class FittedGeometry:
    """A fitted geometry, with its accuracy, and its residuals and errors; parameters in the order of `FITTED`."""

    geometry: Geometry
    before: FloatArray  # parameters before the fit, (9,); radians, mm
    values: FloatArray  # parameters after the fit
    sds: FloatArray
    residuals_mm: FloatArray  # mark minus fitted place and height, (n_marks, 3); NaN without a height
    p_value: float  # probability that marks of the accuracy `touch_mm` fit worse

    def summary(self) -> str:
        """Return a text table of each parameter's change and sd."""
        lines = []
        for k, name in enumerate(FITTED):
            scale, unit, digits = (180 / np.pi, "degrees", 2) if k < 3 else (1.0, "mm", 1)
            was, is_, sd = (scale * float(array[k]) for array in (self.before, self.values, self.sds))
            lines.append(
                f"{name:<17} {is_:8.{digits}f} ± {sd:.{digits}f} {unit} (was {was:.{digits}f}, {is_ - was:+.{digits}f})"
            )
        rms = np.sqrt(np.nanmean(self.residuals_mm**2))
        known = self.geometry.accuracy
        lines.append(
            f"residuals         {rms:.2f} mm rms at {len(self.residuals_mm)} marks (p-value {self.p_value:.2g})"
        )
        if known is not None:
            lines.append(
                f"the sensor is placed to {known.place_sd_mm:.2f} mm, its height known to {known.height_sd_mm:.2f} mm "
                "where it is known least (sds)"
            )
        return "\n".join(lines)


def fit_geometry(
    geometry: Geometry, turned_rad: FloatArray, marks_mm: FloatArray, *, touch_mm: float = 1.0
) -> FittedGeometry:
    """Fit home angles, links and base to marks; return the fitted geometry with its errors.

    The current geometry is start of the fit and its prior mean. `turned_rad`, (n_marks, 3), are the angles of base,
    shoulder and elbow from home, `marks_mm`, (n_marks, 3), the places of the sensor's face: x, y (lab frame) and height
    (NaN: not measured); `touch_mm` is a mark's sd of place and height, from positioning by eye and from the motors.
    Raises ParameterError if there are fewer than five marks, or they do not determine the geometry; MarksDisagreeError
    if the best fit has a p-value below 0.001.
    """
    turned, marks = floats(turned_rad, "turned_rad"), floats(marks_mm, "marks_mm")
    require(len(marks) >= LEAST_MARKS, "marks", len(marks), f"{LEAST_MARKS} or more")
    values, p_value, jacobian = _least_squares_fit(geometry, turned, marks, touch_mm)
    residuals = marks - places_at_parameters(geometry, values, turned)
    if p_value < LEAST_P:
        raise MarksDisagreeError(_disagreement_message(geometry, turned, marks, touch_mm, residuals))
    covariance: FloatArray = np.asarray(np.linalg.inv(jacobian.T @ jacobian), dtype=np.float64)
    joints: dict[str, Any] = {}  # their limits and stops, counted from home, shift with the home angles
    for name, joint, home in zip(JOINTS, geometry.joints, values[:3].tolist(), strict=True):
        ends = {end: getattr(joint, end) for end in ("low_rad", "high_rad", "stop_rad")}
        shifted = {end: angle + (home - joint.home_rad) for end, angle in ends.items() if angle is not None}
        joints[name] = replace(joint, home_rad=home, **shifted)
    upper, lower, x, y, forward, height = values[3:].tolist()
    fitted = replace(geometry, axis_mm=(x, y), shoulder_mm=(forward, height), links_mm=(upper, lower), **joints)
    accuracy = _accuracy_of_fit(fitted, covariance, len(marks))
    if accuracy.height_sd_mm > MOST_HEIGHT_SD_MM or accuracy.place_sd_mm > MOST_PLACE_SD_MM:
        left_open = f"the height open to {accuracy.height_sd_mm:.1f} mm and the place to {accuracy.place_sd_mm:.1f} mm"
        allowed = (
            f"marks that determine them to {MOST_HEIGHT_SD_MM:g} and {MOST_PLACE_SD_MM:g} mm all over the field: "
            "more of them, touched, near and far from the base and on both sides"
        )
        raise ParameterError("marks", f"{len(marks)} that leave {left_open}", allowed)
    before, sds = fitted_parameter_values(geometry), np.sqrt(np.diagonal(covariance))
    return FittedGeometry(replace(fitted, accuracy=accuracy), before, values, sds, residuals, p_value)


def _least_squares_fit(
    geometry: Geometry, turned: FloatArray, marks: FloatArray, touch_mm: float
) -> tuple[FloatArray, float, FloatArray]:
    """Return the most probable parameters, their p-value, and the Jacobian, (n_residuals, 9), of marks and prior."""
    known, before = np.isfinite(marks), fitted_parameter_values(geometry)

    def scaled_residuals(scaled: FloatArray) -> FloatArray:
        off = (places_at_parameters(geometry, before + RULER_SDS * scaled, turned) - marks)[known] / touch_mm
        return np.concatenate([off, scaled])

    found = least_squares(scaled_residuals, np.zeros(len(before)), method="lm", xtol=1e-12, ftol=1e-12)
    p_value = float(chdtrc(int(known.sum()), 2 * found.cost))
    return before + RULER_SDS * found.x, p_value, np.asarray(found.jac / RULER_SDS)


def _disagreement_message(
    geometry: Geometry, turned: FloatArray, marks: FloatArray, touch_mm: float, residuals: FloatArray
) -> str:
    """Build the error's message, with the mark, if any, without which the other marks agree."""
    rms = np.sqrt(np.nanmean(residuals**2))
    off = f"the marks disagree: {rms:.1f} mm root mean square, where each is good to {touch_mm:g} mm"
    for k in np.argsort(-np.nansum(residuals**2, axis=-1)) if len(marks) > LEAST_MARKS else ():
        others = np.arange(len(marks)) != k
        values, p_value, _ = _least_squares_fit(geometry, turned[others], marks[others], touch_mm)
        if p_value >= LEAST_P:
            away = float(np.sqrt(np.nansum((marks[k] - places_at_parameters(geometry, values, turned[[k]])[0]) ** 2)))
            return f"{off}; all but mark {k + 1} agree, and it is {away:.0f} mm off: bring the sensor there again"
    return (
        f"{off}; allowed: a sheet at true scale, gears that do not slip, gear_ratio as built, no joint that is loose; "
        "or marks that are known less well"
    )


def _accuracy_of_fit(geometry: Geometry, covariance: FloatArray, n_marks: int) -> Accuracy:
    """Return sds of place, height and scale over the field, from the covariance, (9, 9), of the fitted parameters."""
    places = geometry.reachable_grid_mm
    require(len(places), "marks", n_marks, "marks that leave the field within reach; touch them again")
    slopes = place_jacobian(geometry, places)
    variances = np.einsum("nik,kl,nil->ni", slopes, covariance, slopes)
    # Scale error of the whole field: the mean radial displacement from its centre.
    arms = places - places.mean(axis=0)
    stretch = np.einsum("nik,ni->k", slopes[:, :2], arms) / float((arms**2).sum())
    return Accuracy(
        n_marks,
        float(np.sqrt(variances[:, :2].mean())),
        float(np.sqrt(variances[:, 2].max())),
        float(np.sqrt(stretch @ covariance @ stretch)),
        tuple(tuple(row) for row in covariance.tolist()),
    )


# A check of the height by the light: over white, a lower sensor reads more. How a reading falls with the height is
# measured at one place; a reading over the same white elsewhere then gives the height there.

_DEGREE = 2
_TELLS = 5.0  # sds by which readings at the lowest and at the highest height must differ
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
