"""The configuration of a run: hypotheses, sensor, designs, utility, stopping rule."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise._kinds import checked_number, require_callable
from probewise._version import __version__
from probewise.arm.instrument import Reading
from probewise.errors import ParameterError
from probewise.experiment.digest import value_digest
from probewise.experiment.fitted_arm import FittedArm
from probewise.experiment.journal import recording_of
from probewise.experiment.kinds import HypothesisKind, kinds_of
from probewise.experiment.method import Method, SequentialMonteCarlo
from probewise.experiment.pace import Pace
from probewise.experiment.rivals import SensorModelRival, rivals_of
from probewise.inference.problem import Likelihood, SensorProblem, require_likelihood, require_model
from probewise.inference.student_t import StudentT
from probewise.inquiry import (
    Designs,
    Finishing,
    Forecast,
    Goal,
    Grid,
    InformationGain,
    Readout,
    Utility,
    cards_of,
    forecast_of,
)
from probewise.priors import Joint, Prior
from probewise.recordings.plan import Instrumentation, Recording
from probewise.scene import Card
from probewise.scene.albedo import Shape, require_shape
from probewise.scene.any_of import AnyOf
from probewise.sensor.stages import SensorModel

_MOST_BATCH = 100
_MOST_LIFTED = 10.0
"""Largest factor between reading height and calibrated height, either way."""

MOST_OFF = 0.01
"""Probability of a wrong length below which a run with doubt in its sensor may end."""


@dataclass(frozen=True)
class OneScan:
    """Student-t likelihood of any number of readings that share one unknown noise sd (paper, SSF likelihood).

    `sd_floor` and `sd_ceiling` bound the sd, in the sensor's unit; its prior is 1/sigma between them.
    """

    sd_floor: float
    sd_ceiling: float

    def __post_init__(self) -> None:
        if not 0 < self.sd_floor < self.sd_ceiling < math.inf:
            raise ParameterError(
                "sd_floor, sd_ceiling", (self.sd_floor, self.sd_ceiling), "0 < floor < ceiling, finite"
            )

    def log_prob(self, readings: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return the log likelihood, (n_samples,), of readings (n_points,) given predictions (n_samples, n_points)."""
        one = np.zeros(readings.size, dtype=np.int64)
        return StudentT(one, self.sd_floor, self.sd_ceiling).log_prob(readings, predicted)


@dataclass(frozen=True, eq=False)
class Experiment:
    """The configuration of a run, except arm and seed.

    Parameters
    ----------
    shape
        The possible shape on the field, with its prior.
    model
        The sensor over a scene of that shape.
    likelihood
        Likelihood of readings given predictions; any likelihood works with any model.
    noise_sd
        Sd of the noise of one reading in the sensor's unit, for the goodness of fit and for utilities.
    grid
        Possible places of readings.
    utility
        The utility; by default the expected information about all parameters and, near the end, the probability that
        the reading ends the run.
    sensor_prior
        Prior of the sensor's parameters, if these are inferred too, as the first columns of theta; None: the sensor is
        known.
    step, reading_range
        Rounding step of the readings (None: not rounded), and the smallest and largest possible reading.
    orientations_rad, repeats
        Possible turns of the sensor, added to the arm's orientation, and numbers of repeated readings.
    heights_mm, calibrated_height_mm
        Possible heights above the surface, if selectable, and the height of the calibration; other heights scale the
        footprint and dim the signal (see `sensor.commanded`). Without selectable heights every reading counts as one at
        the height of the calibration, about which effects of the height change it; None: not known, 14 mm for these.
    batch
        Readings chosen together for their joint information, until the utility near the end of a run chooses them one
        by one; above 1 only with the default utility or `InformationGain`.
    stop_sd_mm
        The run ends when the posterior sds of all of the shape's parameters in mm are below this: 4 mm, half the
        spacing of LEGO holes, in the paper. For a set of shapes, the parameters of the most probable shape.
    stop_probability
        For a set of shapes, the probability that the most probable shape needs for the run to end.
    trust
        Prior probability that the sensor model is complete. Below 1, the run also infers which effect the model leaves
        out (`experiment.rivals`), and ends only when the lengths are known whichever it is.
    doubt_p
        p-value of the best hypothesis below which the run reports that no hypothesis explains the readings and that
        the posterior is not to be trusted; 0 for a model that is known to be coarse. Where the most probable noise is
        not the declared one, the fit is not tested.
    n_particles
        Number of weighted posterior samples.
    n_samples
        Number of hypotheses in figures and for the paper's utility; 50 in the paper.
    n_live
        Live points of nested sampling, which takes over if no sample predicts a reading.
    method
        Method of inference; None: `SequentialMonteCarlo` with `n_particles` and `n_live`.
    fitted_arm
        The arm with the known error of its geometry: the run ends when the sds of the lengths with that error are below
        the target, or when that error alone is above. None: the arm's error is not known and not part of the sds.
    """

    shape: Shape
    model: SensorModel
    likelihood: Likelihood
    noise_sd: float
    grid: Grid = field(default_factory=Grid)
    utility: Utility = field(default_factory=Finishing)
    sensor_prior: Prior | None = None
    step: float | None = None
    reading_range: tuple[float, float] = (-math.inf, math.inf)
    orientations_rad: tuple[float, ...] = (0.0,)
    repeats: tuple[int, ...] = (1,)
    heights_mm: tuple[float, ...] = ()
    calibrated_height_mm: float | None = None
    batch: int = 1
    stop_sd_mm: float = 4.0
    stop_probability: float = 0.95
    doubt_p: float = 1e-6
    trust: float = 1.0
    n_particles: int = 3000
    n_samples: int = 50
    n_live: int = 200
    method: Method | None = None
    fitted_arm: FittedArm | None = None

    def __post_init__(self) -> None:
        require_shape(self.shape)
        require_model(self.model)
        require_likelihood(self.likelihood)
        checked_number("noise_sd", self.noise_sd)
        require_callable("utility", self.utility, "a utility of probewise.inquiry, such as InformationGain()")
        self._require_thresholds_in_range()
        self._require_counts()
        self._require_heights()
        if self.model.names != self.prior.names:
            raise ParameterError(
                "model.names",
                self.model.names,
                f"{self.prior.names}: the sensor's that are not known, then the shape's",
            )
        if not any(name.endswith("_mm") for name in self.shape.prior.names):
            raise ParameterError("shape", self.names, "a shape with a parameter in mm, which the run can stop on")
        if self.trust < 1:
            _ = self._rivals
        _ = self.readout, self.designs  # their constructors check the values

    def _require_thresholds_in_range(self) -> None:
        """Raise ParameterError unless target sd and probability of the stopping rule, trust and doubt are in range."""
        if not 0 < self.stop_sd_mm < math.inf:
            raise ParameterError("stop_sd_mm", self.stop_sd_mm, "finite, greater than 0")
        if not 0 < self.stop_probability < 1:
            raise ParameterError("stop_probability", self.stop_probability, "between 0 and 1")
        if not 0 < self.trust <= 1:
            raise ParameterError("trust", self.trust, "greater than 0, up to 1")
        if not 0 <= self.doubt_p < 1:
            raise ParameterError("doubt_p", self.doubt_p, "0 or more, below 1")

    def _require_counts(self) -> None:
        """Raise ParameterError unless the numbers of samples, and of readings chosen together, are allowed."""
        if self.n_samples < 2:
            raise ParameterError("n_samples", self.n_samples, "2 or more: one hypothesis leaves nothing to ask")
        if self.n_particles < max(self.n_samples, 100):
            raise ParameterError("n_particles", self.n_particles, "100 or more, and no fewer than n_samples")
        most = _MOST_BATCH if self.utility in (Finishing(), InformationGain()) else 1
        if not 1 <= self.batch <= most:
            allowed = f"1, or up to {_MOST_BATCH} with the utility Finishing() or InformationGain()"
            raise ParameterError("batch", self.batch, allowed)

    def _require_heights(self) -> None:
        """Raise ParameterError unless the heights are positive and within a factor of ten of the calibration's."""
        if self.heights_mm and self.calibrated_height_mm is None:
            raise ParameterError("calibrated_height_mm", None, "a height where heights_mm may be chosen")
        if not all(0 < height < math.inf for height in (*self.heights_mm, self.calibrated_height_mm or 1.0)):
            raise ParameterError("heights_mm", self.heights_mm, "finite, greater than 0")
        if self.calibrated_height_mm is not None:
            low, high = self.calibrated_height_mm / _MOST_LIFTED, self.calibrated_height_mm * _MOST_LIFTED
            if not all(low <= height <= high for height in self.heights_mm):
                allowed = f"{low:g} to {high:g}: the sensor was calibrated at {self.calibrated_height_mm:g} mm"
                raise ParameterError("heights_mm", self.heights_mm, allowed)

    @cached_property
    def inference_method(self) -> Method:
        """The method of inference: `method`, or the default that it stands for."""
        return SequentialMonteCarlo(self.n_particles, self.n_live) if self.method is None else self.method

    @cached_property
    def prior(self) -> Prior:
        """Prior of all parameters: the sensor's, if inferred, then the shape's."""
        return self.shape.prior if self.sensor_prior is None else Joint((self.sensor_prior, self.shape.prior))

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names, one per column of theta: unknown ones of the sensor, then the shape's."""
        return self.prior.names

    @property
    def cards(self) -> tuple[Card, ...]:
        """Reference cards of known place and albedo on the field."""
        return cards_of(self.model)

    @cached_property
    def shape_columns(self) -> IntArray:
        """Columns of theta that hold the shape's parameters."""
        n_shape = len(self.shape.prior.names)
        return np.arange(len(self.names) - n_shape, len(self.names))

    @cached_property
    def readout(self) -> Readout:
        """Noise, rounding and range of a reading."""
        return Readout(self.noise_sd, self.step, *self.reading_range)

    @cached_property
    def designs(self) -> Designs:
        """The possible readings: place, turn of the sensor, number of repeats, height."""
        settings = (("height_mm", self.heights_mm),) if self.heights_mm else ()
        return Designs(self.grid, self.orientations_rad, self.repeats, settings)

    @cached_property
    def instrumentation(self) -> Instrumentation:
        """Instrumentation for plans: `calibrated_height_mm`, and defaults for the rest."""
        return Instrumentation(height_mm=self.calibrated_height_mm)

    @cached_property
    def goal(self) -> Goal | None:
        """The stopping rule on sds of lengths; None for a set of shapes, whose parameters are not known in advance."""
        if isinstance(self.shape, AnyOf):
            return None
        names = zip(self.shape_columns.tolist(), self.shape.prior.names, strict=True)
        return Goal(tuple(column for column, name in names if name.endswith("_mm")), self.stop_sd_mm)

    @cached_property
    def forecast(self) -> Forecast:
        """Predictions of readings for many hypotheses at many designs, by tables where possible; built once."""
        if not self.heights_mm or self.calibrated_height_mm is None:
            return forecast_of(self.model)
        return forecast_of(self.model, highest=max(self.heights_mm) / self.calibrated_height_mm)

    def problem(self, readings: Sequence[Reading]) -> SensorProblem:
        """Return the inference problem for these readings; with `trust` below 1, its times are paced (see `Pace`)."""
        recording = recording_of(readings, instrumentation=self.instrumentation)
        if not self.heights_mm and self.calibrated_height_mm is not None:
            recording = _without_commanded_heights(recording)
        if self.trust < 1:
            recording = Pace.from_readings(readings).recording_with_paced_time(recording)
        return SensorProblem(self.prior, self.forecast.model, self.likelihood, recording)

    @property
    def _rivals(self) -> tuple[SensorModelRival, ...]:
        field_mm = self.grid.width_mm, self.grid.height_mm
        return rivals_of(self.model, self.likelihood, field_mm, height_mm=self.calibrated_height_mm)

    @cached_property
    def kinds(self) -> tuple[HypothesisKind, ...]:
        """The competing kinds of hypotheses, see `kinds_of`; with `trust` 1, one kind for every shape."""
        rivals = self._rivals if self.trust < 1 else ()
        models = self.forecast.model, self.model
        return kinds_of(
            self.shape, self.sensor_prior, self.prior, models, self.likelihood, trust=self.trust, rivals=rivals
        )

    def may_stop(self, sd: FloatArray, shapes: Mapping[str, float], chance_off: float = 0.0) -> bool:
        """Return whether the stopping rule is met: the shape is known to the target precision.

        Parameters
        ----------
        sd, shapes
            Posterior sds of the shape's parameters, and the shapes' probabilities.
        chance_off
            Probability that a length is off by three times the target sd, see
            `stopping_rule.probability_of_length_off`. With `trust` below 1, this probability must be below 1 %, since
            the posterior then has tails that sds do not show.
        """
        likely = max(shapes.values(), default=1.0)
        sure = self.trust == 1 or chance_off < MOST_OFF
        return largest_sd_mm(self.shape.prior.names, sd) < self.stop_sd_mm and likely >= self.stop_probability and sure

    def fit_is_doubtful(self, p_value: float | None) -> bool:
        """Return whether the p-value of the best hypothesis says that none explains the readings; None: not tested."""
        return p_value is not None and p_value < self.doubt_p

    def settings(self, seed: np.random.SeedSequence) -> dict[str, Any]:
        """Return the settings for a journal's first line as JSON values; models and likelihoods also by digest."""
        method = {} if self.method is None else {"method": repr(self.method)}
        return {
            "version": __version__,
            "field": {
                "width_mm": self.grid.width_mm,
                "height_mm": self.grid.height_mm,
                "n_x": self.grid.n_x,
                "n_y": self.grid.n_y,
            },
            "shape": repr(self.shape),
            "model": type(self.model).__name__,
            "sensor": value_digest(self.model),
            "sensor_prior": repr(self.sensor_prior),
            "likelihood": repr(self.likelihood),
            "likelihood_sha256": value_digest(self.likelihood),
            "utility": repr(self.utility),
            **method,
            **({} if self.fitted_arm is None else {"fitted_arm": value_digest(self.fitted_arm)}),
            "seed": seed_text(seed),
            "spawn_key": list(seed.spawn_key),
            "options": {
                "noise_sd": self.noise_sd,
                "step": self.step,
                "reading_range": [None if math.isinf(end) else end for end in self.reading_range],
                "orientations_rad": list(self.orientations_rad),
                "repeats": list(self.repeats),
                "heights_mm": list(self.heights_mm),
                # Journals name it only beside heights to choose from; otherwise the sensor's file stands for it.
                "calibrated_height_mm": self.calibrated_height_mm if self.heights_mm else None,
                "batch": self.batch,
                "stop_sd_mm": self.stop_sd_mm,
                "stop_probability": self.stop_probability,
                "doubt_p": self.doubt_p,
                "trust": self.trust,
                "n_particles": self.n_particles,
                "n_samples": self.n_samples,
                "n_live": self.n_live,
            },
        }


def _without_commanded_heights(recording: Recording) -> Recording:
    """Return a recording whose readings all count as ones at the declared height, as the designs of the run do."""
    covariates = {name: column for name, column in recording.plan.covariates.items() if name != "height_mm"}
    return replace(recording, plan=replace(recording.plan, covariates=covariates))


def largest_sd_mm(names: tuple[str, ...], sd: FloatArray) -> float:
    """Return the largest sd among the parameters whose names end in _mm; NaN is ignored."""
    return float(np.nanmax([value for name, value in zip(names, sd, strict=True) if name.endswith("_mm")]))


def seed_text(seed: np.random.SeedSequence) -> str:
    """Return the seed's entropy as text, since that integer may exceed a JSON number."""
    return str(seed.entropy) if isinstance(seed.entropy, int) else ",".join(str(word) for word in seed.entropy or ())
