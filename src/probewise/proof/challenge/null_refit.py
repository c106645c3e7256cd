"""Refit of the null model (a sensor without effects) to noise-free readings: residual norm / noise sd is lambda."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence import laplace_evidence
from probewise.diagnosis.fit import Fit, Model, fit
from probewise.diagnosis.noise_law import white_noise
from probewise.diagnosis.noise_models import NoiseModel
from probewise.diagnosis.sensors import default_sensor, starts_of_one_gaussian, starts_with_more_gaussians
from probewise.effects import Extent
from probewise.recordings.plan import Recording

_NOISE_SD = 0.6  # the middle noise level of a challenge; weights the readings against the priors
_MOST_GAUSSIANS = 4
_BEHIND = 3.0  # nats: once an SSF order is this far behind the best, higher orders are not tried


class NullRefit:
    """The null model, fitted to clean readings once and refitted to readings with effects.

    The number of Gaussians in the SSF has the largest evidence on the clean readings, as in a diagnosis. The residuals
    of that fit (the true SSF may be no mixture of Gaussians) are subtracted before a refit.
    """

    def __init__(self) -> None:
        self._clean: Recording | None = None

    def __call__(self, clean: Recording, changed: Recording) -> float:
        """Return the norm of an effect's residuals after a full refit of the null, in reading units."""
        return float(np.linalg.norm(self.refit(clean, changed).residuals))

    def refit(self, clean: Recording, changed: Recording) -> Fit:
        """Return the null model's fit to `changed`, as if the model fitted `clean` exactly."""
        null = self.null_fit(clean)
        return _white_noise_fit(null.model, self.without_null_residuals(clean, changed), null.z)

    def with_one_more_gaussian(self, found: Fit, clean: Recording, changed: Recording) -> Fit:
        """Return as `refit`, but with one Gaussian more in the SSF than `found`, the result of `refit`."""
        fits = _fits_with_one_more_gaussian(found, self.without_null_residuals(clean, changed), Extent.of(clean))
        return min(fits, key=lambda f: float(np.linalg.norm(f.residuals)))

    def without_null_residuals(self, clean: Recording, changed: Recording) -> Recording:
        """Return `changed` minus the null model's residuals on `clean`."""
        readings = changed.readings.copy()
        readings[clean.usable] -= self.null_fit(clean).residuals
        return Recording(changed.plan, readings)

    def null_fit(self, clean: Recording) -> Fit:
        """Return the null model's fit to the clean readings, cached for the last recording."""
        if self._clean is not clean:
            self._clean, self._null = clean, _fit_of_best_order(clean)
        return self._null


def _fit_of_best_order(clean: Recording) -> Fit:
    extent, noise = Extent.of(clean), NoiseModel((), clean, least_sd=_NOISE_SD)
    sensor = default_sensor(extent, 1)
    found = min(
        (_white_noise_fit(Model(sensor, (), clean.plan), clean, z) for z in starts_of_one_gaussian(sensor)),
        key=lambda f: f.objective,
    )
    best, best_log_z = found, laplace_evidence(found, noise).log_z
    for _ in range(_MOST_GAUSSIANS - 1):
        found = min(_fits_with_one_more_gaussian(found, clean, extent), key=lambda f: f.objective)
        log_z = laplace_evidence(found, noise).log_z
        if log_z > best_log_z:
            best, best_log_z = found, log_z
        elif log_z < best_log_z - _BEHIND:
            break
    return best


def _fits_with_one_more_gaussian(found: Fit, recording: Recording, extent: Extent) -> Iterator[Fit]:
    """Yield fits with one more Gaussian than `found`, one from each way to split the heaviest."""
    wanted = default_sensor(extent, found.model.sensor.n_gaussians + 1)
    for z in starts_with_more_gaussians(found.model.sensor, found.z, wanted):
        yield _white_noise_fit(Model(wanted, (), recording.plan), recording, z)


def _white_noise_fit(model: Model, recording: Recording, start: FloatArray) -> Fit:
    whitener = white_noise(int(recording.usable.sum()), least=_NOISE_SD)
    return fit(model, recording, start, whitener, tolerance=0.02)
