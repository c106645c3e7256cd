"""Inference problems: a prior, a model, a likelihood, a recording; and bounds of a recording's noise sd."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise._kinds import require_like
from probewise.effects.noise import lattice_step
from probewise.errors import ParameterError, ShapeError
from probewise.inference.likelihoods import StudentT
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
        blocks = [theta[at : at + at_once] for at in range(0, max(len(theta), 1), at_once)]
        return np.concatenate([self._log_likelihood_of_block(block) for block in blocks])

    def _log_likelihood_of_block(self, theta: FloatArray) -> FloatArray:
        usable = self.recording.usable
        predicted = self.model.predict(theta, self.recording.plan)
        if usable.all():
            return checked_log_prob(self.likelihood, self.recording.readings, predicted)
        return checked_log_prob(self.likelihood, self.recording.readings[usable], predicted[:, usable])


def reading_span(recording: Recording) -> float:
    """Return the range of the usable readings, max - min; if that is 0, the declared range, or else 1."""
    readings = recording.readings[recording.usable]
    span = float(np.ptp(readings)) if readings.size else 0.0
    if span > 0:
        return span
    inst = recording.plan.instrumentation
    if inst.min is not None and inst.max is not None and inst.max > inst.min:
        return inst.max - inst.min
    return 1.0


def sd_of_numbers(recording: Recording) -> float:
    """Return the least noise sd of which floating-point readings can tell: 1e-15 of the largest."""
    return 1e-15 * float(np.max(np.abs(recording.readings[recording.usable]), initial=0.0))


def sd_floor(recording: Recording) -> float:
    """Return the lower bound of the noise sd: that of rounding, step / sqrt(12), or a share of the range if larger.

    The step is the declared one, else that of the lattice on which all readings lie, if any: residuals of readings at
    levels of that lattice would otherwise be 0, and a heavy-tailed noise model would take 0 for the noise sd. The share
    is `recording.least_share_of_span`, 0.001 for a light sensor.
    """
    step = recording.plan.instrumentation.step or lattice_step(recording.readings[recording.usable])
    share = recording.least_share_of_span * reading_span(recording)
    return max(step / math.sqrt(12.0), share, sd_of_numbers(recording))


def sd_ceiling(recording: Recording) -> float:
    """Return the upper bound of the noise sd: the range of the readings, but at least ten times the floor."""
    return max(reading_span(recording), 10.0 * sd_floor(recording))


def student_t_of(recording: Recording, groups: IntArray | None = None) -> StudentT:
    """Build the Student-t likelihood of a recording's usable readings, with its `sd_floor` and `sd_ceiling`.

    `groups`: data set of each row of the plan, (n_points,), each with its own noise sd; by default its scan.
    """
    rows = recording.plan.scan if groups is None else np.asarray(groups)
    return StudentT(rows[recording.usable], sd_floor(recording), sd_ceiling(recording))
