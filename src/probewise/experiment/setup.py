"""The setup of a run: hypotheses, sensor, arm, designs, utility, stopping rule."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from probewise._arrays import IntArray
from probewise._kinds import checked_number, require_callable, require_kind
from probewise._version import __version__
from probewise.arm.carry_out import recording_of
from probewise.arm.geometry import Geometry, place_jacobian
from probewise.arm.instrument import Reading
from probewise.calibration.sensor_file import FittedSensor
from probewise.errors import require
from probewise.experiment.journal import value_digest
from probewise.experiment.kinds import HypothesisKind, KindProblem, kinds_of
from probewise.experiment.method import Method, SequentialMonteCarlo
from probewise.experiment.rivals import Pace, SensorModelRival, rivals_of
from probewise.inference.problem import Likelihood, require_likelihood, require_model
from probewise.inquiry import Designs, Finishing, Goal, Grid, InformationGain, Readout, Utility, forecast_of
from probewise.inquiry.forecast import Forecast
from probewise.priors import Joint, Prior
from probewise.recordings.plan import Instrumentation
from probewise.scene import Card
from probewise.scene.shapes import AnyOf, Shape, require_shape
from probewise.sensor import Chain
from probewise.sensor.chain import cards_of
from probewise.sensor.stages import SensorModel


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
        the height there. A sensor's file does not say it; None assumes the middle of the field, where the command `arm
        record` lays a plan by default. ParameterError for a place out of the arm's reach.
    """

    geometry: Geometry
    levels: tuple[float, float]
    calibrated_mm: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        require_kind("geometry", self.geometry, Geometry, "a Geometry, such as read_geometry(path) returns")
        require(self.geometry.accuracy, "geometry", "one without [accuracy]", "one that was fitted to marks")
        place_mm = self.calibration_place_mm
        allowed = "a place within the arm's reach, at which it took the readings of the calibration"
        require(_reads_at(self.geometry, place_mm), "calibrated_mm", place_mm, allowed)

    @property
    def calibration_place_mm(self) -> tuple[float, float]:
        """Place of the calibration, or the middle of the field, which is assumed."""
        return _middle_of_field(self.geometry) if self.calibrated_mm is None else self.calibrated_mm

    @classmethod
    def from_geometry_and_sensor(cls, geometry: Geometry, sensor: FittedSensor) -> Self:
        """Build from a fitted geometry, with the sensor's posterior mean levels.

        The calibration is assumed in the middle of the field, or, of an arm that does not reach that, at the nearest
        place that it does.
        """
        require_kind("geometry", geometry, Geometry, "a Geometry, such as read_geometry(path) returns")
        means, middle = sensor.mean(), _middle_of_field(geometry)
        places = geometry.reachable_grid_mm
        calibrated_mm = None
        if not _reads_at(geometry, middle) and len(places):
            x_mm, y_mm = places[np.hypot(*(places - middle).T).argmin()].tolist()
            calibrated_mm = (x_mm, y_mm)
        return cls(geometry, (means["I_min"], means["I_max"]), calibrated_mm)


def _middle_of_field(geometry: Geometry) -> tuple[float, float]:
    width_mm, height_mm = geometry.field_mm
    return width_mm / 2, height_mm / 2


def _reads_at(geometry: Geometry, place_mm: tuple[float, float]) -> bool:
    """Return whether the effect of the arm's error at a place is defined: whether the links reach that far and near."""
    return bool(np.isfinite(place_jacobian(geometry, np.array([place_mm]))).all())


_MOST_BATCH = 100
_LEAST_PARTICLES = 100
_MOST_LIFTED = 10.0
"""Largest factor between reading height and calibrated height, either way."""

_SETTINGS_OF_RUN = ("batch", "stop_sd_mm", "stop_probability", "doubt_p", "trust", "n_particles", "n_samples", "n_live")


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
        most = _MOST_BATCH if self.utility in (Finishing(), InformationGain()) else 1
        many = f"1, or up to {_MOST_BATCH} with the utility Finishing() or InformationGain()"
        heights, known_mm = self.heights_mm, self.calibrated_height_mm
        low, high = (0.0, math.inf) if known_mm is None else (known_mm / _MOST_LIFTED, known_mm * _MOST_LIFTED)
        lifted = f"{low:g} to {high:g}: the sensor was calibrated at {known_mm or 0:g} mm"
        positive = all(0 < height < math.inf for height in (*heights, known_mm or 1.0))
        of_shape = f"{self.prior.names}: the sensor's that are not known, then the shape's"
        has_lengths = any(name.endswith("_mm") for name in self.shape.prior.names)
        for name, value, fits, allowed in (
            ("stop_sd_mm", self.stop_sd_mm, 0 < self.stop_sd_mm < math.inf, "finite, greater than 0"),
            ("stop_probability", self.stop_probability, 0 < self.stop_probability < 1, "between 0 and 1"),
            ("trust", self.trust, 0 < self.trust <= 1, "greater than 0, up to 1"),
            ("doubt_p", self.doubt_p, 0 <= self.doubt_p < 1, "0 or more, below 1"),
            ("n_samples", self.n_samples, self.n_samples >= 2, "2 or more: one hypothesis leaves nothing to ask"),
            (
                "n_particles",
                self.n_particles,
                self.n_particles >= max(self.n_samples, _LEAST_PARTICLES),
                f"{_LEAST_PARTICLES} or more, and no fewer than n_samples",
            ),
            ("batch", self.batch, 1 <= self.batch <= most, many),
            ("calibrated_height_mm", None, known_mm or not heights, "a height where heights_mm may be chosen"),
            ("heights_mm", heights, positive, "finite, greater than 0"),
            ("heights_mm", heights, all(low <= height <= high for height in heights), lifted),
            ("model.names", self.model.names, self.model.names == self.prior.names, of_shape),
            ("shape", self.names, has_lengths, "a shape with a parameter in mm, which the run can stop on"),
        ):
            require(fits, name, value, allowed)
        if self.trust < 1:
            _ = self._rivals
        _ = self.readout, self.designs  # their constructors check the values

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
        """The target sd of the lengths; None for a set of shapes, whose parameters are not known in advance."""
        if isinstance(self.shape, AnyOf):
            return None
        names = zip(self.shape_columns.tolist(), self.shape.prior.names, strict=True)
        return Goal(tuple(column for column, name in names if name.endswith("_mm")), self.stop_sd_mm)

    @cached_property
    def footprint_mm(self) -> float:
        """Twice the largest sd of the calibrated footprint along the sensor's axes; 0 for a model without one."""
        if not isinstance(self.model, Chain):
            return 0.0
        footprint = self.model.ssf.footprint(np.empty((1, 0)))
        share, u_mm, v_mm = footprint.weight, footprint.u_mm, footprint.v_mm
        variances = [
            float((share * (var + (at - (share * at).sum()) ** 2)).sum() / share.sum())
            for at, var in ((u_mm, footprint.var_u), (v_mm, footprint.var_v))
        ]
        return 2.0 * math.sqrt(max(variances))

    @cached_property
    def forecast(self) -> Forecast:
        """Predictions of readings for many hypotheses at many designs, by tables where possible; built once."""
        if not self.heights_mm or self.calibrated_height_mm is None:
            return forecast_of(self.model)
        return forecast_of(self.model, highest=max(self.heights_mm) / self.calibrated_height_mm)

    def problem(self, readings: Sequence[Reading]) -> KindProblem:
        """Return the inference problem for these readings; with `trust` below 1, its times are paced (see `Pace`)."""
        recording = recording_of(readings, instrumentation=self.instrumentation)
        plan = recording.plan
        if not self.heights_mm and self.calibrated_height_mm is not None:
            # All readings count as ones at the declared height, as the designs do.
            plan = replace(plan, covariates={k: v for k, v in plan.covariates.items() if k != "height_mm"})
        if self.trust < 1:
            plan = Pace.from_readings(readings).plan_with_paced_time(plan)
        return KindProblem(self.prior, self.forecast.model, self.likelihood, replace(recording, plan=plan))

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

    def fit_is_doubtful(self, p_value: float | None) -> bool:
        """Return whether the p-value of the best hypothesis says that none explains the readings; None: not tested."""
        return p_value is not None and p_value < self.doubt_p

    def settings(self, seed: np.random.SeedSequence) -> dict[str, Any]:
        """Return the settings for a journal's first line as JSON values; models and likelihoods also by digest."""
        method = {} if self.method is None else {"method": repr(self.method)}
        entropy = seed.entropy
        return {
            "version": __version__,
            "field": {name: getattr(self.grid, name) for name in ("width_mm", "height_mm", "n_x", "n_y")},
            "shape": repr(self.shape),
            "model": type(self.model).__name__,
            "sensor": value_digest(self.model),
            "sensor_prior": repr(self.sensor_prior),
            "likelihood": repr(self.likelihood),
            "likelihood_sha256": value_digest(self.likelihood),
            "utility": repr(self.utility),
            **method,
            **({} if self.fitted_arm is None else {"fitted_arm": value_digest(self.fitted_arm)}),
            # As text, since that integer may exceed a JSON number.
            "seed": str(entropy) if isinstance(entropy, int) else ",".join(str(word) for word in entropy or ()),
            "spawn_key": list(seed.spawn_key),
            "options": {
                **{name: getattr(self, name) for name in ("noise_sd", "step")},
                "reading_range": [None if math.isinf(end) else end for end in self.reading_range],
                **{name: list(getattr(self, name)) for name in ("orientations_rad", "repeats", "heights_mm")},
                # Journals name it only beside heights to choose from; otherwise the sensor's file stands for it.
                "calibrated_height_mm": self.calibrated_height_mm if self.heights_mm else None,
                **{name: getattr(self, name) for name in _SETTINGS_OF_RUN},
            },
        }
