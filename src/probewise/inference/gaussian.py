"""Gaussian likelihoods, with the sd of the noise known or as a parameter."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from probewise._arrays import FloatArray, floats, frozen
from probewise.errors import ParameterError, ShapeError
from probewise.inference._residuals import residuals
from probewise.priors import Joint, Marginal, Prior, Product
from probewise.recordings.plan import Recording
from probewise.sensor.stages import SensorModel

_LOG_2PI = math.log(2 * math.pi)


@dataclass(frozen=True, eq=False)
class GaussianKnown:
    """Likelihood of independent Gaussian noise of known sd.

    Parameters
    ----------
    sd
        In units of the reading: a number, or one for each reading, (n_points,).
    """

    sd: ArrayLike

    def __post_init__(self) -> None:
        sd = frozen(self.sd, "sd")
        if sd.ndim > 1:
            raise ShapeError(f"sd has shape {sd.shape}; allowed: a number or (n_points,)")
        if not ((sd > 0) & np.isfinite(sd)).all():
            raise ParameterError("sd", sd.tolist(), "greater than 0, finite")
        object.__setattr__(self, "sd", sd)

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return the log likelihood, constants included, (n_points,), (n_samples, n_points) -> (n_samples,)."""
        readings, predicted = floats(readings, "readings"), floats(predicted, "predicted")
        sd = np.asarray(self.sd)
        if sd.ndim == 1 and sd.size != readings.size:
            raise ShapeError(
                f"sd has {sd.size} values for {readings.size} readings; allowed: one per reading, or one number"
            )
        z = residuals(readings, predicted) / sd
        constant = 0.5 * readings.size * _LOG_2PI + float(np.broadcast_to(np.log(sd), readings.shape).sum())
        return np.asarray(-0.5 * np.einsum("ij,ij->i", z, z) - constant)


@dataclass(frozen=True, eq=False)
class GaussianInferred:
    """An inference problem with Gaussian noise, whose sd is the last parameter; otherwise as `SensorProblem`.

    Parameters
    ----------
    sensor_prior, model, recording
        As in `SensorProblem`.
    sd_prior
        Prior of the sd, in units of the reading, for instance `LogUniform(floor, ceiling)`.
    sd_name
        Name of the sd among the parameters.
    """

    sensor_prior: Prior
    model: SensorModel
    recording: Recording
    sd_prior: Marginal
    sd_name: str = "noise.sd"

    def __post_init__(self) -> None:
        if self.sensor_prior.names != self.model.names:
            raise ParameterError("sensor_prior.names", self.sensor_prior.names, f"the model's names {self.model.names}")

    @cached_property
    def prior(self) -> Prior:
        """Joint prior of the sensor's parameters, then the sd."""
        return Joint((self.sensor_prior, Product({self.sd_name: self.sd_prior})))

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Return the log likelihood of the usable readings, (n_samples, n_params), sd last -> (n_samples,)."""
        usable = self.recording.usable
        predicted = self.model.predict(theta[:, :-1], self.recording.plan)[:, usable]
        readings = self.recording.readings[usable]
        return log_prob_gaussian(readings, predicted, theta[:, -1])


def log_prob_gaussian(readings: FloatArray, predicted: FloatArray, sd: FloatArray) -> FloatArray:
    """Return the Gaussian log likelihood of readings, with one noise sd per hypothesis.

    (n_points,), (n_samples, n_points), (n_samples,) -> (n_samples,)
    """
    residual = residuals(readings, predicted)
    square = np.einsum("ij,ij->i", residual, residual)
    return np.asarray(-0.5 * square / sd**2 - readings.size * (np.log(sd) + 0.5 * _LOG_2PI))
