"""An arm whose geometry was fitted to marks: how well it knows where its sensor stands, and what that does to light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from probewise._kinds import require_kind
from probewise.arm.geometry import Geometry
from probewise.calibration.sensor_file import FittedSensor
from probewise.errors import ParameterError


@dataclass(frozen=True, eq=False)
class FittedArm:
    """What is known of the arm of a run, so that its own error counts in what the run claims.

    Parameters
    ----------
    geometry
        The arm's, fitted to marks.
    levels
        What the sensor reads over black and over white: light above black falls with the height, as the geometry says
        or, where it does not, with the square.
    calibrated_mm
        Where on the field this arm took the readings that the sensor was calibrated by: an error of the height there is
        in the sensor's levels already. By default in the field's middle, as `arm record` does.
    """

    geometry: Geometry
    levels: tuple[float, float]
    calibrated_mm: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        require_kind("geometry", self.geometry, Geometry, "a Geometry, such as read_geometry(path) returns")
        if self.geometry.accuracy is None:
            raise ParameterError("geometry", "one without [accuracy]", "one that was fitted to marks")

    @classmethod
    def of(cls, geometry: Geometry, sensor: FittedSensor) -> Self:
        """Take the levels from a sensor's posterior mean."""
        means = sensor.mean()
        return cls(geometry, (means["I_min"], means["I_max"]))
