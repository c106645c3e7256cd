"""The result of a run: each step, the whole exploration, what the sensor may leave out, and the files of these."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise._display import Reported, ShowsItself
from probewise._kinds import require_kind
from probewise._words import count_with_noun
from probewise.arm.carry_out import recording_of
from probewise.arm.instrument import Pose, Reading
from probewise.calibration import FittedSensor
from probewise.effects import spoken_name
from probewise.experiment.arm_error import ArmError
from probewise.experiment.judgement import Judgement, is_target_reached, largest_sd_mm, probability_of_length_off
from probewise.experiment.kinds import HypothesisKind, PosteriorByKind
from probewise.experiment.rivals import LEVELS_CHANGED, Pace
from probewise.experiment.setup import Experiment
from probewise.experiment.simulated import HiddenShape
from probewise.inquiry import UtilityMap
from probewise.nested import Weighted
from probewise.nested.weights import weighted_quantiles
from probewise.recordings.plan import Instrumentation, Recording
from probewise.recordings.table import csv_text_of_rows
from probewise.scene.shapes import AnyOf, RegularPolygon

PAPER_BITS = 25.0
"""Bits in the paper's count for a circle known to 4 mm: one per reading of the naive model."""

FORMAT = "exploration/1"

WRONG_MM = 12.0
"""Three times the 4 mm of the stopping rule: a larger error counts as wrong."""

_POLYGONS = {3: "triangle", 4: "square", 5: "pentagon", 6: "hexagon", 8: "octagon"}

CLEAN, UNKNOWN = "clean", "unknown"
UNKNOWN_SHARE = 0.5  # stated probability of `UNKNOWN`, from which on a diagnosis calls it so too
_CREDIBLE = 0.95
_NAMED = 0.5
# Effects in the time of one run, which do not belong to the sensor.
_OF_THE_RUN = frozenset({"ambient_step", "offset_drift", "gain_drift"})
_ALIASES = (
    "No reading of the field can show a tilt of the sensor, an offset of the arm or one error of scale along both "
    "axes: each amounts to another shape."
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Step(Judgement, ShowsItself):
    """The result of one reading: a `Judgement` of the posterior after it, and the next pose.

    Attributes
    ----------
    number, reading
        Number of the reading from 1, and the reading.
    names, samples
        Names of the shape's parameters; shapes drawn from the posterior, (n_samples, n_params).
    map, next_pose, stop_reason
        Utility of each possible next reading; the next pose, or None and the reason why the run ends here.
    bits
        Information gained so far: prior minus posterior differential entropy of all parameters. With `trust` below 1,
        the information about the effect left out and its parameters is added, so this exceeds that about the shape.
    posterior
        Weighted posterior of all parameters, with the evidence; the odds of a left-out effect are raised, see
        `kinds.LEFT_OUT_ODDS_FACTOR`.
    sensor
        Posterior mean and sd of the sensor's parameters by name, if they are inferred too.
    by_kind
        The posterior of every kind of hypotheses; the odds of a left-out effect are not raised.
    replayed, pace
        Whether the reading comes from a journal; pace of the run so far.
    checks_sensor
        Whether the stopping rule is met, and the run goes on only to check what the sensor model may leave out.
    """

    number: int
    reading: Reading
    names: tuple[str, ...]
    samples: FloatArray
    map: UtilityMap
    next_pose: Pose | None
    bits: float
    posterior: Weighted
    sensor: Mapping[str, tuple[float, float]]
    by_kind: PosteriorByKind
    stop_reason: str | None
    replayed: bool = False
    pace: Pace = field(default_factory=Pace)
    checks_sensor: bool = False

    @property
    def left_out(self) -> Mapping[str, float]:
        """Probability of each effect that the sensor model may leave out, by name; "" is none."""
        return self.by_kind.left_out

    @property
    def learns_of(self) -> str:
        """What the bits are about, in words: the shape, and the sensor where its model or a left-out effect is open."""
        return "the shape and the sensor" if self.sensor or self.by_kind.doubts_sensor else "the shape"

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
        known = zip(self.names, self.mean, self.sd, strict=True)
        believed = ", ".join(
            f"{name} {_number(name, mean)} ± {_number(name, sd)}" for name, mean, sd in known if np.isfinite(mean)
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
    return f"{reason}; {count_with_noun(n, 'reading')} only checked what the sensor model may leave out"


@dataclass(frozen=True, eq=False)
class Exploration(Reported):
    """A whole run: its configuration and its steps; the true shape and the calibrated sensor, if they are known.

    `concealed` are the effects of the simulated world that the sensor model leaves out, as they were given.
    """

    experiment: Experiment
    steps: tuple[Step, ...]
    hidden: HiddenShape | None = None
    sensor: FittedSensor | None = None
    concealed: str = ""

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
        posterior = self.last.posterior
        if self.arm_error is None:
            return posterior
        theta = posterior.theta.copy()
        theta[:, self.experiment.shape_columns] += self.arm_error.shifts
        return replace(posterior, theta=theta)

    @property
    def sd(self) -> FloatArray:
        """Posterior sds of the shape's parameters, (n_params,), with the arm's own error if that is known."""
        return self.last.sd if self.arm_error is None else np.hypot(self.last.sd, self.arm_error.sd)

    @property
    def stop_reason(self) -> str:
        """Reason why the run ended."""
        return stop_reason_with_checks(self.steps) or "the caller ended it"

    @property
    def target_reached(self) -> bool:
        """Whether the stopping rule is met, arm included, by a hypothesis that explains the readings."""
        trusted = not self.experiment.fit_is_doubtful(self.last.p_value) and not self.last.unexplained
        return trusted and is_target_reached(self.experiment, self.sd, self.last.shapes, self.last.chance_off)

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
        """Warnings on the last step; of a coarse model, whose fit ends no run, that nothing it can be fits."""
        p_value = self.last.p_value
        if self.experiment.doubt_p > 0 or p_value is None or p_value >= Experiment.doubt_p:
            return self.last.notes
        said = f"no hypothesis explains the readings (p = {p_value:.1g}): this coarse model has too small sds"
        return (*self.last.notes, said)

    def recording(self, *, instrumentation: Instrumentation | None = None) -> Recording:
        """Convert the readings to a recording over the pattern "field", with a sensor's `instrumentation`."""
        return recording_of(self.readings, instrumentation=instrumentation)

    def summary(self) -> str:
        """Describe the run in plain text."""
        last, paper = self.last, ""
        if self.target_reached:
            paper = f" (the paper's count: {PAPER_BITS:g} bits, {self.paper_bits_per_reading:.2f} per reading)"
        lines = [
            f"readings     {len(self.steps)}",
            f"stopped      {self.stop_reason}",
            f"information  {last.bits:.1f} bits about {last.learns_of}, {self.bits_per_reading:.2f} per reading{paper}",
            f"log Z        {self.posterior.log_z:.2f} ± {self.posterior.log_z_error:.2f}",
            "fit          not tested: the most probable noise is not the declared one"
            if last.p_value is None
            else f"fit          p = {last.p_value:.2g} (how often a right hypothesis fits no better)",
        ]
        if self.experiment.trust < 1:
            lines.append(f"sensor       {left_out_after_step(last, self.experiment.trust).sentence}")
        if self.concealed:
            lines.append(f"concealed    {self.concealed}")
        if self.hidden is not None:
            lay = ", ".join(f"{name} {_number(name, value)}" for name, value in self.hidden.parameters.items())
            lines.append(f"hidden       {self.hidden.name}: {lay}")
        lines += [f"{label:<12} p = {probability:.3f}" for label, probability in last.shapes.items()]
        width = max(9, *(len(name) for name in (*last.names, *last.sensor)))
        lines += [
            f"{name:<{width}}  {_number(name, mean, more=1)} ± {_number(name, sd, more=1)}"
            for name, mean, sd in zip(last.names, last.mean, self.sd, strict=True)
            if np.isfinite(mean)
        ]
        if self.arm_error is not None:
            known = zip(last.names, last.mean, self.arm_error.sd, strict=True)
            sds = [(name, sd) for name, mean, sd in known if np.isfinite(mean) and name != "shape"]
            own = ", ".join(f"{name} {_number(name, sd, more=1)}" for name, sd in sds)
            lines.append(f"arm          of these sds its own error makes up {own}: the same for all readings")
        lines += [f"{name:<{width}}  {mean:.3g} ± {sd:.2g} (sensor)" for name, (mean, sd) in last.sensor.items()]
        return "\n".join([*lines, *(f"doubtful: {note}" for note in self.notes)])


def _number(name: str, value: float, *, more: int = 0) -> str:
    return f"{value:.{(3 if name.endswith('_rad') else 1) + more}f}"


@dataclass(frozen=True)
class ParameterEstimate:
    """A parameter of the shape: its name, which ends in its unit, and its posterior mean, sd and 95 % interval.

    `arm_sd` is the part of the sd that is due to the arm's own error; None if that error is unknown and not included.
    """

    name: str
    mean: float
    sd: float
    interval95: tuple[float, float]
    arm_sd: float | None = None


@dataclass(frozen=True)
class ShapeEstimate:
    """The most probable shape, its probability, and its parameters given that shape."""

    name: str
    probability: float
    parameters: tuple[ParameterEstimate, ...]


def estimated_shape(run: Exploration) -> ShapeEstimate:
    """Summarise the posterior after the last reading: the most probable shape and its parameters."""
    shape, last = run.experiment.shape, run.last
    theta, weight = run.posterior.theta[:, run.experiment.shape_columns], run.posterior.weight
    name = last.likely_shape or type(shape).__name__.lower()
    if isinstance(shape, RegularPolygon):
        name = _POLYGONS.get(shape.n_sides, f"regular polygon of {shape.n_sides} sides")
    if isinstance(shape, AnyOf):
        of_shape = shape.shape_index(theta) == shape.shape_names.index(name)
        theta, weight = theta[of_shape], weight[of_shape]
    low, high = weighted_quantiles(theta, weight, [0.025, 0.975])
    parameters = tuple(
        ParameterEstimate(
            last.names[k].removeprefix(f"{name}."),
            float(last.mean[k]),
            float(run.sd[k]),
            (float(low[k]), float(high[k])),
            None if run.arm_error is None else float(run.arm_error.sd[k]),
        )
        for k in np.flatnonzero(np.isfinite(last.mean)).tolist()
        if last.names[k] != "shape"
    )
    return ShapeEstimate(name, last.shapes.get(name, 1.0), parameters)


def result_json(run: Exploration) -> str:
    """Return a run's result, with its numbers of readings and seconds, as strict JSON, format "exploration/1"."""
    require_kind("run", run, Exploration, "an Exploration, as probewise.explore returns it")
    document = {
        "format": FORMAT,
        "readings": len(run.steps),
        "stop_reason": run.stop_reason,
        "known": run.target_reached,
        "shape": asdict(estimated_shape(run)),
        "chance_off_12mm": probability_of_length_off(run.experiment, run.posterior, WRONG_MM),
        "left_out": left_out_after_step(run.last, run.experiment.trust).as_json(),
        "notes": list(run.notes),
        "bits": run.last.bits,
        "seconds": run.seconds,
    }
    return json.dumps(document, allow_nan=False, indent=1) + "\n"


def samples_csv(run: Exploration) -> str:
    """Return the weighted posterior samples of the shape as CSV: a column "weight", then one per parameter.

    For a set of shapes, the column "shape" names each sample's shape, and parameters of other shapes are empty.
    """
    require_kind("run", run, Exploration, "an Exploration, as probewise.explore returns it")
    shape, names = run.experiment.shape, run.last.names
    theta, weight = run.posterior.theta[:, run.experiment.shape_columns], run.posterior.weight
    columns = [k for k, name in enumerate(names) if name != "shape"]
    possible, label, labels = np.ones(theta.shape, dtype=np.bool_), [], np.empty((len(theta), 0), dtype=np.str_)
    if isinstance(shape, AnyOf):
        which = shape.shape_index(theta)
        possible = np.array([np.isin(np.arange(theta.shape[1]), own) for own in shape.prior.columns_by_shape])[which]
        label, labels = ["shape"], np.array(shape.shape_names)[which][:, None]
    rows = [
        [
            f"{weight[row]:.7g}",
            *labels[row].tolist(),
            *(f"{theta[row, k]:.7g}" if possible[row, k] else "" for k in columns),
        ]
        for row in np.flatnonzero(weight > 0).tolist()
    ]
    return csv_text_of_rows(["weight", *label, *(names[k] for k in columns)], rows)


@dataclass(frozen=True)
class LeftOutEffects:
    """Probability of each effect that the sensor model may leave out, most probable first ("clean": none); a sentence.

    `raised` holds the same probabilities with the odds of every effect multiplied by 14 (`kinds.LEFT_OUT_ODDS_FACTOR`).
    """

    probability: Mapping[str, float]
    raised: Mapping[str, float]
    sentence: str = ""

    @property
    def leading(self) -> str:
        """Name of the most probable effect, or "clean"."""
        return next(iter(self.probability))

    @property
    def credible_set(self) -> tuple[str, ...]:
        """The most probable names, which together have 95 %, and every other name with 5 % or more in `raised`."""
        together, names = 0.0, []
        for name, p in self.probability.items():
            if together < _CREDIBLE or self.raised[name] >= 1.0 - _CREDIBLE:
                names.append(name)
            together += p
        return tuple(names)

    def as_json(self) -> dict[str, Any]:
        """Return the entry "left_out" of result.json."""
        effects = {name: [] if name == CLEAN else name.split("+") for name in self.probability}
        hypotheses = [{"effects": effects[name], "probability": p} for name, p in self.probability.items()]
        return {"hypotheses": hypotheses, "credible_set": list(self.credible_set), "sentence": self.sentence}


def left_out_after_step(last: Step, trust: float) -> LeftOutEffects:
    """Summarise the probabilities of left-out effects after a step, in a run with this `Experiment.trust`."""
    shares = sorted(((p, name or CLEAN) for name, p in last.left_out.items()), reverse=True)
    raised = {name or CLEAN: p for name, p in last.by_kind.with_raised_left_out_odds().left_out.items()}
    if last.unexplained:  # what leads fails its check: none of the names is more than a part of the answer
        shares = [(UNKNOWN_SHARE, UNKNOWN), *((p * (1.0 - UNKNOWN_SHARE), name) for p, name in shares)]
        raised |= {UNKNOWN: 1.0}
    known = LeftOutEffects({name: p for p, name in shares}, raised)
    if trust == 1:
        return replace(known, sentence="The sensor model was taken for complete, as it was told to be.")
    name = known.leading
    p = known.probability[name]
    others = [spoken_name(other) for other in known.credible_set[1:] if other != CLEAN]
    aliases = _ALIASES if "sensor_tilt" not in last.left_out else ""
    beside = f" Not excluded: {', '.join(others)}." if others else ""
    if name == UNKNOWN:
        said = f"No effect that is known here explains the readings: what is left of them {last.unexplained}."
    elif name == CLEAN:
        said = f"The sensor model leaves nothing out that shows (probability {p:.3g})."
    elif p < _NAMED:
        said = f"Something may be left out, most probably {spoken_name(name)} (probability {p:.3g})."
    else:
        said = f"The sensor model leaves something out: {_effect_sentence(last, name)} (probability {p:.3g})."
    return replace(known, sentence=f"{said}{beside} {aliases}".strip())


def _best_kind_with(last: Step, name: str) -> tuple[HypothesisKind, Weighted]:
    kinds = [k for k, kind in enumerate(last.by_kind.kinds) if kind.left_out == name]
    best = max(kinds, key=lambda k: last.by_kind.log_odds[k])
    return last.by_kind.kinds[best], last.by_kind.particles[best].weighted


def _effect_sentence(last: Step, name: str) -> str:
    """Describe an effect, with its numbers if it has any."""
    kind, samples = _best_kind_with(last, name)
    if kind.effect is None:
        return spoken_name(name)
    of_effect = slice(-len(kind.effect.prior.names), None)
    mean, sd = (last.pace.in_seconds(kind.effect, moment[of_effect]) for moment in (samples.mean(), samples.sd()))
    # A change is said by the clock of the readings, while paced time begins at the first of them.
    is_a_time = np.array([parameter == "at_s" for parameter in kind.effect.prior.names])
    return kind.effect.sentence(mean + last.pace.start_s * is_a_time, sd)


def repaired_sensor(sensor: FittedSensor, last: Step, *, rng: np.random.Generator) -> FittedSensor:
    """Return the sensor with the effect that a run found, with samples of its parameters after step `last`.

    If no effect has a probability of one half or more, the sensor is returned as it is. A noise effect, an effect in
    the time of the run, or an effect that the sensor has already, is only mentioned in a note. Where a diagnosis left
    it open whether the sensor has this effect, the run's answer counts: of the combinations of effects, the most
    probable one is kept, with the effect.
    """
    name, p = max(last.left_out.items(), key=lambda item: item[1])
    if not name or p < _NAMED:
        return sensor
    kind, samples = _best_kind_with(last, name)
    effect, dark, bright = kind.effect, *(sensor.names.index(level) for level in ("I_min", "I_max"))
    note = f"a run that explored with it found {spoken_name(name)} (probability {p:.3g})"
    if name in sensor.absent and effect is not None and name not in _OF_THE_RUN:
        sensor = sensor.with_leading_effects()  # the run's own model, which did not hold it
    if effect is not None and name in {form.name for form in LEVELS_CHANGED}:  # the levels themselves have changed
        drawn, names = samples.samples(len(sensor.samples), rng=rng), effect.prior.names
        change = dict(zip(names, drawn[:, -len(names) :].T, strict=True))
        own = sensor.samples.copy()
        own[:, bright] += change.get("frac", 0.0) * (own[:, bright] - own[:, dark])
        own[:, [dark, bright]] += np.reshape(change.get("offset", 0.0), (-1, 1))
        return replace(sensor, samples=own, notes=(*sensor.notes, f"{note}, which its levels now include"))
    if effect is None or name in _OF_THE_RUN or name in sensor.effects:
        return replace(sensor, notes=(*sensor.notes, f"{note}, which the model does not hold"))
    # What the sensor knew keeps its origins; the effect that was found has none, since a run's model counts from 0.
    n_own, n = len(effect.prior.names), len(sensor.samples)
    own = last.pace.in_seconds(effect, samples.samples(n, rng=rng)[:, -n_own:])
    parameters = effect.prior.names
    if name == "position_scale" and len(parameters) == 1:  # the vocabulary's effect has the other axis too
        own, parameters = own * np.array([parameters == (axis,) for axis in "xy"]), ("x", "y")
    return replace(
        sensor,
        names=(*sensor.names, *(f"{name}.{parameter}" for parameter in parameters)),
        samples=np.concatenate([sensor.samples, own], axis=1),
        effects=(*sensor.effects, name),
        forms={**sensor.forms, **({name: form} if (form := effect.binding.form) else {})},
        notes=(*sensor.notes, note),
    )
