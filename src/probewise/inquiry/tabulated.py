"""Forecasts by tables: of the response to discs, or of the unit Gaussian's response to edges."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, Self

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.inquiry.carded import CardedForecast, cards_of
from probewise.inquiry.designs import Designs
from probewise.inquiry.discs import DiscTable, is_known_footprint_effect
from probewise.inquiry.forecast import (
    MOST_LEVELS,
    DirectForecast,
    Forecast,
    PredictiveDistributions,
    evenly_spaced_levels,
    predict_where_visible,
    rows_by_combination,
)
from probewise.inquiry.grid import Grid
from probewise.inquiry.tabulated_effects import TabulatedChain
from probewise.inquiry.tabulated_shapes import TabulatedShapes
from probewise.recordings.plan import Instrumentation, Plan
from probewise.scene import HypothesisScene, Shape, outlines
from probewise.sensor import Chain, FixedLevels, FixedMixture
from probewise.sensor.commanded import height_ratio, led_state
from probewise.sensor.stages import SensorModel

_PER_SD = 2.0  # levels per noise sd: rounding adds 2 % to its variance, which thousands of hypotheses average out
_N_CHECKED = 64  # shapes drawn from the prior, checked at 16 places each
_PLACES = 16
_MOST_OFF = 0.005  # largest rms error, as a share of the difference between dark and bright
_REACH = 3.0  # sds of the footprint about an edge
_FEW = 1000  # rows of a plan
_MOST_WAYS = 8  # orientations and heights of the sensor


@dataclass(frozen=True, eq=False)
class DiscForecast:
    """A forecast for discs, by the table of the sensor's response."""

    model: SensorModel
    table: DiscTable

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Predict noise-free readings, (n_samples, n_params) -> (n_samples, n_points); see `predict_where_visible`."""
        return predict_where_visible(self.model, theta, plan)

    def predictive(
        self, theta: FloatArray, weight: FloatArray, designs: Designs, plan: Plan, rows: IntArray, noise_sd: float
    ) -> PredictiveDistributions:
        """Return the predictive distribution at `rows`, of all hypotheses by the table; see `Forecast.predictive`."""
        levels = evenly_spaced_levels(self.table.dark, self.table.bright, noise_sd / _PER_SD, most=MOST_LEVELS)
        turns = plan.orientation_rad.reshape(-1, designs.grid.n_places)
        return _DiscPredictive(self.table, theta, designs.grid, turns, rows, levels)


@dataclass(frozen=True, eq=False)
class _DiscPredictive:
    """Discs over a grid of places, with the sensor's orientations `turns_rad`, (n_combinations, n_places)."""

    table: DiscTable
    theta: FloatArray
    grid: Grid
    turns_rad: FloatArray
    rows: IntArray
    levels: FloatArray

    def level_weights(self, weight: FloatArray) -> Iterator[tuple[IntArray, FloatArray]]:
        """Yield the weight of each level at all places of one combination of settings, one combination after another.

        Combinations of one orientation share the computation.
        """
        some = weight > 0
        stood, mass = None, np.empty(0)
        for number, at, places in rows_by_combination(self.rows, self.grid.n_places):
            turn = self.turns_rad[number]
            if stood is None or not np.array_equal(stood, turn):
                stood, mass = (
                    turn,
                    self.table.level_histogram(self.theta[some], weight[some], self.grid, self.levels, turn),
                )
            yield at, mass if len(places) == len(mass) else mass[places]


@dataclass(frozen=True, eq=False)
class TabulatedForecast:
    """A forecast for ellipses and convex polygons, by tables of the unit Gaussian's response; made by `of`.

    Its rms error is at most 0.5 % of the difference between dark and bright, which `of` checks against the sensor
    model.
    """

    model: Chain
    mixture: FixedMixture
    levels: FixedLevels
    shape: Shape

    @classmethod
    def of(cls, model: SensorModel, *, highest: float = 1.0) -> Self | None:
        """Build the forecast, or return None if the tables do not apply to the model, or disagree with it.

        Parameters
        ----------
        model
            A known mixture over a hypothesised scene, without effects, with shapes that are wide compared to its
            footprint.
        highest
            Largest height of the sensor over that of its calibration, at which its footprint is widest.
        """
        if not isinstance(model, Chain) or model.effects or not isinstance(model.scene, HypothesisScene):
            return None
        if not isinstance(model.ssf, FixedMixture) or not isinstance(model.levels, FixedLevels):
            return None
        made = cls(model, model.ssf, model.levels, model.scene.shape)
        return made if made._agrees_with_model(max(highest, 1.0)) else None

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Predict noise-free readings, (n_samples, n_params) -> (n_samples, n_points), by the tables.

        At over 1000 places, over 8 orientations and heights, or where no table applies, the model predicts directly,
        only the hypotheses visible from each place.
        """
        if len(plan) > _FEW:
            return predict_where_visible(self.model, theta, plan)
        ways, which = np.unique(np.stack([plan.orientation_rad, _relative_heights(plan)]), axis=1, return_inverse=True)
        out, led = np.empty((len(theta), len(plan))), np.broadcast_to(led_state(plan), len(plan))
        for number, way in enumerate(ways.T.tolist()):
            rows = np.flatnonzero(which.ravel() == number)
            shapes = self._tabulated_shapes_at(theta, *way)
            if shapes is None or ways.shape[1] > _MOST_WAYS:
                return predict_where_visible(self.model, theta, plan)
            dark, bright = self._dark_and_bright_at_height(way[1])
            seen = shapes.footprint_share(plan.x_mm[rows], plan.y_mm[rows])
            out[:, rows] = dark + (bright - dark) * led[rows] * seen
        return out

    def predictive(
        self, theta: FloatArray, weight: FloatArray, designs: Designs, plan: Plan, rows: IntArray, noise_sd: float
    ) -> PredictiveDistributions:
        """Return the predictive distribution at `rows`: by tables where these apply, otherwise by direct predictions.

        The tables need one orientation for all places of a map, and no other setting than the height.
        """
        turns, heights = (a.reshape(-1, designs.grid.n_places) for a in (plan.orientation_rad, _relative_heights(plan)))
        asked = partial(DirectForecast(self.model).predictive, theta, weight, designs, plan, rows, noise_sd)
        if (turns != turns[:, :1]).any() or set(plan.covariates) - {"height_mm"}:
            return asked()
        ways = list(zip(turns[:, 0].tolist(), heights[:, 0].tolist(), strict=True))
        shapes_at = {}
        for turn, height in dict.fromkeys(ways):
            shapes = self._tabulated_shapes_at(theta, turn, height)
            if shapes is None:
                return asked()
            shapes_at[turn, height] = _ShapesUnderSensor(shapes, *self._dark_and_bright_at_height(height))
        low = min(min(each.dark, each.bright) for each in shapes_at.values())
        high = max(max(each.dark, each.bright) for each in shapes_at.values())
        levels = evenly_spaced_levels(low, high, noise_sd / _PER_SD, most=MOST_LEVELS)
        return _TabulatedPredictive(shapes_at, ways, designs.grid, rows, levels)

    def _tabulated_shapes_at(self, theta: FloatArray, turn_rad: float, height: float) -> TabulatedShapes | None:
        """Return the shapes under the sensor at an orientation, and at `height` times the calibrated one, or None."""
        cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
        stands = height * np.array([[cosine, -sine], [sine, cosine]])
        seen = FixedMixture(
            self.mixture.weights, self.mixture.means_mm @ stands.T, stands @ self.mixture.covs_mm2 @ stands.T
        )
        return TabulatedShapes.of(self.shape.region(theta), seen)

    def _dark_and_bright_at_height(self, height: float) -> tuple[float, float]:
        """Return the readings outside and deep inside a shape at `height` times that of the calibration.

        The reading outside does not change; the difference between the two falls with the square of the height.
        """
        return self.levels.i_min, self.levels.i_min + (self.levels.i_max - self.levels.i_min) / height**2

    def _agrees_with_model(self, highest: float) -> bool:
        """Return whether tables and model agree, at places about the edges of some shapes from the prior."""
        prior, rng = self.shape.prior, np.random.default_rng(0)
        theta = prior.from_unit_cube(rng.random((_N_CHECKED, len(prior.names))))
        shapes = self._tabulated_shapes_at(theta, 0.0, highest)
        dark, bright = self._dark_and_bright_at_height(highest)
        if shapes is None or dark == bright:
            return False
        reach = _REACH * highest * float(np.sqrt(np.linalg.eigvalsh(self.mixture.covs_mm2).max()))
        quick, asked = [], []
        for row, outline in enumerate(outlines(self.shape.region(theta))):
            place = outline[rng.integers(len(outline), size=_PLACES)] + rng.uniform(-reach, reach, (_PLACES, 2))
            plan = _plan_at_height(place, highest)
            quick.append(shapes.footprint_share(plan.x_mm, plan.y_mm)[row])
            asked.append(self.model.predict(theta[[row]], plan)[0])
        off = np.array(quick) - (np.array(asked) - dark) / (bright - dark)
        return bool(np.sqrt((off**2).mean()) < _MOST_OFF)


class _ShapesUnderSensor(NamedTuple):
    """All shapes under a sensor of one orientation and height, and its readings outside and deep inside them."""

    shapes: TabulatedShapes
    dark: float
    bright: float


@dataclass(frozen=True, eq=False)
class _TabulatedPredictive:
    """Shapes over a grid of places, for each orientation and height of the sensor."""

    shapes_at: dict[tuple[float, float], _ShapesUnderSensor]
    turns_and_heights: list[tuple[float, float]]
    grid: Grid
    rows: IntArray
    levels: FloatArray

    def level_weights(self, weight: FloatArray) -> Iterator[tuple[IntArray, FloatArray]]:
        """Yield the weight of each level at all places of one combination of settings, one combination after another.

        Combinations of one orientation and height, with other repeats, share the computation.
        """
        stood, mass = None, np.empty(0)
        for number, at, places in rows_by_combination(self.rows, self.grid.n_places):
            if stood != self.turns_and_heights[number]:
                stood = self.turns_and_heights[number]
                shapes, dark, bright = self.shapes_at[stood]
                mass = shapes.level_histogram(weight, self.grid, dark, bright, self.levels)
            yield at, mass if len(places) == len(mass) else mass[places]


def forecast_of(model: SensorModel, *, highest: float | None = None) -> Forecast:
    """Choose the forecast for a model: tables if possible, else direct predictions.

    `highest` is the largest height of the sensor over that of its calibration; None: always the calibrated height.
    """
    if cards_of(model):
        return _forecast_of_model_with_cards(model, highest)
    table = DiscTable.of(model) if highest is None else None
    if table is not None:
        return DiscForecast(table if table.margin_mm else model, table)
    if highest is None and isinstance(model, Chain) and model.effects:
        return DirectForecast(_tabulated_chain(model) or model)
    return TabulatedForecast.of(model, highest=highest or 1.0) or DirectForecast(model)


def _tabulated_chain(model: Chain) -> TabulatedChain | None:
    """Return `model` as a chain over a table that holds its known footprint effects; None if that is impossible."""
    table = DiscTable.of(replace(model, effects=tuple(filter(is_known_footprint_effect, model.effects))))
    return None if table is None else TabulatedChain.of(model, table)


def _forecast_of_model_with_cards(model: SensorModel, highest: float | None) -> Forecast:
    """Return the forecast of a model with known cards: by tables of the shape alone if possible, else direct."""
    if not isinstance(model, Chain) or model.effects or highest is not None:
        return DirectForecast(model)
    base = forecast_of(replace(model, scene=HypothesisScene(model.scene.shape)))  # type: ignore[attr-defined]
    return DirectForecast(model) if isinstance(base, DirectForecast) else CardedForecast(base, model)


def _relative_heights(plan: Plan) -> FloatArray:
    """Return the height of every row over that of the calibration, (n_points,)."""
    ratio = height_ratio(plan)
    return np.ones(len(plan)) if ratio is None else ratio


def _plan_at_height(places_mm: FloatArray, height: float) -> Plan:
    """Return a plan of readings at places, (n_points, 2), at `height` times that of the calibration."""
    n = len(places_mm)
    zero = np.zeros(n, dtype=np.int64)
    return Plan(
        x_mm=places_mm[:, 0],
        y_mm=places_mm[:, 1],
        orientation_rad=np.zeros(n),
        time_s=np.zeros(n),
        scan=zero,
        scan_names=("table",),
        pattern=zero,
        pattern_names=("table",),
        covariates={"height_mm": np.full(n, height)},
        instrumentation=Instrumentation(height_mm=1.0),
    )
