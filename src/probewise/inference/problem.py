"""Inference problems: a prior, a model that predicts readings, a likelihood, and the readings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray
from probewise._kinds import require_like
from probewise.errors import ParameterError, ShapeError
from probewise.priors import Prior, require_prior
from probewise.recordings.plan import Recording, require_recording
from probewise.sensor.stages import SensorModel

_MOST_NUMBERS = 1_000_000  # predicted at a time, to bound memory


class Likelihood(Protocol):
    """The interface of a likelihood of readings given predictions."""

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return the log likelihood of readings, (n_points,), given predictions, (n_samples, n_points): (n_samples,).

        All constants are included.
        """
        ...


class Problem(Protocol):
    """The interface of an inference problem: a prior, and the log likelihood of parameters."""

    @property
    def prior(self) -> Prior:
        """The prior; its names are those of the parameters."""
        ...

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Return the log likelihood of each hypothesis, (n_samples, n_params) -> (n_samples,)."""
        ...


def require_model(model: object) -> None:
    """Raise ParameterError unless `model` has `names` and `predict`, as a sensor model has."""
    allowed = "a sensor model such as Chain(ssf, levels, scene), with names and predict(theta, plan)"
    require_like("model", model, ("names", "predict"), allowed)


def checked_log_prob(likelihood: Likelihood, readings: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return the log likelihood of readings, (n_points,), given predictions, (n_samples, n_points): (n_samples,).

    ShapeError if `likelihood`, which may be a user's own, does not return one number per hypothesis.
    """
    scored = likelihood.log_prob(readings, predicted)
    if np.shape(scored) != (len(predicted),):
        raise ShapeError(
            f"log_prob of {type(likelihood).__name__} returned shape {np.shape(scored)}; allowed: ({len(predicted)},), "
            f"one number per hypothesis: predicted is a batch of shape {predicted.shape}, one hypothesis per row"
        )
    return np.asarray(scored, dtype=np.float64)


def require_likelihood(likelihood: object) -> None:
    """Raise ParameterError unless `likelihood` has `log_prob`; a number (a noise sd) is the usual mistake."""
    allowed = "a likelihood such as GaussianKnown(sd), with log_prob(readings, predicted)"
    require_like("likelihood", likelihood, ("log_prob",), allowed)


@dataclass(frozen=True, eq=False)
class SensorProblem:
    """The problem of inferring sensor, scene or both (the model's parameters) from a recording's usable readings.

    ParameterError if the names of `prior` and `model` differ, or an argument is of the wrong kind.
    """

    prior: Prior
    model: SensorModel
    likelihood: Likelihood
    recording: Recording

    def __post_init__(self) -> None:
        require_prior("prior", self.prior)
        require_model(self.model)
        require_likelihood(self.likelihood)
        require_recording(self.recording)
        if self.prior.names != self.model.names:
            raise ParameterError("prior.names", self.prior.names, f"the model's names {self.model.names}")

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Return the log likelihood of the usable readings, (n_samples, n_params) -> (n_samples,).

        The whole plan is predicted, since lag and backlash need every row.
        Hypotheses are processed in blocks to bound the memory.
        """
        at_once = max(_MOST_NUMBERS // max(len(self.recording), 1), 1)
        if len(theta) > at_once:
            return np.concatenate(
                [self._log_likelihood_of_block(theta[at : at + at_once]) for at in range(0, len(theta), at_once)]
            )
        return self._log_likelihood_of_block(theta)

    def _log_likelihood_of_block(self, theta: FloatArray) -> FloatArray:
        usable = self.recording.usable
        predicted = self.model.predict(theta, self.recording.plan)
        if usable.all():
            return checked_log_prob(self.likelihood, self.recording.readings, predicted)
        return checked_log_prob(self.likelihood, self.recording.readings[usable], predicted[:, usable])
