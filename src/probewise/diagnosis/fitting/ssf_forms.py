"""Forms of an SSF calibrated from the recording itself: one Gaussian, free form, more Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

from probewise._arrays import FloatArray
from probewise.diagnosis.fitting.coordinates import SensorCoordinates, default_sensor
from probewise.diagnosis.fitting.fit import Fit, start_with_more_gaussians, starts_of_one_gaussian
from probewise.diagnosis.fitting.free_form import FreeForm
from probewise.diagnosis.fitting.null import Null
from probewise.effects import Extent

Start = tuple[Null, FloatArray]
"""A null and coordinates to fit it from, (n_starts, n_params)."""


@dataclass(frozen=True, eq=False)
class SsfForms:
    """Sensors with priors scaled to a recording, each with starting coordinates."""

    extent: Extent

    def simplest(self) -> Start:
        """One Gaussian: typical, narrow and wide."""
        one = default_sensor(self.extent, 1)
        return one, starts_of_one_gaussian(one)

    def free(self, found: Fit) -> Start:
        """Return the free form, starting from the fit of one Gaussian."""
        one = found.model.sensor
        assert isinstance(one, SensorCoordinates)
        free = FreeForm.from_one_gaussian(one)
        return free, free.start_from(found.z)

    def one_more(self, found: Fit, order: int) -> Start:
        """Return `order` Gaussians, starting from splits of the heaviest of the fit."""
        wanted = default_sensor(self.extent, order)
        return wanted, start_with_more_gaussians(found.model.sensor, found.z, wanted)
