"""What a run is made of: the experiment that decides it, its state, its steps, the whole."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise._display import ShowsItself
from probewise._version import __version__
from probewise.arm.instrument import Pose, Reading
from probewise.errors import ParameterError
from probewise.experiment.digest import value_digest
from probewise.experiment.journal import recording_of
from probewise.inference.problem import Likelihood, SensorProblem
from probewise.inference.student_t import StudentT
from probewise.inquiry import EntropyMap, Grid, ReadingEntropy, Utility
from probewise.nested.result import NestedResult
from probewise.priors import Prior
from probewise.recordings.plan import Recording
from probewise.scene.albedo import Shape
from probewise.sensor.stages import SensorModel

__all__ = ["PAPER_BITS", "Experiment", "Exploration", "OneScan", "State", "Step"]

PAPER_BITS = 25.0
"""Bits that the paper counts for a circle known to 4 mm: one for each reading of the naive model."""


@dataclass(frozen=True)
class OneScan:
    """Score a growing number of readings that share one unknown sd: Student-t, one data set (paper, SSF likelihood).

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
        """Score every hypothesis, (n_points,), (n_samples, n_points) -> (n_samples,); see `inference.StudentT`."""
        one = np.zeros(readings.size, dtype=np.int64)
        return StudentT(one, self.sd_floor, self.sd_ceiling).log_prob(readings, predicted)


@dataclass(frozen=True, eq=False)
class Experiment:
    """Everything that decides the course of a run but the arm and the seed.

    Parameters
    ----------
    shape
        What may lie on the field; its prior is what is believed before the first reading.
    model
        The sensor over a scene of that shape; its parameters are the shape's, no others are free.
    likelihood
        How readings are weighed against predictions: any with any model.
    noise_sd
        Sd of one reading in the sensor's unit, for the check of fit and for utilities that weigh noise.
    grid
        Places that may be looked at.
    utility
        What a set of predicted readings is worth; by default the paper's entropy.
    stop_sd_mm
        The run ends when the posterior sd of every parameter in mm is below it: 4 mm, half
        the spacing of LEGO holes, in the paper. For a set of shapes: every parameter that the
        most probable shape has.
    stop_probability
        For a set of shapes, how probable that shape must be too.
    n_samples
        Hypotheses that are asked for the map and shown; the paper has 50.
    n_live
        Live points of nested sampling at every reading.
    n_diversify
        Metropolis-Hastings steps that break replications among the samples; the paper takes about 1000.
    """

    shape: Shape
    model: SensorModel
    likelihood: Likelihood
    noise_sd: float
    grid: Grid = field(default_factory=Grid)
    utility: Utility = field(default_factory=ReadingEntropy)
    stop_sd_mm: float = 4.0
    stop_probability: float = 0.95
    n_samples: int = 50
    n_live: int = 200
    n_diversify: int = 1000

    def __post_init__(self) -> None:
        for name in ("noise_sd", "stop_sd_mm"):
            if not (0 < getattr(self, name) < math.inf):
                raise ParameterError(name, getattr(self, name), "finite, greater than 0")
        if not 0 < self.stop_probability < 1:
            raise ParameterError("stop_probability", self.stop_probability, "between 0 and 1")
        if self.n_samples < 2:
            raise ParameterError("n_samples", self.n_samples, "2 or more: one hypothesis leaves nothing to ask")
        if self.n_diversify < 0:
            raise ParameterError("n_diversify", self.n_diversify, "0 or more")
        if self.model.names != self.prior.names:
            raise ParameterError(
                "model.names",
                self.model.names,
                f"the shape's {self.prior.names}: a known sensor over a hypothesised shape",
            )
        if not any(name.endswith("_mm") for name in self.names):
            raise ParameterError("shape", self.names, "a shape with a parameter in mm, which the run can stop on")

    @property
    def prior(self) -> Prior:
        """The shape's prior."""
        return self.shape.prior

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names, one a column of theta."""
        return self.prior.names

    def problem(self, readings: Sequence[Reading]) -> SensorProblem:
        """Set up the inference from these readings."""
        return SensorProblem(self.prior, self.model, self.likelihood, recording_of(readings))

    def is_known(self, sd: FloatArray, shapes: Mapping[str, float]) -> bool:
        """Tell whether posterior sds (n_params,) and shape probabilities satisfy the stopping rule."""
        likely = max(shapes.values(), default=1.0)
        return widest_mm(self.names, sd) < self.stop_sd_mm and likely >= self.stop_probability

    def settings(self, seed: np.random.SeedSequence) -> dict[str, Any]:
        """Say what decides a run: a journal's first line."""
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
            "likelihood": repr(self.likelihood),
            "likelihood_sha256": value_digest(self.likelihood),
            "utility": repr(self.utility),
            "seed": seed_text(seed),
            "spawn_key": list(seed.spawn_key),
            "options": {
                "noise_sd": self.noise_sd,
                "stop_sd_mm": self.stop_sd_mm,
                "stop_probability": self.stop_probability,
                "n_samples": self.n_samples,
                "n_live": self.n_live,
                "n_diversify": self.n_diversify,
            },
        }


@dataclass(frozen=True, eq=False)
class State:
    """Where a run stands: the readings so far, and where the next is to be taken."""

    readings: tuple[Reading, ...]
    next_pose: Pose


@dataclass(frozen=True, eq=False)
class Step(ShowsItself):
    """What one reading taught.

    Attributes
    ----------
    number, reading
        Count of readings from 1, and the reading that this step is about.
    names, mean, sd
        Parameters, their posterior means and sds, each (n_params,). For a set of shapes: given
        the most probable one, and NaN for parameters that it does not have.
    shapes
        Probability of each shape of a set, by its label; empty where there is one shape only.
    samples
        Hypotheses drawn from the posterior and diversified, (n_samples, n_params).
    map
        What a reading at each place would be worth now.
    next_pose
        Where the next reading is to be taken; None when the run is over.
    bits
        Prior minus posterior differential entropy of the parameters so far.
    p_value
        How probable readings as far from the best hypothesis as these are, were it true:
        upper tail of chi-square with one degree of freedom a reading, so that it errs towards fitting.
    posterior
        The weighted posterior, with the evidence and its error.
    stop_reason
        Why the run ends here, or None.
    notes
        Why this step should not be trusted blindly.
    replayed
        Whether the reading comes from a journal.
    """

    number: int
    reading: Reading
    names: tuple[str, ...]
    mean: FloatArray
    sd: FloatArray
    shapes: Mapping[str, float]
    samples: FloatArray
    map: EntropyMap
    next_pose: Pose | None
    bits: float
    p_value: float
    posterior: NestedResult
    stop_reason: str | None
    notes: tuple[str, ...]
    replayed: bool = False

    @property
    def log_z(self) -> float:
        """Natural log of the evidence of all readings so far."""
        return self.posterior.log_z

    @property
    def widest_mm(self) -> float:
        """The largest posterior sd among the parameters in mm."""
        return widest_mm(self.names, self.sd)

    @property
    def likely_shape(self) -> str:
        """Label of the most probable shape of a set; empty where there is one shape only."""
        return max(self.shapes, key=self.shapes.__getitem__, default="")

    def summary(self) -> str:
        """Say in one line what was read and what is now believed."""
        believed = ", ".join(
            f"{name} {mean:.1f} ± {sd:.1f}"
            for name, mean, sd in zip(self.names, self.mean, self.sd, strict=True)
            if np.isfinite(mean)
        )
        pose = self.reading.pose
        if self.shapes:
            believed = f"{self.likely_shape} (p = {self.shapes[self.likely_shape]:.2f}): {believed}"
        return (
            f"reading {self.number}: {self.reading.value:g} at ({pose.x_mm:.0f}, {pose.y_mm:.0f}) mm; "
            f"{believed}; {self.bits:.1f} bits"
        )


@dataclass(frozen=True, eq=False)
class Exploration(ShowsItself):
    """A whole run: its steps, why it ended, what it found."""

    experiment: Experiment
    steps: tuple[Step, ...]

    @property
    def last(self) -> Step:
        """The last step."""
        return self.steps[-1]

    @property
    def readings(self) -> tuple[Reading, ...]:
        """The readings in the order of taking."""
        return tuple(step.reading for step in self.steps)

    @property
    def posterior(self) -> NestedResult:
        """The weighted posterior after the last reading."""
        return self.last.posterior

    @property
    def stop_reason(self) -> str:
        """Why the run ended."""
        return self.last.stop_reason or "the caller ended it"

    @property
    def reached(self) -> bool:
        """Whether shape and lengths are known well enough."""
        return self.experiment.is_known(self.last.sd, self.last.shapes)

    @property
    def bits_per_reading(self) -> float:
        """Bits gained a reading, from differential entropies."""
        return self.last.bits / len(self.steps)

    @property
    def paper_bits_per_reading(self) -> float:
        """The paper's count: its 25 bits over the number of readings (its 25 / 16 = 1.56)."""
        return PAPER_BITS / len(self.steps)

    @property
    def notes(self) -> tuple[str, ...]:
        """Doubts about the last step: why the result should not be trusted blindly."""
        return self.last.notes

    def recording(self) -> Recording:
        """Turn the readings into a recording over the pattern "field"."""
        return recording_of(self.readings)

    def summary(self) -> str:
        """Describe the run in plain text."""
        last = self.last
        lines = [
            f"readings     {len(self.steps)}",
            f"stopped      {self.stop_reason}",
            f"information  {last.bits:.1f} bits, {self.bits_per_reading:.2f} a reading "
            f"(the paper's count: {PAPER_BITS:g} bits, {self.paper_bits_per_reading:.2f} a reading)",
            f"log Z        {self.posterior.log_z:.2f} ± {self.posterior.log_z_error:.2f}",
            f"fit          p = {last.p_value:.2g}",
        ]
        lines += [f"{label:<12} p = {probability:.3f}" for label, probability in last.shapes.items()]
        width = max(9, *(len(name) for name in last.names))
        lines += [
            f"{name:<{width}}  {mean:.2f} ± {sd:.2f}"
            for name, mean, sd in zip(last.names, last.mean, last.sd, strict=True)
            if np.isfinite(mean)
        ]
        return "\n".join([*lines, *(f"doubtful: {note}" for note in self.notes)])


def widest_mm(names: tuple[str, ...], sd: FloatArray) -> float:
    """Take the largest sd among the parameters in mm, whose names end so; NaN (no such parameter here) is left out."""
    return float(np.nanmax([value for name, value in zip(names, sd, strict=True) if name.endswith("_mm")]))


def seed_text(seed: np.random.SeedSequence) -> str:
    """Write the seed's number as text: it may be longer than a JSON number."""
    return str(seed.entropy) if isinstance(seed.entropy, int) else ",".join(str(word) for word in seed.entropy or ())
