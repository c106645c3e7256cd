"""Summaries of a posterior: mean and sd, goodness of fit, stopping rule."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtrc

from probewise._arrays import FloatArray
from probewise.arm.instrument import Reading
from probewise.experiment.configuration import Experiment, largest_sd_mm
from probewise.inference.problem import SensorProblem
from probewise.inference.rounded import ScaleEnds
from probewise.inquiry import UtilityMap
from probewise.nested import Weighted
from probewise.scene.any_of import AnyOf

OFF_SDS = 3.0
"""Error, in units of the stopping rule's sd, above which a length counts as wrong: 12 mm for 4 mm."""


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
    own = theta[np.ix_(which == likely, columns)]
    given = weight[which == likely] / share[likely]
    mean, sd = np.full((2, theta.shape[1]), np.nan)
    mean[columns] = given @ own
    sd[columns] = np.sqrt(given @ (own - mean[columns]) ** 2)
    return mean, sd, dict(zip(experiment.shape.shape_names, (float(p) for p in share / share.sum()), strict=True))


def probability_of_length_off(experiment: Experiment, posterior: Weighted, off_mm: float) -> float:
    """Return the probability that some length differs by more than `off_mm` from its posterior mean.

    For a set of shapes: from the mean given the most probable shape, and other shapes count as wrong.
    """
    theta, weight = posterior.theta[:, experiment.shape_columns], posterior.weight
    mean, _, _ = shape_moments_and_probabilities(experiment, posterior)
    lengths = [
        k for k, name in enumerate(experiment.shape.prior.names) if name.endswith("_mm") and np.isfinite(mean[k])
    ]
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


def doubt_message(p_value: float, worst: int, readings: Sequence[Reading]) -> str:
    """Return the message that no hypothesis explains the readings; it shows the reading predicted worst, `worst`."""
    return (
        f"no hypothesis explains the readings: the best has p = {p_value:.1g} and is worst at reading {worst + 1} "
        f"({readings[worst].value:g}); the hypothesis space excludes what lies there, or the sensor model "
        "leaves something out"
    )


def stop_reason(
    experiment: Experiment,
    sd: FloatArray,
    known: bool,
    p_value: float | None,
    utilities: UtilityMap,
    n_readings: int,
    max_readings: int | None,
    arm_sd: FloatArray | None = None,
    n_missing: int = 0,
) -> str | None:
    """Return the reason why a run ends, or None if it continues.

    `p_value` is that of the best hypothesis, None if it was not tested. `arm_sd` is the part of the shape's sds that
    comes from the arm, (n_params,), which no reading lowers; `sd` is that of the readings alone. `n_missing`: missing
    readings in a row, if they are too many, else 0.
    """
    names = experiment.shape.prior.names
    included = "" if arm_sd is None else ", the arm's own error included"
    widest = largest_sd_mm(names, sd if arm_sd is None else np.hypot(sd, arm_sd))
    if known and p_value is not None and experiment.fit_is_doubtful(p_value):
        return (
            f"no hypothesis explains the readings (p = {p_value:.1g}), so the posterior, narrow as it is "
            f"({widest:.1f} mm), is not to be trusted; a diagnosis of the readings asks what the model leaves out"
        )
    if known:
        return f"every length is known to better than {experiment.stop_sd_mm:g} mm{included}"
    if arm_sd is not None and largest_sd_mm(names, arm_sd) >= experiment.stop_sd_mm > largest_sd_mm(names, sd):
        return (
            f"the readings know every length to better than {experiment.stop_sd_mm:g} mm, but the arm's own error "
            f"leaves {largest_sd_mm(names, arm_sd):.1f} mm, which no reading lowers: `probewise arm fit-geometry` "
            "does, with more marks or with marks met more closely"
        )
    if n_missing:
        return (
            f"the last {n_missing} readings are all missing: does the instrument still return values, and can it read "
            f"there? The widest length is known to {widest:.1f} mm{included}; a journal can be resumed"
        )
    if utilities.is_flat:
        promise = (
            "every reading within reach promises the same"
            if np.count_nonzero(utilities.reachable) > 1
            else "the only reading within reach promises nothing more"
        )
        return (
            f"{promise}, {utilities.highest_utility:.2g}: none would tell the hypotheses apart that are left; "
            f"the widest length is known to {widest:.1f} mm{included}"
        )
    if max_readings is not None and n_readings >= max_readings:
        return (
            f"all {max_readings} readings that it may take are taken; the widest length is known to {widest:.1f} mm"
            f"{included}"
        )
    return None
