"""An arm whose geometry was fitted to marks: its accuracy, and what an error of its height does to the light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from probewise._kinds import require_kind
from probewise.arm.geometry import Geometry, place_jacobian
from probewise.calibration.sensor_file import FittedSensor
from probewise.errors import ParameterError


@dataclass(frozen=True, eq=False)
class FittedArm:
    """Geometry of a run's arm and levels of its sensor, so that the stated sds include the arm's own error.

    Parameters
    ----------
    geometry
        The arm's geometry, fitted to marks; ParameterError for one without accuracy.
    levels
        Readings over black and over white. Light above black falls with the height by `geometry.light_per_mm`, or with
        the height's square if that is None.
    calibrated_mm
        Place on the field where this arm took the readings of the calibration: the sensor's levels include the error of
        the height there. A sensor's file does not say it; None assumes the middle of the field, where the command `arm
        record` lays a plan unless it is told otherwise. ParameterError for a place out of the arm's reach.
    """

    geometry: Geometry
    levels: tuple[float, float]
    calibrated_mm: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        require_kind("geometry", self.geometry, Geometry, "a Geometry, such as read_geometry(path) returns")
        if self.geometry.accuracy is None:
            raise ParameterError("geometry", "one without [accuracy]", "one that was fitted to marks")
        if not _reads_at(self.geometry, self.calibration_place_mm):
            allowed = "a place within the arm's reach, at which it took the readings of the calibration"
            raise ParameterError("calibrated_mm", self.calibration_place_mm, allowed)

    @property
    def calibration_place_mm(self) -> tuple[float, float]:
        """Place of the calibration, or the middle of the field, which is assumed."""
        return _middle_of_field(self.geometry) if self.calibrated_mm is None else self.calibrated_mm

    @classmethod
    def from_geometry_and_sensor(cls, geometry: Geometry, sensor: FittedSensor) -> Self:
        """Build from a fitted geometry, with the sensor's posterior mean levels.

        The calibration is assumed in the middle of the field, or, of an arm that does not reach that, at the nearest
        place that it does.
        """
        require_kind("geometry", geometry, Geometry, "a Geometry, such as read_geometry(path) returns")
        means, middle = sensor.mean(), _middle_of_field(geometry)
        places = geometry.reachable_grid_mm
        calibrated_mm = None
        if not _reads_at(geometry, middle) and len(places):
            x_mm, y_mm = places[np.hypot(*(places - middle).T).argmin()].tolist()
            calibrated_mm = (x_mm, y_mm)
        return cls(geometry, (means["I_min"], means["I_max"]), calibrated_mm)


def _middle_of_field(geometry: Geometry) -> tuple[float, float]:
    width_mm, height_mm = geometry.field_mm
    return width_mm / 2, height_mm / 2


def _reads_at(geometry: Geometry, place_mm: tuple[float, float]) -> bool:
    """Return whether the effect of the arm's error at a place is defined: whether the links reach that far and near."""
    return bool(np.isfinite(place_jacobian(geometry, np.array([place_mm]))).all())
