"""Effect of an error in the arm's geometry on the posterior of the shape.

A geometry fitted to marks has one error that all readings of a run share: the sensor stood elsewhere than commanded. No
reading of the run shows that error, which moves the whole shape. To first order, for any likelihood, the posterior mean
of the shape's parameters moves by their posterior covariance with the log likelihood's slope by the error. So the
samples at the end of a run suffice, without another inference.

The log likelihood's slopes by the shape's parameters serve as control variates: their covariance with the parameters is
known, minus the identity matrix (Stein), so that the samples only estimate the rest, 0 for a quadratic log likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import FloatArray
from probewise.arm.geometry import FITTED, place_jacobian
from probewise.arm.instrument import Reading
from probewise.errors import require
from probewise.experiment.kinds import HypothesisKind, PosteriorByKind
from probewise.experiment.setup import Experiment
from probewise.inference.problem import checked_log_prob
from probewise.recordings.plan import Recording
from probewise.scene.shapes import AnyOf, shape_and_columns, with_angles_near

_STEP_SD = 0.25  # of each independent error and of the shape's parameters, either way, over which slopes are taken
_STEP_MM, _STEP_RAD = 0.05, 1e-3  # over which those of the prediction are
_LEAST = 1e-3  # probability from which on a kind of hypotheses counts


@dataclass(frozen=True, eq=False)
class ArmError:
    """Effect of an error in the arm's geometry, common to all readings, on the posterior of the shape."""

    slopes: FloatArray  # shift of the posterior mean by each independent error of one sd, (n_params, n_errors)
    shifts: FloatArray  # of each posterior sample by an error drawn for it, (n_samples, n_params); 0 for another shape

    @property
    def sd(self) -> FloatArray:
        """Sd of the shape's parameters that comes from the arm, (n_params,)."""
        return np.asarray(np.sqrt((self.slopes**2).sum(axis=1)))


def arm_error_in_posterior(
    experiment: Experiment,
    readings: Sequence[Reading],
    theta: FloatArray,
    by_kind: PosteriorByKind,
    *,
    mean: FloatArray,
    sd: FloatArray,
    likely_shape: str,
    rng: np.random.Generator,
) -> ArmError | None:
    """Compute by how much the error of the arm's geometry moves and widens the posterior of the shape; None: not known.

    `theta` (n_samples, n_params) are samples of the shape given the readings, `by_kind` is the same posterior by kind;
    `mean`, `sd` (n_params,) and `likely_shape` are as in `Step`. ParameterError if the arm does not reach a reading.
    """
    arm = experiment.fitted_arm
    if arm is None:
        return None
    geometry, accuracy = arm.geometry, arm.geometry.accuracy
    assert accuracy is not None
    recording = experiment.problem(readings).recording
    places = np.stack([recording.plan.x_mm, recording.plan.y_mm], axis=-1)
    covariance = np.array(accuracy.covariance)
    scale = np.sqrt(np.diagonal(covariance))
    scale = np.where(scale > 0, scale, 1.0)  # radians and mm: the numbers differ by orders of magnitude
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    root = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    # Changes of x, y, height and orientation at each place by each independent error of one sd.
    place = place_jacobian(geometry, np.concatenate([places, [arm.calibration_place_mm]])) @ root
    require(np.isfinite(place).all(), "readings", "a place out of the arm's reach", "readings of this arm")
    turned = np.broadcast_to(root[FITTED.index("base home")], place[:, :1].shape)
    off = np.concatenate([place, turned], axis=1)
    off[:, 2] -= off[-1, 2]
    off = off[:-1]
    dark, white = arm.levels
    falls = 2.0 / geometry.read_height_mm
    if geometry.light_per_mm is not None:
        falls = geometry.light_per_mm * white / (white - dark)
    # From here on what the light does stands for the height: the share by which light above black rises.
    off[:, 2] *= -falls
    slopes = _posterior_mean_shifts(
        experiment, by_kind, recording, off, dark, mean=mean, sd=sd, likely_shape=likely_shape
    )
    shifts = rng.standard_normal((len(theta), slopes.shape[1])) @ slopes.T
    if isinstance(experiment.shape, AnyOf):
        shifts[experiment.shape.shape_index(theta) != experiment.shape.shape_names.index(likely_shape)] = 0.0
    return ArmError(slopes, shifts)


def _posterior_mean_shifts(
    experiment: Experiment,
    by_kind: PosteriorByKind,
    recording: Recording,
    off: FloatArray,
    dark: float,
    *,
    mean: FloatArray,
    sd: FloatArray,
    likely_shape: str,
) -> FloatArray:
    """Return the shift of the likely shape's posterior mean by each error of one sd, (n_params, n_errors)."""
    n_sensor = int(experiment.shape_columns[0])
    likely, columns = shape_and_columns(experiment.shape, likely_shape)
    of_shape = np.arange(n_sensor, n_sensor + len(columns))
    thetas, weights, by_error, by_shape = [], [], [], []
    for kind, particles, probability in zip(by_kind.kinds, by_kind.particles, by_kind.probability, strict=True):
        if probability < _LEAST or kind.shape not in ("", likely_shape):
            continue
        some = particles.weighted.weight > 0
        theta = particles.weighted.theta[some].copy()
        theta[:, of_shape] = with_angles_near(likely, theta[:, of_shape], mean[columns])
        thetas.append(theta[:, of_shape])
        weights.append(probability * particles.weighted.weight[some])
        by_error.append(_log_likelihood_slopes_by_error(kind, theta, recording, off, dark))
        problem, of_kind = kind.problem(recording), []
        for column, step in zip(of_shape.tolist(), (_STEP_SD * sd[columns]).tolist(), strict=True):
            up, down = theta.copy(), theta.copy()
            up[:, column] += step
            down[:, column] -= step
            of_kind.append((problem.log_likelihood(up) - problem.log_likelihood(down)) / (2 * step))
        by_shape.append(np.stack(of_kind, axis=-1))
    weight = np.concatenate(weights)
    weight /= weight.sum()
    theta, slope, known = (each - weight @ each for each in map(np.concatenate, (thetas, by_error, by_shape)))
    root = np.sqrt(weight)[:, None]
    coefficients = np.linalg.lstsq(root * known, root * slope, rcond=None)[0]
    out = np.zeros((len(mean), off.shape[2]))
    out[columns] = (theta * weight[:, None]).T @ (slope - known @ coefficients) - coefficients
    return out


def _log_likelihood_slopes_by_error(
    kind: HypothesisKind, theta: FloatArray, recording: Recording, off: FloatArray, dark: float
) -> FloatArray:
    """Return each hypothesis's slope of log likelihood by each independent error, per sd, (n_samples, n_errors).

    `off` (n_points, 4, n_errors) are changes by each error of one sd: of x, y, light above black (share), orientation.
    """
    plan, usable = recording.plan, recording.usable
    predicted = kind.model.predict(theta, plan)

    def prediction_slope_by(name: str, step: float) -> FloatArray:
        """Return the slope of the predictions by the plan's column `name`, (n_samples, n_points)."""
        ends = [kind.model.predict(theta, replace(plan, **{name: getattr(plan, name) + way * step})) for way in (1, -1)]
        return np.asarray((ends[0] - ends[1]) / (2 * step))

    of_place = [prediction_slope_by(name, _STEP_MM) for name in ("x_mm", "y_mm")]
    by_pose = np.stack([*of_place, predicted - dark, prediction_slope_by("orientation_rad", _STEP_RAD)], axis=-1)
    out = np.empty((len(theta), off.shape[2]))
    for error in range(off.shape[2]):
        change = _STEP_SD * np.einsum("skp,kp->sk", by_pose, off[:, :, error])
        ends = (predicted[:, usable] + way * change[:, usable] for way in (1, -1))
        up, down = (checked_log_prob(kind.likelihood, recording.readings[usable], end) for end in ends)
        out[:, error] = (up - down) / (2 * _STEP_SD)
    return out
