"""An arm whose geometry was fitted to marks: its accuracy, and what an error of its height does to the light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from probewise._kinds import require_kind
from probewise.arm.geometry import Geometry
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
        the height there. None: the middle of the field, as in the command `arm record`.
    """

    geometry: Geometry
    levels: tuple[float, float]
    calibrated_mm: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        require_kind("geometry", self.geometry, Geometry, "a Geometry, such as read_geometry(path) returns")
        if self.geometry.accuracy is None:
            raise ParameterError("geometry", "one without [accuracy]", "one that was fitted to marks")

    @classmethod
    def from_geometry_and_sensor(cls, geometry: Geometry, sensor: FittedSensor) -> Self:
        """Build from a fitted geometry, with the sensor's posterior mean levels."""
        means = sensor.mean()
        return cls(geometry, (means["I_min"], means["I_max"]))

    of = from_geometry_and_sensor
    """The old name of `from_geometry_and_sensor`."""
