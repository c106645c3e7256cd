"""Judgement of a posterior: moments, goodness of fit, and the stopping rule of a run (`is_target_reached`)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, ndtr, ndtri

from probewise._arrays import FloatArray
from probewise.arm.carry_out import PATTERN
from probewise.arm.instrument import Reading
from probewise.experiment.arm_error import ArmError, arm_error_in_posterior
from probewise.experiment.kinds import PosteriorByKind
from probewise.experiment.setup import Experiment
from probewise.inference.problem import SensorProblem
from probewise.inference.rounded import ScaleEnds
from probewise.inquiry import UtilityMap, prior_entropy
from probewise.inquiry.readout import capacity_bits, entropy_bits
from probewise.nested import Weighted
from probewise.scene.shapes import AnyOf, mean_angles, with_angles_near

WRONG_SDS = 3.0
"""Error, in units of the stopping rule's sd, above which a length counts as wrong: 12 mm for 4 mm."""

MOST_PROBABILITY_WRONG = 0.01
"""Probability of a wrong length below which a run with doubt in its sensor may end."""

MOST_MISSING = 8
"""Missing readings (NaN) in a row after which a run ends."""

_TREND_P = 1e-3  # p-value of the residuals' strongest trend, every look counted, below which no kind is believed
_FEWEST_FOR_TREND = 12  # readings
_WHOLE = 1.0 - 1e-12  # a correlation beyond which rounding rules
_N_OF_PRIOR = 20_000
_ON_SHAPE = 5.0  # noise sds from the background at which a reading counts as on the shape


@dataclass(frozen=True, eq=False)
class Judgement:
    """What a posterior says of the shape, and whether it explains the readings."""

    # Of the shape's parameters, (n_params,). For a set of shapes: given the most probable shape, with NaN for
    # parameters of other shapes.
    mean: FloatArray
    sd: FloatArray
    shapes: Mapping[str, float]  # probability of each shape of a set, by its name (empty for a single shape)
    target_reached: bool  # whether the stopping rule is met (`is_target_reached`), with the arm's error
    chance_off: float  # probability that a length is off by three times the sd of the stopping rule
    # p-value of the best hypothesis: upper tail of chi-square with one degree of freedom per reading (conservative).
    # None where the most probable noise is not the declared one, of which this test is.
    p_value: float | None
    notes: tuple[str, ...]  # warnings
    unexplained: str = ""  # the trend of the best hypothesis's residuals, in words; "" if they show none
    arm_error: ArmError | None = None  # None far from the end of a run, or if the arm's own error is not known


def judge(
    experiment: Experiment,
    by_kind: PosteriorByKind,
    posterior: Weighted,
    readings: Sequence[Reading],
    *,
    rng: np.random.Generator,
) -> Judgement:
    """Judge a posterior, the arm's error included if the readings alone know the lengths.

    `by_kind` and `posterior` are as `infer` returns them; `rng` draws the arm's errors.
    """
    mean, sd, shapes = shape_moments_and_probabilities(experiment, posterior)
    p_value, notes = None, () if posterior.run is None else posterior.run.warnings
    likely = by_kind.most_probable_kind_index
    leader, samples = by_kind.kinds[likely], by_kind.particles[likely]
    problem = leader.problem(experiment.problem(readings).recording)
    unexplained = "" if experiment.trust == 1 else trend_of_residuals(samples.weighted, problem)
    if unexplained:
        notes = (*notes, f"no hypothesis explains the readings: what the best leaves of them {unexplained}")
    if leader.likelihood is experiment.likelihood:  # chi-square is of this noise
        p_value, worst = p_value_and_worst_reading(experiment, samples.weighted, problem)
        if experiment.fit_is_doubtful(p_value):
            notes = (
                *notes,
                f"no hypothesis explains the readings: the best has p = {p_value:.1g} and is worst at reading "
                f"{worst + 1} ({readings[worst].value:g}); the hypothesis space excludes what lies there, or the "
                "sensor model leaves something out",
            )
    target_reached, off = target_reached_and_chance_off(experiment, posterior)
    judged = Judgement(mean, sd, shapes, target_reached, off, p_value, notes, unexplained)
    if largest_sd_mm(experiment.shape.prior.names, sd) < experiment.stop_sd_mm:
        return with_arm_error(judged, experiment, by_kind, posterior, readings, rng=rng)
    return judged


def with_arm_error(
    judged: Judgement,
    experiment: Experiment,
    by_kind: PosteriorByKind,
    posterior: Weighted,
    readings: Sequence[Reading],
    *,
    rng: np.random.Generator,
) -> Judgement:
    """Return the judgement with the arm's error included, as it is if that is not known; parameters as for `judge`."""
    likely = max(judged.shapes, key=judged.shapes.__getitem__, default="")
    arm = arm_error_in_posterior(
        experiment,
        readings,
        posterior.theta[:, experiment.shape_columns],
        by_kind.with_raised_left_out_odds(),
        mean=judged.mean,
        sd=judged.sd,
        likely_shape=likely,
        rng=rng,
    )
    if arm is None:
        return judged
    theta = posterior.theta.copy()
    theta[:, experiment.shape_columns] += arm.shifts
    target_reached, off = target_reached_and_chance_off(experiment, posterior, theta=theta, arm_sd=arm.sd)
    return replace(judged, target_reached=target_reached, chance_off=off, arm_error=arm)


def target_reached_and_chance_off(
    experiment: Experiment, posterior: Weighted, *, theta: FloatArray | None = None, arm_sd: FloatArray | float = 0.0
) -> tuple[bool, float]:
    """Return whether a posterior meets the stopping rule, and its `probability_of_length_off`.

    With an arm's error, `theta` are the samples with it, and `arm_sd` its sds, (n_params,).
    """
    _, sd, shapes = shape_moments_and_probabilities(experiment, posterior)
    shifted = posterior if theta is None else replace(posterior, theta=theta)
    off = probability_of_length_off(experiment, shifted, WRONG_SDS * experiment.stop_sd_mm)
    return is_target_reached(experiment, np.hypot(sd, arm_sd), shapes, off), off


def is_target_reached(
    experiment: Experiment, sd: FloatArray, shapes: Mapping[str, float], chance_off: float = 0.0
) -> bool:
    """Return whether the stopping rule is met: the shape is known to the target sd.

    `sd` and `shapes` are posterior sds of the shape's parameters and the shapes' probabilities, `chance_off` the
    probability that a length is off by three times the target sd. With `trust` below 1, that must be below 1 %, since
    the posterior then has tails that sds do not show.
    """
    likely = max(shapes.values(), default=1.0) >= experiment.stop_probability
    sure = experiment.trust == 1 or chance_off < MOST_PROBABILITY_WRONG
    return largest_sd_mm(experiment.shape.prior.names, sd) < experiment.stop_sd_mm and likely and sure


def largest_sd_mm(names: tuple[str, ...], sd: FloatArray) -> float:
    """Return the largest sd among the parameters whose names end in _mm; NaN is ignored."""
    return float(np.nanmax([value for name, value in zip(names, sd, strict=True) if name.endswith("_mm")]))


def with_aligned_angles(experiment: Experiment, posterior: Weighted) -> Weighted:
    """Return the posterior of the same shapes with angles brought near their circular mean, and sides swapped to match.

    An angle may then lie outside its prior's range.
    """
    theta = theta_with_aligned_angles(experiment, posterior.theta, posterior.weight)
    return posterior if theta is posterior.theta else replace(posterior, theta=theta)


def theta_with_aligned_angles(experiment: Experiment, theta: FloatArray, weight: FloatArray) -> FloatArray:
    """Return samples, (n_samples, n_params), aligned as by `with_aligned_angles`; `weight` (n_samples,)."""
    of_shape = theta[:, experiment.shape_columns]
    aligned = with_angles_near(experiment.shape, of_shape, mean_angles(experiment.shape, of_shape, weight))
    if aligned is of_shape:
        return theta
    out = theta.copy()
    out[:, experiment.shape_columns] = aligned
    return out


def information_nats(posterior: Weighted) -> float:
    """Return the relative entropy of posterior to prior, nats: mean log likelihood minus log evidence."""
    some = posterior.weight > 0  # excluded samples have a log likelihood of minus infinity
    return float(posterior.weight[some] @ posterior.log_likelihood[some]) - posterior.log_z


def shape_moments_and_probabilities(
    experiment: Experiment, posterior: Weighted
) -> tuple[FloatArray, FloatArray, dict[str, float]]:
    """Return mean and sd of the shape's parameters, (n_params,) each, and the probability of each shape by name.

    Angles are taken as they are, see `with_aligned_angles`. For a set of shapes, mean and sd are those given the most
    probable shape, with NaN for parameters of other shapes. For a single shape the probabilities are empty.
    """
    theta, weight = posterior.theta[:, experiment.shape_columns], posterior.weight
    if not isinstance(experiment.shape, AnyOf):
        mean = weight @ theta
        return mean, np.sqrt(weight @ (theta - mean) ** 2), {}
    which = experiment.shape.shape_index(theta)
    share = np.bincount(which, weights=weight, minlength=len(experiment.shape.shape_names))
    likely = int(share.argmax())
    columns = experiment.shape.prior.columns_by_shape[likely]
    of_likely = theta[np.ix_(which == likely, columns)]
    given = weight[which == likely] / share[likely]
    mean, sd = np.full((2, theta.shape[1]), np.nan)
    mean[columns] = given @ of_likely
    sd[columns] = np.sqrt(given @ (of_likely - mean[columns]) ** 2)
    return mean, sd, dict(zip(experiment.shape.shape_names, (float(p) for p in share / share.sum()), strict=True))


def probability_of_length_off(experiment: Experiment, posterior: Weighted, off_mm: float) -> float:
    """Return the probability that some length differs by more than `off_mm` from its posterior mean.

    For a set of shapes: from the mean given the most probable shape, and other shapes count as wrong.
    """
    theta, weight = posterior.theta[:, experiment.shape_columns], posterior.weight
    mean, _, _ = shape_moments_and_probabilities(experiment, posterior)
    names = experiment.shape.prior.names
    lengths = [k for k, name in enumerate(names) if name.endswith("_mm") and np.isfinite(mean[k])]
    off = (np.abs(theta[:, lengths] - mean[lengths]) > off_mm).any(axis=1)
    if isinstance(experiment.shape, AnyOf):
        which = experiment.shape.shape_index(theta)
        off |= which != np.bincount(which, weights=weight).argmax()
    return float(weight[off].sum() / weight.sum())


def sensor_moments(experiment: Experiment, posterior: Weighted) -> dict[str, tuple[float, float]]:
    """Return posterior mean and sd of the sensor's parameters by name; empty if the sensor is known."""
    n_sensor = int(experiment.shape_columns[0])
    mean, sd = posterior.mean(), posterior.sd()
    return {name: (float(mean[k]), float(sd[k])) for k, name in enumerate(experiment.names[:n_sensor])}


def p_value_and_worst_reading(experiment: Experiment, posterior: Weighted, problem: SensorProblem) -> tuple[float, int]:
    """Return the p-value of the most likely hypothesis, and the index of the reading that it predicts worst.

    The p-value is the upper tail of chi-square with one degree of freedom per reading, so that it is conservative. A
    reading at an end of the scale fits every prediction beyond.
    """
    recording = problem.recording
    best = posterior.theta[[int(posterior.log_likelihood.argmax())]]
    sd = np.hypot(experiment.noise_sd, (experiment.step or 0.0) / np.sqrt(12.0))
    z = (recording.readings - problem.model.predict(best, recording.plan)[0]) / sd
    # A reading at an end of the scale stands for every value beyond.
    ends = ScaleEnds.from_range(
        *experiment.reading_range, experiment.step or experiment.noise_sd, whole_steps=experiment.step is not None
    )
    z = np.where(ends.highest_reading_mask(recording.readings), np.maximum(z, 0.0), z)
    z = np.where(ends.lowest_reading_mask(recording.readings), np.minimum(z, 0.0), z)
    z = np.where(recording.usable, z, 0.0)
    return float(chdtrc(max(int(recording.usable.sum()), 1), float(z @ z))), int(np.argmax(np.abs(z)))


def trend_of_residuals(posterior: Weighted, problem: SensorProblem) -> str:
    """Say with what the residuals of the most likely hypothesis change, such as "the time"; "" if with nothing.

    Their normal scores, which any law of the noise leaves normal, are correlated with each, whatever the noise.
    """
    plan, usable = problem.recording.plan, problem.recording.usable
    if (n := int(usable.sum())) < _FEWEST_FOR_TREND:
        return ""
    best = posterior.theta[[int(posterior.log_likelihood.argmax())]]
    left = (problem.recording.readings - problem.model.predict(best, plan)[0])[usable]
    scores = ndtri((mean_ranks(left) - 0.5) / n)
    way = np.hypot(np.diff(plan.x_mm, prepend=plan.x_mm[0]), np.diff(plan.y_mm, prepend=plan.y_mm[0]))
    along = {"the place along X": plan.x_mm, "the place along Y": plan.y_mm, "the time": plan.time_s, "the way": way}
    along |= {f"the direction along {name}": plan.direction_of_motion[:, k] for k, name in enumerate("XY")}
    trends = {}
    for name, column in along.items():
        rank = mean_ranks(column[usable])
        if np.ptp(rank) > 0 and np.ptp(scores) > 0:
            size = min(abs(float(np.corrcoef(rank, scores)[0, 1])), _WHOLE)
            trends[name] = math.atanh(size) * math.sqrt(n - 3)  # Fisher (1915): normal, of sd 1
    name = max(trends, key=trends.__getitem__, default="")
    return f"changes with {name}" if name and len(trends) * 2 * ndtr(-trends[name]) < _TREND_P else ""


def mean_ranks(values: FloatArray) -> FloatArray:
    """Rank values, (n,), from 1; equal ones share their mean rank. SciPy's function takes half a second to import."""
    _, which, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - 0.5 * (counts - 1))[which])


def n_missing_at_end(readings: Sequence[Reading]) -> int:
    """Count the missing readings since the last value."""
    return sum(1 for _ in itertools.takewhile(lambda reading: math.isnan(reading.value), reversed(readings)))


def stop_reason(
    experiment: Experiment,
    judged: Judgement,
    utilities: UtilityMap,
    *,
    must_continue: bool,
    n_readings: int,
    max_readings: int | None,
    n_missing: int,
) -> str | None:
    """Return the reason why a run ends, or None if it continues.

    `must_continue`: whether it goes on for a check though the target is reached. `n_missing`: missing readings in a
    row, if they are too many, else 0.
    """
    names = experiment.shape.prior.names
    reached = judged.target_reached and not must_continue and not judged.unexplained
    included, of_arm, sd = "", 0.0, judged.sd
    if judged.arm_error is not None:
        included, of_arm = ", the arm's own error included", largest_sd_mm(names, judged.arm_error.sd)
        sd = np.hypot(sd, judged.arm_error.sd)
    widest = largest_sd_mm(names, sd)
    widest_known = f"the widest length is known to {widest:.1f} mm{included}"
    if reached and experiment.fit_is_doubtful(judged.p_value):
        return (
            f"no hypothesis explains the readings (p = {judged.p_value:.1g}), so the posterior, narrow as it is "
            f"({widest:.1f} mm), is not to be trusted; a diagnosis of the readings asks what the model leaves out"
        )
    if reached:
        return f"every length is known to better than {experiment.stop_sd_mm:g} mm{included}"
    if of_arm >= experiment.stop_sd_mm > largest_sd_mm(names, judged.sd):
        return (
            f"the readings know every length to better than {experiment.stop_sd_mm:g} mm, but the arm's own error "
            f"leaves {of_arm:.1f} mm, which no reading lowers: `probewise arm fit-geometry` "
            "does, with more marks or with marks met more closely"
        )
    if n_missing:
        return (
            f"the last {n_missing} readings are all missing: does the instrument still return values, and can it read "
            f"there? T{widest_known[1:]}; a journal can be resumed"
        )
    if utilities.is_flat:
        promise = "the only reading within reach promises nothing more"
        if np.count_nonzero(utilities.reachable) > 1:
            promise = "every reading within reach promises the same"
        none = f"{utilities.highest_utility:.2g}: none would tell the hypotheses apart that are left"
        return f"{promise}, {none}; {widest_known}"
    if max_readings is not None and n_readings >= max_readings:
        return f"all {max_readings} readings that it may take are taken; {widest_known}"
    return None


@dataclass(frozen=True)
class ReadingsLowerBound:
    """Lower bound on the mean number of readings, for search and refinement separately."""

    search_bits: float  # needed until the first reading on the shape
    refinement_bits: float  # needed from there to the target
    # Capacity of one reading: before the shape is found, that of a yes or no with the largest possible probability of
    # yes; afterwards, that of the sensor.
    search_capacity_bits: float
    capacity_bits: float


def least_readings(experiment: Experiment, *, rng: np.random.Generator) -> ReadingsLowerBound:
    """Return a lower bound on the mean number of readings: bits needed over bits per reading, search plus refinement.

    The search ends with the first reading on the shape. Any reading before is on the shape with probability p at most,
    that of the best first place, and so carries at most the information of a yes or no with probability p; a yes leaves
    a share p of all hypotheses. From there to the target sd, a reading carries at most the sensor's capacity. The
    experiment has one shape and a known sensor.
    """
    prior = experiment.prior
    theta = prior.from_unit_cube(rng.random((_N_OF_PRIOR, len(prior.names))))
    weight = np.full(_N_OF_PRIOR, 1.0 / _N_OF_PRIOR)
    designs = experiment.designs
    plan = replace(designs.plan(PATTERN), instrumentation=experiment.instrumentation)
    predictive = experiment.forecast.predictive(
        theta, weight, designs, plan, np.arange(experiment.grid.n_places), experiment.noise_sd
    )
    _, mass = next(predictive.level_weights(weight))
    levels = predictive.levels
    beside = levels[int(mass.sum(axis=0).argmax())]
    covered = float(mass[:, np.abs(levels - beside) > _ON_SHAPE * experiment.noise_sd].sum(axis=1).max())
    prior_bits = prior_entropy(prior, rng=rng)
    yes = min(covered, 0.5)
    # The largest entropy of parameters with the target's sd is that of independent Gaussians.
    target_bits = len(prior.names) * 0.5 * math.log2(2 * math.pi * math.e * experiment.stop_sd_mm**2)
    return ReadingsLowerBound(
        -math.log2(covered),
        prior_bits + math.log2(covered) - target_bits,
        float(entropy_bits(np.array([yes, 1.0 - yes]))),
        capacity_bits(float(levels[0]), float(levels[-1]), experiment.readout),
    )
