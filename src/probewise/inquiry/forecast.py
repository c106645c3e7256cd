"""Predictive distributions at every design, as weights of levels, by direct predictions if there is no table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.inquiry.culling import CullingBounds
from probewise.inquiry.designs import Designs
from probewise.recordings.plan import Plan
from probewise.sensor.stages import SensorModel

MOST_LEVELS = 1000
"""Largest number of levels and of cells of a reading, more than the hypotheses can fill."""


_BLOCK = 2048  # designs predicted at a time: a closed form with 20 nodes stays within 20 MB for 50 hypotheses
_MOST_ASKED = 400  # hypotheses predicted directly
_PER_SD = 8.0  # levels per noise sd: fine, since each of a few hundred hypotheses matters


class PredictiveDistributions(Protocol):
    """Predictive distribution of the noise-free reading at some designs, as weights of levels."""

    @property
    def levels(self) -> FloatArray:
        """Evenly spaced noise-free readings, (n_levels,); a prediction counts for the nearest."""
        ...

    def level_weights(self, weight: FloatArray) -> Iterator[tuple[IntArray, FloatArray]]:
        """Yield the weight of each level at all places of one combination of settings, one combination after another.

        Parameters
        ----------
        weight
            Of the hypotheses, (n_samples,).

        Yields
        ------
        Indices into the designs, (n,), and the weight of each level there, (n, n_levels).
        """
        ...


class Forecast(Protocol):
    """Predictions for many hypotheses at many designs at once."""

    @property
    def model(self) -> SensorModel:
        """The sensor model."""
        ...

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Predict noise-free readings at the rows of a plan, (n_samples, n_params) -> (n_samples, n_points)."""
        ...

    def predictive(
        self, theta: FloatArray, weight: FloatArray, designs: Designs, plan: Plan, rows: IntArray, noise_sd: float
    ) -> PredictiveDistributions:
        """Return the predictive distribution at designs.

        Parameters
        ----------
        theta, weight
            Hypotheses, (n_samples, n_params), and their weights, (n_samples,), used if only some can be predicted.
        designs, plan
            The designs, and the same as rows of a plan.
        rows
            Indices of the designs to predict, (n,).
        noise_sd
            Sd of a reading's noise, which sets the spacing of levels.
        """
        ...


@dataclass(frozen=True, eq=False)
class DirectForecast:
    """A forecast for any model: direct predictions of at most 400 hypotheses, resampled systematically."""

    model: SensorModel

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Predict noise-free readings, (n_samples, n_params) -> (n_samples, n_points)."""
        return predict_where_visible(self.model, theta, plan)

    def predictive(
        self, theta: FloatArray, weight: FloatArray, designs: Designs, plan: Plan, rows: IntArray, noise_sd: float
    ) -> PredictiveDistributions:
        """Return the predictive distribution at `rows`, by predictions of at most 400 resampled hypotheses."""
        chosen, share = resampled_rows_and_weights(weight, _MOST_ASKED)
        answers = predict_where_visible(self.model, theta[chosen], plan.take(rows))
        levels = evenly_spaced_levels(float(answers.min()), float(answers.max()), noise_sd / _PER_SD, most=MOST_LEVELS)
        per_level = 1.0 / (levels[1] - levels[0])
        index = np.rint((answers - levels[0]) * per_level).astype(np.int32)
        return _DirectPredictive(chosen, share / weight[chosen], index, levels, rows, designs.grid.n_places)


@dataclass(frozen=True, eq=False)
class _DirectPredictive:
    """Predictions of the hypotheses `chosen` as the `index` of the nearest level, (n_asked, n_designs).

    `stands_for`, (n_asked,): factor from the weight of each to that of all hypotheses for which it stands.
    """

    chosen: IntArray
    stands_for: FloatArray
    index: IntArray
    levels: FloatArray
    rows: IntArray
    n_places: int

    def level_weights(self, weight: FloatArray) -> Iterator[tuple[IntArray, FloatArray]]:
        """Yield the weight of each level at all places of one combination of settings; then of the next."""
        own, n_levels = weight[self.chosen] * self.stands_for, len(self.levels)
        for _, at, _ in rows_by_combination(self.rows, self.n_places):
            yield at, weight_by_level(self.index[:, at], own, n_levels)


def nearest_level_index(answers: FloatArray, levels: FloatArray) -> IntArray:
    """Return the index of the nearest of evenly spaced levels to each prediction, of the same shape."""
    return np.asarray(np.rint((answers - levels[0]) / (levels[1] - levels[0])).astype(np.int64))


def weight_by_level(index: IntArray, weight: FloatArray, n_levels: int) -> FloatArray:
    """Sum the weights, (n,), of hypotheses that predict each level, index (n, n_designs) -> (n_designs, n_levels)."""
    n_designs = index.shape[1]
    key = index + np.arange(n_designs) * n_levels
    counted = np.bincount(key.ravel(), np.repeat(weight, n_designs), minlength=n_designs * n_levels)
    return np.asarray(counted.reshape(n_designs, n_levels), dtype=np.float64)


def rows_by_combination(rows: IntArray, n_places: int) -> Iterator[tuple[int, IntArray, IntArray]]:
    """Split rows of designs, (n,), by combination of settings.

    Yield for each its number, the indices into `rows`, and the numbers of the places there.
    """
    combination, place = np.divmod(rows, n_places)
    for number in np.unique(combination).tolist():
        at = np.flatnonzero(combination == number)
        yield number, at, place[at]


def predict_where_visible(model: SensorModel, theta: FloatArray, plan: Plan) -> FloatArray:
    """Predict every hypothesis at every row of a long plan: (n_samples, n_points).

    The model is called only for hypotheses visible from a row; elsewhere the reading is the one outside the shape.
    """
    bounds = CullingBounds.of(model, theta, plan)
    if bounds is not None:
        out = np.full((len(theta), len(plan)), bounds.outside)
        for rows, shown in bounds.visible_hypotheses_by_tile(plan):
            if shown.size:
                out[np.ix_(shown, rows)] = model.predict(theta[shown], plan.take(rows))
        return out
    out = np.empty((len(theta), len(plan)))
    for start in range(0, len(plan), _BLOCK):
        block = np.arange(start, min(start + _BLOCK, len(plan)))
        out[:, block] = model.predict(theta, plan.take(block))
    return out


def evenly_spaced_levels(low: float, high: float, spacing: float, *, most: int | None = None) -> FloatArray:
    """Return evenly spaced levels between two readings, two or more, at most `spacing` apart.

    `most`: largest number of levels, even if they are then further apart.
    """
    low, high = min(low, high), max(low, high)
    n = max(2, int(np.ceil((high - low) / spacing)) + 1)
    return np.linspace(low, max(high, low + spacing), n if most is None else min(n, most))


def resampled_rows_and_weights(weight: FloatArray, n: int) -> tuple[IntArray, FloatArray]:
    """Resample at most `n` hypotheses systematically, with a fixed start; return their indices and new weights.

    The new weights have the same sum as all.
    """
    some = np.flatnonzero(weight > 0)
    if len(some) <= n:
        return some, weight[some]
    ladder = np.cumsum(weight)
    rows = np.searchsorted(ladder, (np.arange(n) + 0.5) / n * ladder[-1])
    rows, count = np.unique(np.minimum(rows, len(weight) - 1), return_counts=True)
    return rows, count * (ladder[-1] / n)
