"""Forms of an SSF calibrated from the recording itself: one Gaussian, free form, more Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

from probewise._arrays import FloatArray
from probewise.diagnosis.fitting.coordinates import GaussianMixtureSensor, default_sensor
from probewise.diagnosis.fitting.fit import Fit, starts_of_one_gaussian, starts_with_more_gaussians
from probewise.diagnosis.fitting.free_form import FreeFormSensor
from probewise.diagnosis.fitting.null import Null
from probewise.effects import Extent

Start = tuple[Null, FloatArray]
"""A null and coordinates to fit it from, (n_starts, n_params)."""


@dataclass(frozen=True, eq=False)
class SsfForms:
    """Forms of a sensor's SSF with priors scaled to a recording, each as a null with coordinates to fit it from."""

    extent: Extent

    def one_gaussian_and_starts(self) -> Start:
        """Return a sensor of one Gaussian, and three starts: typical, narrow and wide."""
        one = default_sensor(self.extent, 1)
        return one, starts_of_one_gaussian(one)

    def free_form_and_starts(self, found: Fit) -> Start:
        """Return a sensor of free form, and one start: the fit of one Gaussian."""
        one = found.model.sensor
        assert isinstance(one, GaussianMixtureSensor)
        free = FreeFormSensor.from_one_gaussian(one)
        return free, free.start_from_one_gaussian(found.z)

    def more_gaussians_and_starts(self, found: Fit, order: int) -> Start:
        """Return a sensor of `order` Gaussians, one more than the fit has, and starts: splits of the fit's heaviest."""
        wanted = default_sensor(self.extent, order)
        return wanted, starts_with_more_gaussians(found.model.sensor, found.z, wanted)
