"""Values of a run: state, step, and the whole exploration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from probewise._arrays import FloatArray
from probewise._display import ShowsItself
from probewise._kinds import require_kind
from probewise._words import count_with_noun
from probewise.arm.instrument import Pose, Reading
from probewise.experiment.configuration import Experiment, largest_sd_mm
from probewise.experiment.hidden import HiddenShape
from probewise.experiment.journal import recording_of
from probewise.experiment.pace import Pace
from probewise.experiment.posterior import Posterior
from probewise.inquiry import UtilityMap
from probewise.nested import Weighted
from probewise.recordings.plan import Instrumentation, Recording

PAPER_BITS = 25.0
"""Bits in the paper's count for a circle known to 4 mm: one per reading of the naive model."""


@dataclass(frozen=True, eq=False)
class ExplorationState:
    """The current state of a run.

    `readings` so far, the `posterior` given them, the next pose, and the poses `planned` after it in a batch.
    """

    readings: tuple[Reading, ...]
    posterior: Posterior
    next_pose: Pose
    planned: tuple[Pose, ...] = ()


@dataclass(frozen=True, eq=False)
class Step(ShowsItself):
    """The result of one reading.

    Attributes
    ----------
    number, reading
        Number of the reading from 1, and the reading.
    names, mean, sd
        Names of the shape's parameters, their posterior means and sds, each (n_params,). For a set of shapes: given the
        most probable shape, with NaN for parameters of other shapes.
    shapes
        Probability of each shape of a set, by its name; empty for a single shape.
    samples
        Shapes drawn from the posterior, (n_samples, n_params).
    map
        Utility of each possible next reading.
    next_pose
        Next pose; None when the run is over.
    bits
        Information gained so far: prior minus posterior differential entropy of all parameters. With `trust` below 1,
        the information about the effect left out and its parameters is added, so this exceeds that about the shape.
    p_value
        p-value of the best hypothesis: upper tail of chi-square with one degree of freedom per reading (conservative).
        None where the most probable noise is not the declared one, of which this test is.
    posterior
        Weighted posterior of all parameters, with the evidence; the odds of a left-out effect are raised (`WARY`).
    sensor
        Posterior mean and sd of the sensor's parameters by name, if they are inferred too.
    left_out
        Probability of each effect that the sensor model may leave out, by name; "" is none. The odds are not raised.
    kinds
        The posterior of every kind of hypotheses, with odds as in `left_out`.
    chance_off
        Probability that a length is off by three times the sd of the stopping rule.
    stop_reason
        Reason why the run ends here, or None.
    notes
        Warnings on this step.
    replayed
        Whether the reading comes from a journal.
    pace
        Pace of the run so far.
    arm_error
        Effect of the arm's own error; None far from the end of a run, or if that error is not known.
    checks_sensor
        Whether the stopping rule is met, and the run goes on only to check what the sensor model may leave out.
    """

    number: int
    reading: Reading
    names: tuple[str, ...]
    mean: FloatArray
    sd: FloatArray
    shapes: Mapping[str, float]
    samples: FloatArray
    map: UtilityMap
    next_pose: Pose | None
    bits: float
    p_value: float | None
    posterior: Weighted
    sensor: Mapping[str, tuple[float, float]]
    left_out: Mapping[str, float]
    kinds: Posterior
    chance_off: float
    stop_reason: str | None
    notes: tuple[str, ...]
    replayed: bool = False
    pace: Pace = field(default_factory=Pace)
    arm_error: ArmError | None = None
    checks_sensor: bool = False

    @property
    def log_z(self) -> float:
        """Natural log of the evidence of all readings so far."""
        return self.posterior.log_z

    @property
    def largest_sd_mm(self) -> float:
        """Largest posterior sd among the parameters in mm."""
        return largest_sd_mm(self.names, self.sd)

    @property
    def likely_shape(self) -> str:
        """Name of the most probable shape of a set; "" for a single shape."""
        return max(self.shapes, key=self.shapes.__getitem__, default="")

    @property
    def orientation_and_height_text(self) -> str:
        """Orientation and height of the sensor, as far as the run can choose them, as text after the place; else ""."""
        pose, designs = self.reading.pose, self.map.designs
        turned = f", turned {math.degrees(pose.orientation_rad):.0f}°" if len(designs.orientations_rad) > 1 else ""
        raised = "" if pose.height_mm is None else f", {pose.height_mm:g} mm up"
        return turned + raised

    def summary(self) -> str:
        """Return a one-line summary of the reading and the posterior."""
        believed = ", ".join(
            f"{name} {mean:.{_n_decimals(name)}f} ± {sd:.{_n_decimals(name)}f}"
            for name, mean, sd in zip(self.names, self.mean, self.sd, strict=True)
            if np.isfinite(mean)
        )
        pose = self.reading.pose
        if self.shapes:
            believed = f"{self.likely_shape} (p = {self.shapes[self.likely_shape]:.2f}): {believed}"
        return (
            f"reading {self.number}: {self.reading.value:g} at ({pose.x_mm:.0f}, {pose.y_mm:.0f}) mm"
            f"{self.orientation_and_height_text}; {believed}; {self.bits:.1f} bits"
        )


def stop_reason_with_checks(steps: Sequence[Step]) -> str | None:
    """Return the reason of the last step to end, or None, and how many readings before it only checked the sensor."""
    reason, n = steps[-1].stop_reason, sum(step.checks_sensor for step in steps)
    if reason is None or n == 0:
        return reason
    taken = f"{count_with_noun(n, 'reading')} {'was' if n == 1 else 'were'} taken"
    return f"{reason}; {taken} with that known, to check what the sensor model may leave out"


@dataclass(frozen=True, eq=False)
class ArmError:
    """Effect of an error in the arm's geometry, common to all readings, on the posterior of the shape.

    Attributes
    ----------
    slopes
        Shift of the posterior mean by each independent error of one sd, (n_params, n_errors).
    shifts
        Shift of each posterior sample by an error of the arm drawn for it, (n_samples, n_params).
    """

    slopes: FloatArray
    shifts: FloatArray

    @property
    def sd(self) -> FloatArray:
        """Sd of the shape's parameters that comes from the arm, (n_params,)."""
        return np.asarray(np.sqrt((self.slopes**2).sum(axis=1)))


@dataclass(frozen=True, eq=False)
class Exploration(ShowsItself):
    """A whole run: its steps, why it ended, what it found.

    Attributes
    ----------
    experiment, steps
        The configuration, and the result of each reading.
    hidden
        The true shape, if it is known.
    """

    experiment: Experiment
    steps: tuple[Step, ...]
    hidden: HiddenShape | None = None

    @property
    def arm_error(self) -> ArmError | None:
        """Effect of the arm's own error after the last reading; None if that error is not known."""
        return self.last.arm_error

    @property
    def last(self) -> Step:
        """The last step."""
        return self.steps[-1]

    @property
    def readings(self) -> tuple[Reading, ...]:
        """The readings in order of time."""
        return tuple(step.reading for step in self.steps)

    @property
    def posterior(self) -> Weighted:
        """The weighted posterior after the last reading, with the arm's own error if that is known."""
        found = self.last.posterior
        if self.arm_error is None:
            return found
        theta = found.theta.copy()
        theta[:, self.experiment.shape_columns] += self.arm_error.shifts
        return replace(found, theta=theta)

    @property
    def sd(self) -> FloatArray:
        """Posterior sds of the shape's parameters, (n_params,), with the arm's own error if that is known."""
        return self.last.sd if self.arm_error is None else np.hypot(self.last.sd, self.arm_error.sd)

    @property
    def stop_reason(self) -> str:
        """Reason why the run ended, and the largest sd with the arm's error if the stopping rule did not count that."""
        reason = stop_reason_with_checks(self.steps) or "the caller ended it"
        if self.arm_error is None or self.experiment.fitted_arm is not None:
            return reason
        widest = largest_sd_mm(self.last.names, self.sd)
        return f"{reason}; with the arm's own error the widest is known to {widest:.1f} mm"

    @property
    def reached(self) -> bool:
        """Whether the target precision was reached, arm included, with a hypothesis that explains the readings."""
        trusted = not self.experiment.fit_is_doubtful(self.last.p_value)
        return trusted and self.experiment.may_stop(self.sd, self.last.shapes, self.last.chance_off)

    @property
    def seconds(self) -> float:
        """Arm time up to the last reading, in seconds."""
        return self.last.reading.time_s

    @property
    def bits_per_reading(self) -> float:
        """Bits gained per reading, from differential entropies."""
        return self.last.bits / len(self.steps)

    @property
    def paper_bits_per_reading(self) -> float:
        """Bits per reading as the paper counts: 25 bits over the number of readings."""
        return PAPER_BITS / len(self.steps)

    @property
    def notes(self) -> tuple[str, ...]:
        """Warnings on the last step."""
        return self.last.notes

    def recording(self, *, instrumentation: Instrumentation | None = None) -> Recording:
        """Convert the readings to a recording over the pattern "field", with a sensor's `instrumentation`."""
        return recording_of(self.readings, instrumentation=instrumentation)

    def summary(self) -> str:
        """Describe the run in plain text."""
        last = self.last
        lines = [
            f"readings     {len(self.steps)}",
            f"stopped      {self.stop_reason}",
            f"information  {last.bits:.1f} bits, {self.bits_per_reading:.2f} per reading "
            f"(the paper's count: {PAPER_BITS:g} bits, {self.paper_bits_per_reading:.2f} per reading)",
            f"log Z        {self.posterior.log_z:.2f} ± {self.posterior.log_z_error:.2f}",
            "fit          not tested: the most probable noise is not the declared one"
            if last.p_value is None
            else f"fit          p = {last.p_value:.2g} (how often a right hypothesis fits no better)",
        ]
        if self.hidden is not None:
            lay = ", ".join(f"{name} {value:.{_n_decimals(name)}f}" for name, value in self.hidden.parameters.items())
            lines.append(f"hidden       {self.hidden.name}: {lay}")
        lines += [f"{label:<12} p = {probability:.3f}" for label, probability in last.shapes.items()]
        width = max(9, *(len(name) for name in (*last.names, *last.sensor)))
        lines += [
            f"{name:<{width}}  {mean:.{1 + _n_decimals(name)}f} ± {sd:.{1 + _n_decimals(name)}f}"
            for name, mean, sd in zip(last.names, last.mean, self.sd, strict=True)
            if np.isfinite(mean)
        ]
        if self.arm_error is not None:
            own = ", ".join(
                f"{name} {sd:.{1 + _n_decimals(name)}f}"
                for name, mean, sd in zip(last.names, last.mean, self.arm_error.sd, strict=True)
                if np.isfinite(mean) and name != "shape"
            )
            lines.append(f"arm          of these sds its own error makes up {own}: the same for all readings")
        lines += [f"{name:<{width}}  {mean:.3g} ± {sd:.2g} (sensor)" for name, (mean, sd) in last.sensor.items()]
        return "\n".join([*lines, *(f"doubtful: {note}" for note in self.notes)])


def _n_decimals(name: str) -> int:
    """Return the number of decimals to show for a parameter: 3 for one in radians, else 1."""
    return 3 if name.endswith("_rad") else 1


def require_exploration(run: object) -> None:
    """Raise ParameterError unless `run` is an Exploration."""
    require_kind("run", run, Exploration, "an Exploration, as probewise.explore returns it")
