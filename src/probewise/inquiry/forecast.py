"""Predictions for many hypotheses at many designs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import ParameterError
from probewise.inquiry.grid import Designs
from probewise.inquiry.readout import MOST_LEVELS, evenly_spaced_levels, weight_by_level
from probewise.recordings.plan import Plan
from probewise.scene import CardedScene, HypothesisScene, outlines
from probewise.sensor import Chain, FixedLevels, FixedMixture
from probewise.sensor.commanded import has_commanded_height_or_led
from probewise.sensor.stages import SensorModel

_BLOCK = 2048  # designs predicted at a time: a closed form with 20 nodes stays within 20 MB for 50 hypotheses
MOST_PREDICTED = 400  # hypotheses predicted directly
_PER_SD = 8.0  # levels per noise sd: fine, since each of a few hundred hypotheses matters
_REACH = 6.0  # sds of the footprint beyond which it is negligible: 1e-9 of the levels' difference
_TILE_MM = 110.0
_FAR_MM = 1e5


@dataclass(frozen=True, eq=False)
class PredictiveDistributions:
    """Predictive distribution of the noise-free reading at some designs, as weights of levels.

    `levels` are evenly spaced noise-free readings, (n_levels,); a prediction counts for the nearest. `level_weights`
    takes the weights of the hypotheses, (n_samples,), and yields, for one combination of settings after another,
    indices into the designs, (n,), and the weight of each level there, (n, n_levels).
    """

    levels: FloatArray
    level_weights: Callable[[FloatArray], Iterator[tuple[IntArray, FloatArray]]]


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
        """Return the predictive distribution at the designs `rows`, (n,), of which `plan` holds all as rows.

        `weight`, (n_samples,), serves if only some hypotheses can be predicted; `noise_sd` sets the spacing of levels.
        """
        ...


@dataclass(frozen=True, eq=False)
class DirectForecast:
    """A forecast for any model: direct predictions of at most `n_predicted` hypotheses, resampled systematically.

    `levels_per_sd`: number of levels per sd of the noise.
    """

    model: SensorModel
    n_predicted: int = MOST_PREDICTED
    levels_per_sd: float = _PER_SD

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Predict noise-free readings, (n_samples, n_params) -> (n_samples, n_points)."""
        return predict_where_visible(self.model, theta, plan)

    def predictive(
        self, theta: FloatArray, weight: FloatArray, designs: Designs, plan: Plan, rows: IntArray, noise_sd: float
    ) -> PredictiveDistributions:
        """Return the predictive distribution at `rows`, by predictions of the resampled hypotheses."""
        chosen, share = resampled_rows_and_weights(weight, self.n_predicted)
        predicted = predict_where_visible(self.model, theta[chosen], plan.take(rows))
        low, high = float(predicted.min()), float(predicted.max())
        levels = evenly_spaced_levels(low, high, noise_sd / self.levels_per_sd, most=MOST_LEVELS)
        index = np.rint((predicted - levels[0]) * (1.0 / (levels[1] - levels[0]))).astype(np.int32)
        stands_for = share / weight[chosen]

        def level_weights(weight: FloatArray) -> Iterator[tuple[IntArray, FloatArray]]:
            for _, at, _ in rows_by_combination(rows, designs.grid.n_places):
                yield at, weight_by_level(index[:, at], weight[chosen] * stands_for, len(levels))

        return PredictiveDistributions(levels, level_weights)


def rows_by_combination(rows: IntArray, n_places: int) -> Iterator[tuple[int, IntArray, IntArray]]:
    """Split rows of designs, (n,), by combination of settings.

    Yield for each its number, the indices into `rows`, and the numbers of the places there.
    """
    combination, place = np.divmod(rows, n_places)
    for number in np.unique(combination).tolist():
        at = np.flatnonzero(combination == number)
        yield number, at, place[at]


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


def predict_where_visible(model: SensorModel, theta: FloatArray, plan: Plan) -> FloatArray:
    """Predict every hypothesis at every row of a long plan: (n_samples, n_points).

    The model is called only for hypotheses visible from a row; elsewhere the reading is the one outside the shape.
    """
    out = np.empty((len(theta), len(plan)))
    boxes = _bounding_boxes(model, theta, plan)
    if boxes is None:
        for start in range(0, len(plan), _BLOCK):
            block = np.arange(start, min(start + _BLOCK, len(plan)))
            out[:, block] = model.predict(theta, plan.take(block))
        return out
    low, high, out[:] = boxes
    column, row = (np.floor(place / _TILE_MM).astype(np.int64) for place in (plan.x_mm, plan.y_mm))
    tiles = np.unique(np.stack([column, row]), axis=1, return_inverse=True)[1].ravel()
    order = np.argsort(tiles, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(tiles[order])) + 1):
        place = np.stack([plan.x_mm[rows], plan.y_mm[rows]], axis=-1)
        shown = np.flatnonzero((low <= place.max(axis=0)).all(axis=1) & (high >= place.min(axis=0)).all(axis=1))
        if shown.size:
            out[np.ix_(shown, rows)] = model.predict(theta[shown], plan.take(rows))
    return out


def _bounding_boxes(model: SensorModel, theta: FloatArray, plan: Plan) -> tuple[FloatArray, FloatArray, float] | None:
    """Return corners of the boxes, (n_samples, 2) each, outside which a hypothesis is invisible, and the reading there.

    None if readings depend on more than the shape: only for a known mixture and known levels without effects they do
    not. None also for a shape without closed edge.
    """
    if not isinstance(model, Chain) or model.effects or has_commanded_height_or_led(plan) or len(plan) == 0:
        return None
    if not isinstance(model.ssf, FixedMixture) or not isinstance(model.levels, FixedLevels):
        return None
    if not isinstance(model.scene, HypothesisScene) or isinstance(model.scene, CardedScene):
        return None
    try:
        edges = outlines(model.scene.shape.region(theta))
    except ParameterError:  # no closed edge: it may be visible anywhere
        return None
    reach = footprint_reach_mm(model.ssf)
    low, high = (np.array([f(edge, axis=0) for edge in edges]) for f in (np.nanmin, np.nanmax))
    one = plan.take(np.array([0]))
    outside = model.predict(theta[:1], replace(one, x_mm=one.x_mm + _FAR_MM))[0, 0]
    return low - reach, high + reach, float(outside)


def footprint_reach_mm(mixture: FixedMixture) -> float:
    """Return the distance from the sensor beyond which its footprint is negligible."""
    sds = np.sqrt(np.linalg.eigvalsh(mixture.covs_mm2)[:, -1])
    return float((np.linalg.norm(mixture.means_mm, axis=1) + _REACH * sds).max())
