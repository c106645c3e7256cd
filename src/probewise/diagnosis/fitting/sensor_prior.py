"""An earlier posterior of the sensor, used as the prior."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray
from probewise._kinds import require_like
from probewise.calibration import FittedSensor
from probewise.diagnosis.fitting.coordinates import CalibratedSensor, GaussianMixtureSensor, theta_to_natural
from probewise.diagnosis.fitting.free_form import FreeFormSensor, theta_to_free_form_natural
from probewise.errors import ParameterError
from probewise.recordings.plan import Plan
from probewise.sensor import is_free_form

_RIDGE = 1e-8  # of each variance, by which a covariance of samples is sure to be positive
_LEAST_VARIANCE = 1e-16  # of a coordinate, relative to its size


def sensor_from_posterior(
    names: Sequence[str], mean: FloatArray, cov: FloatArray, *, height_mm: float | None = None
) -> CalibratedSensor:
    """Build a prior from an earlier sensor's posterior mean and covariance, calibrated at `height_mm`.

    Only the SSF's and the levels' columns are used; effects of the earlier model are dropped.

    Raises
    ------
    ParameterError
        If the names are not those of a mixture of Gaussians with two free levels.
    """
    names = list(names)
    n_gaussians = sum(name.startswith("a_") for name in names)
    wanted = [f"{p}_{n}" for n in range(1, n_gaussians + 1) for p in ("a", "u", "v", "A", "B", "C")]
    wanted += ["I_min", "I_max"]
    if n_gaussians == 0 or any(name not in names for name in wanted):
        raise ParameterError("sensor.names", tuple(names), "a_1, u_1, v_1, A_1, B_1, C_1, ..., I_min, I_max")
    at = [names.index(name) for name in wanted]
    mean = np.asarray(mean, dtype=np.float64)[at]
    cov = np.asarray(cov, dtype=np.float64)[np.ix_(at, at)]
    free = is_free_form(mean[None, :-2])
    natural_from_theta = theta_to_free_form_natural if free else partial(theta_to_natural, n_gaussians=n_gaussians)
    center = natural_from_theta(mean[None, :])[0]
    steps = np.maximum(1e-3 * np.sqrt(np.maximum(np.diag(cov), 0.0)), 1e-7 * np.abs(mean) + 1e-12)
    up = natural_from_theta(mean + np.diag(steps))
    down = natural_from_theta(mean - np.diag(steps))
    slope = ((up - down) / (2 * steps[:, None])).T
    natural_cov = slope @ cov @ slope.T
    # Coordinates that are the same in all samples have a variance too, in the readings' unit where they are levels.
    size, levels = np.ones(len(center)), slice(5, 7) if free else slice(-2, None)
    size[levels] = np.abs(center[levels]).max() or 1.0
    floor = _RIDGE * np.maximum(np.diag(natural_cov), _LEAST_VARIANCE * size**2)
    factor = np.linalg.cholesky(natural_cov + np.diag(floor))
    return (
        FreeFormSensor(center, factor, calibrated_height_mm=height_mm)
        if free
        else GaussianMixtureSensor(
            n_gaussians, center, factor, has_exchangeable_gaussians=False, calibrated_height_mm=height_mm
        )
    )


class SensorPrior(Protocol):
    """An earlier posterior of the sensor: a FittedSensor, or anything with its names and samples."""

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names, one per column."""
        ...

    @property
    def samples(self) -> FloatArray:
        """Posterior samples, (n_samples, n_params)."""
        ...


def require_sensor_prior(sensor: object) -> None:
    """Raise ParameterError unless `sensor` has names and samples."""
    allowed = "a FittedSensor: read_sensor('sensor.json') of probewise.calibration, or the .sensor of a Calibration"
    if hasattr(getattr(sensor, "sensor", None), "samples"):
        allowed = f"a FittedSensor: take its .sensor, this is the {type(sensor).__name__}"
    require_like("sensor", sensor, ("names", "samples"), allowed)


def require_same_unit(sensor: SensorPrior, plan: Plan) -> None:
    """Raise ParameterError if the readings' unit differs from that of the calibration; "" is an unknown unit."""
    unit, own = plan.instrumentation.unit, ""
    if isinstance(sensor, FittedSensor):
        own = sensor.instrumentation.unit
    if own and unit and own != unit:
        raise ParameterError("sensor", f"one that reads in {own!r}", f"one in {unit!r}, as the recording")


def sensor_from_samples(sensor: SensorPrior) -> CalibratedSensor:
    """Build a prior from an earlier sensor's posterior samples; see `sensor_from_posterior`.

    If the samples average several hypotheses, only the most probable is used: a normal prior holds one hypothesis.
    """
    height_mm = None
    if isinstance(sensor, FittedSensor):
        sensor, height_mm = sensor.with_leading_effects(), sensor.instrumentation.height_mm
    samples = np.asarray(sensor.samples, dtype=np.float64)
    return sensor_from_posterior(sensor.names, samples.mean(axis=0), np.cov(samples.T), height_mm=height_mm)
