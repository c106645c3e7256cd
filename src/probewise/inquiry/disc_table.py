"""Tabulated response of a known sensor to a disc: constant away from the edge, smooth near it.

The response to a disc depends on three numbers: the distance of the sensor from the edge, the direction of the edge in
the sensor's frame, and its curvature. The table is filled once by the sensor model; predictions are interpolations,
needed only in the ring about each edge, at a few hundred of many thousand places.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Self, cast

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from probewise._arrays import FloatArray, IntArray, read_only_floats
from probewise.effects import Known
from probewise.errors import require
from probewise.inquiry.forecast import (
    MOST_PREDICTED,
    DirectForecast,
    Forecast,
    PredictiveDistributions,
    footprint_reach_mm,
    predict_where_visible,
    resampled_rows_and_weights,
    rows_by_combination,
)
from probewise.inquiry.grid import Designs, Grid
from probewise.inquiry.readout import MOST_LEVELS, evenly_spaced_levels, nearest_level_index, weight_by_level
from probewise.recordings.plan import Plan
from probewise.scene import CardedScene, Circle, HypothesisScene
from probewise.scene.scenes import mean_albedo_with_cards
from probewise.sensor import Chain, FixedMixture, NaiveSensor
from probewise.sensor.chain import RegionsAndPoses, cards_of, response
from probewise.sensor.commanded import led_state
from probewise.sensor.stages import AnyEffect, Poses, SensorModel, Stage, View, require_theta_columns

NAMES = ("x_mm", "y_mm", "radius_mm")

_ROWS = 3  # of a grid per batch, to fit the cache
_PER_SD = 2.0  # levels per noise sd: rounding adds 2 % to its variance, which thousands of hypotheses average out
_N_PREDICTED = 200  # hypotheses of other shapes, without effects: with twice as many a map is no better but slower
_COARSE_MM = 0.5  # spacing of distances at which the model is evaluated
_FINER = 4  # entries of the table for each of these, by cubic interpolation
_PROBE_MM = 80.0  # largest distance from the edge that is evaluated
_FLAT = 1e-5  # share of the levels' difference below which a level counts as constant
_DIRECTIONS = 128
_BENDS = 8
_TINY = 1e-30
_SHOWS = 1e-4  # share of the footprint on a card from which the card counts


@dataclass(frozen=True, eq=False)
class DiscTable:
    """A sensor model over one disc, as a table: parameters x_mm, y_mm, radius_mm."""

    dark: float  # readings far outside and far inside
    bright: float
    margin_mm: float  # distance from the edge within which the level differs from `dark` or `bright`
    bend_per_mm: tuple[float, float]  # least and greatest 1 / radius of the table
    # Noise-free readings, (n_bends, n_directions + 1, n_distances): evenly spaced in 1 / radius, in a pseudo-angle of
    # the direction (0 to 4, rising with the angle; the last repeats the first), and in distance from -margin to margin.
    levels: FloatArray

    @classmethod
    def of(cls, model: SensorModel) -> Self | None:
        """Tabulate a model, or return None if that is not possible.

        Tabulated is a known mixture or the naive sensor, with known levels, over a single circle. Effects may only be
        blur of edges and halo with known parameters. The reading must be constant farther than 80 mm from the edge.
        ParameterError if the readings far outside and inside are equal.
        """
        if not isinstance(model, (Chain, NaiveSensor)) or not isinstance(model.scene, HypothesisScene):
            return None
        if isinstance(model.scene, CardedScene):
            return None
        shape = model.scene.shape
        if not isinstance(shape, Circle) or model.names != NAMES:
            return None
        low, high = shape.radius_mm
        bends = (1.0 / high, 1.0 / low)
        if isinstance(model, NaiveSensor):
            dark, bright = _readings_outside_and_inside(model, high)
            return cls(dark, bright, 0.0, bends, read_only_floats(np.empty((0, 0, 0))))
        if not isinstance(model.ssf, FixedMixture) or not all(map(is_known_footprint_effect, model.effects)):
            return None
        dark, bright = _readings_outside_and_inside(model, high)
        pseudo_angle = np.linspace(0.0, 4.0, _DIRECTIONS, endpoint=False)
        upper = pseudo_angle <= 2.0
        across = np.where(upper, 1.0 - pseudo_angle, pseudo_angle - 3.0)
        up = np.where(upper, 1.0, -1.0) * (1.0 - np.abs(across))
        directions = np.stack([across, up], axis=-1) / np.hypot(across, up)[:, None]
        margin = _COARSE_MM  # distance from the edge beyond which the reading is constant, for small and large discs
        for radius in (low, high):
            distance = np.arange(-min(radius, _PROBE_MM), _PROBE_MM, _COARSE_MM)
            around = _readings_around_disc(model, radius, directions[:: _DIRECTIONS // 16], distance)
            off = np.abs(around - np.where(distance <= 0.0, bright, dark)) > _FLAT * abs(bright - dark)
            margin = max(margin, float(np.abs(distance[off.any(axis=0)]).max(initial=0.0)) + _COARSE_MM)
        if margin >= _PROBE_MM:
            return None
        coarse = np.linspace(-margin, margin, 2 * int(np.ceil(margin / _COARSE_MM)) + 1)
        readings = np.stack(
            [_readings_around_disc(model, 1.0 / b, directions, coarse) for b in np.linspace(*bends, _BENDS)]
        )
        readings = np.concatenate([readings, readings[:, :1]], axis=1)
        levels = np.ascontiguousarray(_refined(readings))  # so that it is flat for free
        return cls(dark, bright, margin, bends, read_only_floats(levels))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters: x_mm, y_mm, radius_mm."""
        return NAMES

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Predict noise-free readings by interpolation, theta (n_samples, 3) -> (n_samples, n_points)."""
        level = self.predict_at(theta, plan.x_mm[None], plan.y_mm[None], plan.orientation_rad[None])
        if "led" not in plan.covariates or self.margin_mm == 0.0:  # without margin: the naive sensor, which has no LED
            return level
        return self.dark + led_state(plan) * (level - self.dark)

    def predict_at(
        self, theta: FloatArray, x_mm: FloatArray, y_mm: FloatArray, orientation_rad: FloatArray
    ) -> FloatArray:
        """Return noise-free readings at different places for each hypothesis, (n_samples, n_points).

        `theta`: discs, (n_samples, 3). `x_mm`, `y_mm`, `orientation_rad`: poses of the sensor that broadcast to the
        result.
        """
        require_theta_columns(theta, NAMES)
        away_x, away_y = x_mm - theta[:, :1], y_mm - theta[:, 1:2]
        distance = np.hypot(away_x, away_y) - theta[:, 2:]
        out = np.asarray(self.dark + (self.bright - self.dark) * (distance <= 0.0), dtype=np.float64)
        near = np.flatnonzero(np.abs(distance) < self.margin_mm)
        if not near.size:
            return out
        hypothesis, point = np.divmod(near, distance.shape[1])
        turn_rad = orientation_rad[0][point] if len(orientation_rad) == 1 else orientation_rad[hypothesis, point]
        cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
        x, y, distance = (values.ravel()[near] for values in (away_x, away_y, distance))
        angle = _pseudo_angle(cosine * x + sine * y, cosine * y - sine * x)
        n_bends, n_directions, n_distances = self.levels.shape
        curvature = 1.0 / theta[:, 2] - self.bend_per_mm[0]
        bend, along_bend = _index_and_fraction(curvature * self._entries_per_curvature, n_bends)
        turn, along_turn = _index_and_fraction(angle * ((n_directions - 1) / 4.0), n_directions)
        step, along = _index_and_fraction((distance + self.margin_mm) * self._entries_per_mm, n_distances)
        corner = (bend[hypothesis] * n_directions + turn) * n_distances + step
        along_bend = along_bend[hypothesis]
        flat = self.levels.reshape(-1)

        def interpolated_in_distance(first: IntArray) -> FloatArray:
            low = flat[first]
            return np.asarray(low + along * (flat[first + 1] - low))

        def interpolated_in_direction(first: IntArray) -> FloatArray:
            low = interpolated_in_distance(first)
            return np.asarray(low + along_turn * (interpolated_in_distance(first + n_distances) - low))

        low = interpolated_in_direction(corner)
        np.put(out, near, low + along_bend * (interpolated_in_direction(corner + n_directions * n_distances) - low))
        return out

    def level_histogram(
        self, theta: FloatArray, weight: FloatArray, grid: Grid, levels: FloatArray, turn_rad: FloatArray
    ) -> FloatArray:
        """Return the weighted histogram of predicted levels at every place of a grid, (n_places, n_levels).

        `theta`, `weight`: hypotheses, (n_samples, 3), and their weights, (n_samples,); each row of the result has the
        weights' sum. `levels`: evenly spaced, (n_levels,), from the darkest to the brightest; a prediction counts for
        the nearest. `turn_rad`: orientation of the sensor at each place, (n_places,).
        """
        n_levels, n_x = len(levels), grid.n_x
        per_level = 1.0 / (levels[1] - levels[0])
        dark, bright = np.rint((np.array([self.dark, self.bright]) - levels[0]) * per_level).astype(np.int64).tolist()
        nearest = np.clip(np.rint((self.levels - levels[0]) * per_level), 0, n_levels - 1).astype(np.int16)
        margin = 0.0  # distance from an edge beyond which the nearest level is constant
        if self.margin_mm > 0.0:
            distance = np.linspace(-self.margin_mm, self.margin_mm, nearest.shape[2])
            off = (nearest != np.where(distance <= 0.0, bright, dark)).any(axis=(0, 1))
            margin = float(np.abs(distance[off]).max(initial=0.0))
        x, y, radius = _in_single_precision(theta).T
        mass = np.empty((grid.n_places, n_levels))
        turn = turn_rad.reshape(grid.n_y, n_x)
        for start in range(0, grid.n_y, _ROWS):
            y_mm = _in_single_precision(grid.y_mm[start : start + _ROWS])
            every_up = y_mm[:, None] - y
            row, disc = np.nonzero(np.abs(every_up) <= radius + np.float32(margin))
            middle, up, size, share = x[disc], every_up[row, disc], radius[disc], weight[disc]
            first, last = _columns_within(grid, middle, up, size + np.float32(margin))
            inner_first, inner_last = _columns_within(grid, middle, up, np.maximum(size - np.float32(margin), 0.0))
            none = np.flatnonzero(inner_first > inner_last)
            inner_first[none], inner_last[none] = last[none] + 1, last[none]
            crossing, column = _columns_near_edges(first, last, inner_first, inner_last)
            place = column + _in_int32(row * n_x)[crossing]
            level: IntArray = np.full(len(place), bright)  # a place exactly on the edge is inside
            if margin > 0.0:
                away_x = _in_single_precision(column)
                away_x *= np.float32(grid.width_mm / (n_x - 1))
                away_x -= middle[crossing]
                turn_there = turn[start : start + _ROWS].ravel()
                entry = self._nearest_entry_index(away_x, up[crossing], size[crossing], turn_there, place)
                level = nearest.reshape(-1)[entry]
            n_places, width = len(y_mm) * n_x, n_x + 1
            near = np.bincount(place * n_levels + level, share[crossing], n_places * n_levels)
            part = near.reshape(n_places, n_levels).astype(np.float64, copy=False)  # integers if there are no pairs
            begins = np.bincount(row * width + inner_first, share, minlength=len(y_mm) * width)
            ends = np.bincount(row * width + inner_last + 1, share, minlength=len(y_mm) * width)
            inside = np.cumsum((begins - ends).reshape(len(y_mm), width), axis=1)[:, :-1].ravel()
            outside = weight.sum() - inside - part.sum(axis=1)
            part[:, bright] += inside
            part[:, dark] += outside
            mass[start * n_x : start * n_x + n_places] = part
        return mass

    def _nearest_entry_index(
        self, x: FloatArray, y: FloatArray, radius: FloatArray, turn_rad: FloatArray, place: IntArray
    ) -> IntArray:
        """Return the index, in the flattened table, of the nearest entry for pairs of disc and place, (n_pairs,).

        `x`, `y`: the place relative to the disc's centre; `turn_rad`: orientation of the sensor at each place.
        """
        _, n_directions, n_distances = self.levels.shape
        step = np.sqrt(x * x + y * y) - radius
        if turn_rad.any():
            cosine, sine = (_in_single_precision(f(turn_rad))[place] for f in (np.cos, np.sin))
            x, y = cosine * x + sine * y, cosine * y - sine * x
        step += np.float32(self.margin_mm)
        step *= self._entries_per_mm
        step += 0.5
        turn = _pseudo_angle(x, y)
        turn *= (n_directions - 1) / 4.0
        turn += 0.5
        bend = (1.0 / radius - self.bend_per_mm[0]) * self._entries_per_curvature + 0.5
        entry = bend.astype(np.int32) * n_directions
        entry += turn.astype(np.int32)
        entry *= n_distances
        entry += step.astype(np.int32)
        return np.asarray(entry)

    @property
    def _entries_per_mm(self) -> float:
        return float((self.levels.shape[2] - 1) / (2.0 * self.margin_mm))

    @property
    def _entries_per_curvature(self) -> float:
        """Entries per unit of 1 / radius, 1 / mm."""
        return float((self.levels.shape[0] - 1) / (self.bend_per_mm[1] - self.bend_per_mm[0]))


def is_known_footprint_effect(effect: AnyEffect) -> bool:
    """Return whether an effect is known and changes the footprint equally everywhere, so that a table can hold it."""
    return isinstance(effect, Known) and effect.name in ("edge_blur", "halo")


def _columns_within(grid: Grid, middle: FloatArray, up: FloatArray, reach: FloatArray) -> tuple[IntArray, IntArray]:
    """Return the first and the last column within a distance of discs' centres; none if the first is the last + 1.

    `up`: height of a row above each centre. In single precision, which resolves a ten-thousandth of a millimetre.
    """
    per_mm = np.float32((grid.n_x - 1) / grid.width_mm)
    half = np.sqrt(np.maximum(reach * reach - up * up, 0.0))
    low, high = np.where(np.abs(up) < reach, middle - half, np.inf), middle + half
    last = _in_int32(np.floor(np.clip(high * per_mm, -1.0, grid.n_x - 1.0)))
    return np.minimum(_in_int32(np.ceil(np.clip(low * per_mm, 0.0, grid.n_x))), last + 1), last


def _columns_near_edges(
    first: IntArray, last: IntArray, inner_first: IntArray, inner_last: IntArray
) -> tuple[IntArray, IntArray]:
    """Pair crossings of a disc and a row with the columns in the ring: left of the interior, then right of it."""
    n = len(first)
    count = np.concatenate([inner_first - first, last - inner_last])
    begin = np.concatenate([first, inner_last + 1])
    # Repeating is the slow step: it is done once, and everything else is indexed.
    crossing = np.repeat(np.arange(2 * n), count)
    column = _in_int32(begin - np.cumsum(count) + count)[crossing]
    column += _in_int32(np.arange(len(crossing)))
    crossing[int(count[:n].sum()) :] -= n
    return crossing, column


def _in_single_precision(values: NDArray[Any]) -> FloatArray:
    """Round to single precision, which the type checker does not distinguish from double."""
    return cast(FloatArray, np.asarray(values, dtype=np.float32))


def _in_int32(values: NDArray[Any]) -> IntArray:
    """Truncate to 32-bit integers, which the type checker does not distinguish from 64-bit ones."""
    return cast(IntArray, values.astype(np.int32))


def _pseudo_angle(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return a pseudo-angle from 0 to 4 around the origin: it rises with the angle, but needs no trigonometry."""
    across = x / np.maximum(np.abs(x) + np.abs(y), _TINY)
    return np.asarray(2.0 - np.copysign(1.0 + across, y))


def _index_and_fraction(position: FloatArray, n: int) -> tuple[IntArray, FloatArray]:
    """Split positions in units of the spacing into the index below, of `n`, and the fraction to the next."""
    below = np.clip(position.astype(np.int64), 0, n - 2)
    return below, position - below


def _refined(readings: FloatArray) -> FloatArray:
    """Interpolate evenly spaced readings, constant beyond their ends, by the cubic through the four nearest.

    (n_bends, n_directions, n) -> (n_bends, n_directions, 4 (n - 1) + 1). SciPy's splines take long to import.
    """
    t = np.arange(_FINER) / _FINER
    cubics = -t * (t - 1) * (t - 2) / 6, (t * t - 1) * (t - 2) / 2, -t * (t + 1) * (t - 2) / 2, t * (t * t - 1) / 6
    nearest = sliding_window_view(np.pad(readings, ((0, 0), (0, 0), (1, 2)), mode="edge"), 4, axis=-1)
    return np.asarray((nearest @ np.stack(cubics)).reshape(*readings.shape[:2], -1)[..., : 1 - _FINER])


def _readings_around_disc(
    model: SensorModel, radius_mm: float, directions: FloatArray, distance_mm: FloatArray
) -> FloatArray:
    """Predict readings at distances from the edge of one disc, in each direction, (n_directions, n_distances)."""
    away = (radius_mm + distance_mm)[:, None] * directions[:, None, :]
    places = away.reshape(-1, 2)
    n = len(places)
    zero = np.zeros(n, dtype=np.int64)
    plan = Plan(
        places[:, 0],
        places[:, 1],
        orientation_rad=np.zeros(n),
        time_s=np.zeros(n),
        scan=zero,
        scan_names=("table",),
        pattern=zero,
        pattern_names=("table",),
    )
    predicted = model.predict(np.array([[0.0, 0.0, radius_mm]]), plan)
    return predicted.reshape(len(directions), len(distance_mm))


def _readings_outside_and_inside(model: SensorModel, radius_mm: float) -> tuple[float, float]:
    """Return the readings far outside and at the middle of a disc; raise ParameterError if they are equal."""
    east = np.array([[1.0, 0.0]])
    dark, bright = _readings_around_disc(model, radius_mm, east, np.array([1e4, -radius_mm]))[0]
    allowed = "two different levels: a sensor that tells the disc from its surroundings"
    require(dark != bright, "levels", (dark, bright), allowed)
    return float(dark), float(bright)


@dataclass(frozen=True, eq=False)
class DiscForecast:
    """A forecast for discs, by the table of the sensor's response; at cards, by predictions of at most 400 hypotheses.

    `model`: the sensor over the disc, and over the cards if there are any.
    """

    model: SensorModel
    table: DiscTable

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Predict noise-free readings, (n_samples, n_params) -> (n_samples, n_points); see `predict_where_visible`."""
        return predict_where_visible(self.model, theta, plan)

    def predictive(
        self, theta: FloatArray, weight: FloatArray, designs: Designs, plan: Plan, rows: IntArray, noise_sd: float
    ) -> PredictiveDistributions:
        """Return the predictive distribution at `rows`, of all hypotheses by the table; see `Forecast.predictive`."""
        table, grid = self.table, designs.grid
        levels = evenly_spaced_levels(table.dark, table.bright, noise_sd / _PER_SD, most=MOST_LEVELS)
        turns_rad = plan.orientation_rad.reshape(-1, grid.n_places)
        at_cards: IntArray = np.empty(0, dtype=np.int64)
        if isinstance(self.model, TabulatedChain) and cards_of(self.model.chain):
            part = plan.take(rows)
            shares = self.model.footprint_share_by_card(self.model.chain.poses(np.empty((1, 0)), part), part)
            at_cards = np.flatnonzero(sum(share[0] for share in shares) > _SHOWS)
        if at_cards.size:
            chosen, share = resampled_rows_and_weights(weight, MOST_PREDICTED)
            predicted = self.model.predict(theta[chosen], plan.take(rows[at_cards]))
            index, stands_for = nearest_level_index(predicted, levels).clip(0, len(levels) - 1), share / weight[chosen]

        def level_weights(weight: FloatArray) -> Iterator[tuple[IntArray, FloatArray]]:
            some = weight > 0
            stood, mass = None, np.empty(0)
            for number, at, places in rows_by_combination(rows, grid.n_places):
                turn = turns_rad[number]
                if stood is None or not np.array_equal(stood, turn):  # combinations of one orientation share the work
                    stood, mass = turn, table.level_histogram(theta[some], weight[some], grid, levels, turn)
                here = mass if len(places) == len(mass) else mass[places]
                if at_cards.size:
                    _, here_rows, card_rows = np.intersect1d(at, at_cards, return_indices=True)
                    here = here.copy()
                    here[here_rows] = weight_by_level(index[:, card_rows], weight[chosen] * stands_for, len(levels))
                yield at, here

        return PredictiveDistributions(levels, level_weights)


@dataclass(frozen=True, eq=False)
class TabulatedChain:
    """A chain over one disc that takes the seen white fraction from a table, and applies the other effects unchanged.

    No effect may change the disc itself, and effects on the footprint must be those of the table. Cards on the field
    are seen besides.
    """

    chain: Chain
    table: DiscTable

    @classmethod
    def of(cls, chain: Chain, plain: SensorModel) -> Self | None:
        """Make `chain` a chain over the table of `plain`, the same chain with fewer effects; None if impossible."""
        table = plain.table if isinstance(plain, TabulatedChain) else plain
        if not isinstance(table, DiscTable) or chain.names[:3] != table.names:
            return None
        seen = (effect for effect in chain.effects if effect.stage in (Stage.SCENE, Stage.FOOTPRINT))
        if not all(map(is_known_footprint_effect, seen)):
            return None
        return cls(chain, table)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the chain's parameters."""
        return self.chain.names

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Predict noise-free readings, (n_samples, n_params) -> (n_samples, n_points), by the table and the effects."""
        poses, disc, table = self.chain.poses(theta, plan), theta[:, :3], self.table
        level = table.predict_at(disc, poses.x_mm, poses.y_mm, poses.orientation_rad)
        seen = (level - table.dark) / (table.bright - table.dark)
        if cards := cards_of(self.chain):
            seen = mean_albedo_with_cards(seen, cards, self.footprint_share_by_card(poses, plan))
        edged = any(effect.stage == Stage.SEEN for effect in self.chain.effects)  # others need no regions from here on
        view = View(np.asarray(seen), poses, self.chain.scene.regions(disc) if edged else {})
        return self.chain.readings_from_simulated_view(view, theta, plan)

    def footprint_share_by_card(self, poses: Poses, plan: Plan) -> list[FloatArray]:
        """Return for each card the share of the footprint of a known mixture on it, (n_samples or 1, n_points)."""
        mixture = self.chain.ssf
        assert isinstance(mixture, FixedMixture)
        reach, footprint = footprint_reach_mm(mixture), mixture.footprint(np.empty((1, 0)))
        shares = []
        for card in cards_of(self.chain):
            out = np.zeros(np.broadcast_shapes(poses.x_mm.shape, poses.y_mm.shape))
            beside = np.abs(poses.x_mm - card.x_mm) < card.width_mm / 2 + reach
            within = beside & (np.abs(poses.y_mm - card.y_mm) < card.height_mm / 2 + reach)
            rows = np.flatnonzero(within.any(axis=0))
            if rows.size:
                there, part = Poses(*(a[:, rows] for a in poses.arrays)), plan.take(rows)
                layout = RegionsAndPoses(dict.fromkeys(part.pattern_names, card.region), there, part)
                out[:, rows] = response(layout, footprint, n_nodes=self.chain.n_nodes)
            shares.append(out)
        return shares


def forecast_of(model: SensorModel, *, highest: float | None = None) -> Forecast:
    """Choose the forecast for a model: by a table of discs if possible, else direct predictions.

    `highest` is the largest height of the sensor over that of its calibration; None: always the calibrated height.
    """
    chain = model if isinstance(model, Chain) else None
    if cards_of(model):
        if chain is not None and not chain.effects and highest is None:
            base = forecast_of(replace(chain, scene=HypothesisScene(chain.scene.shape)))  # type: ignore[attr-defined]
            if isinstance(base, DiscForecast):
                return DiscForecast(TabulatedChain(chain, base.table), base.table)
        return DirectForecast(model)
    table = DiscTable.of(model) if highest is None else None
    if table is not None:
        return DiscForecast(table if table.margin_mm else model, table)
    if highest is None and chain is not None and chain.effects:
        plain = DiscTable.of(replace(chain, effects=tuple(filter(is_known_footprint_effect, chain.effects))))
        return DirectForecast((plain and TabulatedChain.of(chain, plain)) or model)
    if chain is None or chain.effects:
        return DirectForecast(model)
    return DirectForecast(model, _N_PREDICTED, _PER_SD)
