"""Null models, a model of effects added to one, and its fit: bounded Levenberg-Marquardt, vectorised."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from scipy.special import ndtr, ndtri

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.diagnosis.noise import LEAST_SCALE, NoiseLaw
from probewise.effects import Effect
from probewise.priors import SharedScalePrior
from probewise.recordings.plan import Plan, Recording
from probewise.sensor import FAST_NODES, AnyEffect
from probewise.sensor.stages import effects_with_columns

FARTHEST = 6.0  # bound of every coordinate: six standard deviations of its prior


class Predictor(Protocol):
    """A model with its effects: a sensor's chain, or a user's own simulator.

    Columns of theta are named by `names`: the model's own, then each effect's in the order of `effects`.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, one per column of theta."""

    @property
    def effects(self) -> tuple[AnyEffect, ...]:
        """The model's effects, in the order in which they act."""

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Return noise-free readings, theta (n_samples, n_params) -> (n_samples, n_points)."""

    def simulated_view(self, theta: FloatArray, plan: Plan) -> Any:
        """Simulate the stages before `Stage.SEEN`: a sensor's view of the scene, for theta (1 or n_samples, n_params).

        For a simulator, these are its own readings, with the effects on inputs, parameters and rates.
        """

    def readings_from_simulated_view(self, view: Any, theta: FloatArray, plan: Plan) -> FloatArray:
        """Apply the effects from `Stage.SEEN` on to a result of `simulated_view`: readings (n_samples, n_points)."""


class Null(Protocol):
    """A model to be diagnosed, in coordinates in which its prior is a standard normal.

    A sensor over known patterns (`CalibratedSensor`) or over an unknown shape (`SensorAndShape`), or a simulator of a
    table (`systems.System`).
    """

    @property
    def n_params(self) -> int:
        """Number of coordinates."""

    @property
    def n_gaussians(self) -> int:
        """Number of Gaussians of its SSF; by default 0, for no SSF."""
        return 0

    @property
    def effective_n_gaussians(self) -> int:
        """Number of Gaussians that its SSF counts as, the measure of its complexity; by default 0."""
        return 0

    @property
    def ssf_in_words(self) -> str:
        """Description of its SSF, in words; by default empty."""
        return ""

    @property
    def has_exchangeable_gaussians(self) -> bool:
        """Whether permuting the Gaussians of its SSF changes neither prior nor predictions; by default False."""
        return False

    @property
    def predicts_in_bulk(self) -> bool:
        """Whether predictions of many samples cost little more than one; by default False."""
        return False

    @property
    def predicts_dearly(self) -> bool:
        """Whether predictions are worth sparing, but for those near a point just predicted; by default False."""
        return False

    @property
    def may_be_far_off(self) -> bool:
        """Whether a fit without a missing effect may be so far off that screening about it is no guide; else False."""
        return False

    @property
    def starts(self) -> FloatArray:
        """Coordinates to fit from, (n_starts, n_params)."""

    @property
    def nuisance_names(self) -> tuple[str, ...]:
        """Names of parameters of this recording alone, such as a shape's, not of a written model; by default none."""
        return ()

    @property
    def least_readings(self) -> int:
        """Fewest usable readings for a verdict."""

    def admits(self, effect: Effect) -> bool:
        """Return whether this model has the stage at which an effect acts."""

    def part_that_predicts(self, rows: IntArray, plan: Plan, effects: Sequence[Effect]) -> tuple[Plan, IntArray]:
        """Return a part of a plan that suffices to predict `rows` (n_rows,), and their numbers there; or all."""
        return plan, rows

    def theta(self, z: FloatArray) -> FloatArray:
        """Map coordinates z, (n_samples, n_params), to the model's own parameters: theta without the effects'."""

    def chain(self, plan: Plan, effects: Sequence[Effect], *, n_nodes: int) -> Predictor:
        """Build the model of a plan's readings, with effects; `n_nodes` for curved edges, as in `sensor.Chain`."""


def effect_values(effect: Effect, z: FloatArray) -> FloatArray:
    """Map standard-normal coordinates to values of the effect's own parameters, (n_samples, n_params) both."""
    return effect.prior.from_unit_cube(ndtr(z))


def effect_coordinates(effect: Effect, values: FloatArray) -> FloatArray:
    """Invert `effect_values`, with coordinates clipped to 5.5 on either side of 0."""
    return np.clip(ndtri(effect.prior.to_unit_cube(values)), -FARTHEST + 0.5, FARTHEST - 0.5)


DIFFERENCE = 1e-5  # step of a coordinate for forward differences: predictions are smooth to about 1e-12
AT_ONCE = 300_000  # predictions per batch, to fit a processor's cache
_AS_EXPECTED = 0.5  # of the gain to second order, from which a step without damping is taken without trying others
_FARTHEST_CHANGE = 1e6  # in largest predictions: beyond it squares overflow, and a law without the effect has run away
_VALLEY_DAMPINGS = np.array([1.0, 3.0, 10.0, 30.0, 100.0])  # times the curvature along the valley
_DAMPINGS = np.array([0.0, 0.05, 0.7, 10.0, 200.0])


def _prediction_and_slopes(batch: FloatArray, steps: FloatArray) -> tuple[FloatArray, FloatArray]:
    with np.errstate(invalid="ignore", over="ignore"):  # at a start from which the model diverges, which is not taken
        return batch[0], (batch[1:] - batch[0]).T / steps


@dataclass(frozen=True, eq=False)
class Model:
    """A null with effects over a plan, in coordinates with a standard normal prior.

    Effects on the noise are not part of the model; they are in the noise model.
    """

    sensor: Null
    effects: tuple[Effect, ...]
    plan: Plan

    @cached_property
    def chain(self) -> Predictor:
        """The predictor of readings: the null with the effects."""
        return self.sensor.chain(self.plan, self.effects, n_nodes=FAST_NODES)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects, in their order here."""
        return tuple(effect.name for effect in self.effects)

    @property
    def n_params(self) -> int:
        """Number of coordinates."""
        return self.sensor.n_params + sum(len(effect.prior.names) for effect in self.effects)

    @cached_property
    def has_shared_scale(self) -> BoolArray:
        """Mask of the coordinates of effects whose values have one scale in common, (n_params,)."""
        out = np.zeros(self.n_params, dtype=np.bool_)
        for effect in self.effects:
            out[self.coordinate_slice(effect.name)] = isinstance(effect.prior, SharedScalePrior)
        return out

    def difference_points_and_steps(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return points z and, one small step along each coordinate, others, (..., n_params + 1, n_params), and steps.

        The steps, (..., n_params) as z, point inwards, to stay within the bounds.
        """
        size = np.full(self.n_params, DIFFERENCE)
        size[: self.sensor.n_params] = getattr(self.sensor, "differences", DIFFERENCE)
        steps = np.where(z > 0, -size, size)
        return z[..., None, :] + steps[..., None, :] * np.eye(self.n_params + 1, self.n_params, -1), steps

    def coordinate_slice(self, name: str) -> slice:
        """Return the slice of one effect's coordinates."""
        return {effect.name: own for effect, own in effects_with_columns(self.effects, self.sensor.n_params)}[name]

    def theta(self, z: FloatArray) -> FloatArray:
        """Map coordinates, (n_samples, n_params), to the chain's parameters."""
        own = {effect.name: effect_values(effect, z[:, self.coordinate_slice(effect.name)]) for effect in self.effects}
        return self.joined_theta(self.sensor.theta(z[:, : self.sensor.n_params]), own)

    def joined_theta(self, sensor: FloatArray, own: Mapping[str, FloatArray]) -> FloatArray:
        """Join the null's columns with each effect's, in the order in which the chain applies the effects."""
        return np.concatenate([sensor, *(own[effect.name] for effect in self.chain.effects)], axis=1)

    def predict(self, z: FloatArray, plan: Plan | None = None) -> FloatArray:
        """Return the noise-free readings of every row of a plan, its own by default, (n_samples, n_points)."""
        return self.chain.predict(self.theta(z), self.plan if plan is None else plan)

    def predict_rows(self, rows: IntArray, z: FloatArray) -> FloatArray:
        """Return the noise-free readings of some rows of its plan, (n_samples, n_rows); others only if needed."""
        part, at = self.part_that_predicts(rows)
        return self.chain.predict(self.theta(z), part)[:, at]

    def part_that_predicts(self, rows: IntArray) -> tuple[Plan, IntArray]:
        """Return a part of its plan that suffices to predict some rows, and their numbers there, as a null does."""
        return self.sensor.part_that_predicts(rows, self.plan, self.effects)

    def predict_and_differentiate(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return predictions, (n_points,), and their slopes, (n_points, n_params), at one point z (n_params,)."""
        points, steps = self.difference_points_and_steps(z)
        return _prediction_and_slopes(self.predict(points), steps)

    def with_effect(self, effect: Effect) -> Model:
        """Return the model with one more effect, the last."""
        return Model(self.sensor, (*self.effects, effect), self.plan)

    def model_and_mask_without(self, name: str) -> tuple[Model, BoolArray]:
        """Return the model without an effect, and the mask of the remaining coordinates, (n_params,)."""
        stay = np.ones(self.n_params, dtype=np.bool_)
        stay[self.coordinate_slice(name)] = False
        return Model(self.sensor, tuple(e for e in self.effects if e.name != name), self.plan), stay

    def z_of_last_effect(self, values: FloatArray) -> FloatArray:
        """Convert values of the last effect's parameters to its coordinates z, (n_samples, n_params) both."""
        return effect_coordinates(self.effects[-1], values)


@dataclass(frozen=True, eq=False)
class Fit:
    """The best point of a model: coordinates `z`, and at it the usable rows' predictions and slopes.

    `predicted`, `residuals` (n_usable,), reading minus prediction, `slopes` (n_usable, n_params); `sd` is the most
    likely sigma of its noise model; `objective` is minus the log posterior there, up to a constant; `settled`: the last
    step gained less than the tolerance. If predictions at the start are not finite, `z` is the start, and `sd` and
    `objective` are infinite.
    """

    model: Model
    z: FloatArray
    predicted: FloatArray
    residuals: FloatArray
    slopes: FloatArray
    sd: float
    objective: float
    settled: bool = False

    def change_by_effect(self, name: str, usable: IntArray) -> FloatArray:
        """Return the predictions minus those without one of its effects, other parameters fixed, (n_usable,).

        All are finite: rows impossible without the effect (a root of a negative number, a law that runs away) count as
        the largest change of the others, and as a thousand noise sds at least.
        """
        without, stay = self.model.model_and_mask_without(name)
        with np.errstate(invalid="ignore", over="ignore"):
            change = self.predicted - without.predict_rows(usable, self.z[None, stay])[0]
        farthest = _FARTHEST_CHANGE * (float(np.abs(self.predicted).max(initial=0.0)) + self.sd)
        possible = np.isfinite(change)
        change = np.clip(change, -farthest, farthest)
        largest = np.abs(change[possible]).max(initial=1e3 * self.sd)
        return np.asarray(np.where(possible, change, largest))


def fit(
    model: Model,
    recording: Recording,
    start: FloatArray,
    law: NoiseLaw,
    *,
    max_steps: int = 30,
    tolerance: float = 5e-3,
    hopeless_above: float = math.inf,
) -> Fit:
    """Find the maximum of the posterior, with the noise sd that is most likely at each point.

    Maximises the log likelihood under the noise model minus |z|^2 / 2, over the box |z| <= 6. Each step differentiates
    in one vectorised prediction and tries five dampings in another. A step that gains less than `tolerance` nats is the
    last; a fit that would stay above `hopeless_above` if all steps left gained as much as the last is given up.
    """
    (found,) = fit_each_start(
        model, recording, [start], law, max_steps=max_steps, tolerance=tolerance, hopeless_above=hopeless_above
    )
    return found


def fit_each_start(
    model: Model,
    recording: Recording,
    starts: Sequence[FloatArray],
    law: NoiseLaw,
    *,
    max_steps: int = 30,
    tolerance: float = 5e-3,
    hopeless_above: float = math.inf,
) -> list[Fit]:
    """Fit as `fit` does from each of several starts; return the fits in that order.

    If many predictions cost little more than one, the fits advance together, in batches that fit a processor's cache.
    """
    usable = np.flatnonzero(recording.usable)
    walks = [_fit_coroutine(model, recording, start, law, max_steps, tolerance, hopeless_above) for start in starts]
    at_once = 1
    if model.sensor.predicts_in_bulk:
        at_once = max(AT_ONCE // (len(_DAMPINGS) * (model.n_params + 1) * len(recording.readings)), 1)
    found: dict[int, Fit] = {}
    for first in range(0, len(walks), at_once):
        asked = {k: next(walks[k]) for k in range(first, min(first + at_once, len(walks)))}
        while asked:
            predicted = model.predict_rows(usable, np.concatenate(list(asked.values())))
            ends = np.cumsum([len(points) for points in asked.values()])
            for k, part in zip(list(asked), np.split(predicted, ends[:-1]), strict=True):
                try:
                    asked[k] = walks[k].send(part)
                except StopIteration as end:
                    found[k] = end.value
                    del asked[k]
    return [found[k] for k in range(len(walks))]


def _fit_coroutine(
    model: Model,
    recording: Recording,
    start: FloatArray,
    law: NoiseLaw,
    max_steps: int,
    tolerance: float,
    hopeless_above: float,
) -> Generator[FloatArray, FloatArray, Fit]:
    """Fit from one start: yields points (n, n_params), is sent their predictions (n, n_usable), returns the fit."""
    readings = recording.readings[recording.usable]
    dear = model.sensor.predicts_dearly
    one_by_one = dear and not model.sensor.predicts_in_bulk

    def objective(predicted: FloatArray, z: FloatArray) -> FloatArray:
        with np.errstate(all="ignore"):  # of predictions that ran away: not finite, and not taken
            whitened = law((readings - predicted).T)
            sigma = law.likeliest_sigma(whitened)
            return np.asarray(law.minus_log_likelihood(whitened, sigma) + 0.5 * np.sum(z**2, axis=1))

    def request_slopes(z: FloatArray) -> Generator[FloatArray, FloatArray, tuple[FloatArray, FloatArray]]:
        points, steps = model.difference_points_and_steps(z)
        return _prediction_and_slopes((yield points), steps)

    z = np.clip(np.asarray(start, dtype=np.float64), -FARTHEST, FARTHEST)
    eye = np.eye(len(z))
    if dear:
        yield z[None, :]
    predicted, slopes = yield from request_slopes(z)
    best = float(objective(predicted[None, :], z[None, :])[0])
    if not (np.isfinite(best) and np.isfinite(slopes).all()):  # no finite starting point
        return Fit(model, z, predicted, readings - predicted, slopes, sd=np.inf, objective=np.inf)
    settled, exact = False, True
    for k in range(max_steps):
        whitened, turned = law(readings - predicted)[:, None], law(slopes)
        sigma = law.likeliest_sigma(whitened)
        variance = float(sigma[0]) ** 2 / law.fisher_information
        with np.errstate(over="ignore"):  # of predictions that ran away
            curvature = turned.T @ turned / variance + eye
            downhill = turned.T @ law.normal_pseudo_residuals(whitened, sigma)[:, 0] / variance - z
        tries = _damped_steps(curvature, downhill)
        if not len(tries):
            break
        expected = float(tries[0] @ downhill - 0.5 * tries[0] @ curvature @ tries[0])
        if one_by_one and k and exact and expected < tolerance:
            settled = True
            break
        tries = _points_after_steps(z, tries)
        # If predictions broadcast, slopes are computed along with them, unless they cost little near the best of them.
        in_bulk = model.sensor.predicts_in_bulk
        about, steps = tries[:0], tries[:0]
        if in_bulk and not dear:
            about, steps = model.difference_points_and_steps(tries)
        batch = yield np.concatenate(about) if len(about) else tries[: 1 if dear else None]
        if dear and not best - objective(batch, tries[:1])[0] > _AS_EXPECTED * expected:
            if not exact:
                (predicted, slopes), exact = (yield from request_slopes(z)), True
                continue
            batch = np.concatenate([batch, (yield tries[1:])])
        tries = tries[: len(batch)] if dear else tries
        all_predicted = batch.reshape(len(tries), -1, batch.shape[1])
        values = objective(all_predicted[:, 0], tries)
        values = np.where(np.isfinite(values), values, np.inf)
        short = expected > tolerance and not best - values.min() > _AS_EXPECTED * expected
        if short and in_bulk:
            # In a curved valley that is oblique to the coordinates, damping by their scales stops every step.
            more = _points_after_steps(z, _steps_along_valley(curvature, downhill))
            found = objective((yield more), more)
            tries = np.concatenate([tries, more])
            values = np.append(values, np.where(np.isfinite(found), found, np.inf))
        at = int(np.argmin(values))
        gained = best - float(values[at])
        settled = gained < tolerance
        if gained <= 0:
            break
        step, z, best = tries[at] - z, tries[at], float(values[at])
        if at < len(about):
            predicted, slopes = _prediction_and_slopes(all_predicted[at], steps[at])
        elif one_by_one and not settled:  # Broyden's update, until the fit is as good as its slopes tell
            before, predicted, exact = predicted, all_predicted[at, 0], False
            slopes = slopes + np.outer(predicted - before - slopes @ step, step / (step @ step))
        else:
            (predicted, slopes), settled, exact = (yield from request_slopes(z)), settled and exact, True
        if settled or best - gained * (max_steps - k - 1) > hopeless_above:
            break
    if not exact:
        predicted, slopes = yield from request_slopes(z)
    slopes = np.where(np.isfinite(slopes), slopes, 0.0)  # a neighbour that is impossible tells nothing
    sd = law.likeliest_sigma_of(readings - predicted)
    return Fit(model, z, predicted, readings - predicted, slopes, sd=sd, objective=best, settled=settled)


def _points_after_steps(z: FloatArray, steps: FloatArray) -> FloatArray:
    return np.clip(z + np.clip(steps, -2.0, 2.0), -FARTHEST, FARTHEST)


def with_prior(information: FloatArray) -> FloatArray:
    """Return the precisions of standard-normal coordinates, (..., n, n), of which the readings give `information`.

    They are definite also where the prior is lost in rounding: readings are met exactly, or a prediction runs away.
    """
    prior = np.eye(information.shape[-1])
    return np.asarray(information * (1 + 1e-13 * prior) + prior)


def _damped_steps(curvature: FloatArray, downhill: FloatArray) -> FloatArray:
    """Return the Levenberg-Marquardt step for each damping, (n_solved, n_params), but for singular systems."""
    scale, solved = np.diag(curvature), []
    for damping in _DAMPINGS if np.isfinite(curvature).all() else ():
        with contextlib.suppress(np.linalg.LinAlgError):
            solved.append(np.linalg.solve(curvature + np.diag(damping * scale), downhill))
    return np.array(solved).reshape(-1, len(downhill))


def _steps_along_valley(curvature: FloatArray, downhill: FloatArray) -> FloatArray:
    """Return steps damped alike in all directions (Levenberg), by the curvature of the axis that promises most."""
    along, axes = np.linalg.eigh(curvature)
    along = np.maximum(along, 1.0)  # the prior's, which may be lost in rounding
    slope = axes.T @ downhill
    valley = along[np.argmax(slope**2 / along)]
    return np.asarray((slope / (along + valley * _VALLEY_DAMPINGS[:, None])) @ axes.T)


def residual_degrees_of_freedom(slopes: FloatArray, sd: float, n_kept: int) -> float:
    """Return the residual degrees of freedom: n minus the number of parameters that readings, not priors, determine.

    `slopes`: slopes of the whitened readings by the coordinates, (n_points, n_params); `n_kept`: number of readings
    that are not lost; the slopes of the others are 0.
    """
    squares = np.linalg.svd(slopes / max(sd, LEAST_SCALE), compute_uv=False) ** 2
    return max(n_kept - float(np.sum(squares / (1 + squares))), 1.0)
