"""Tabulated response of a known sensor to a disc: constant away from the edge, smooth near it.

The response to a disc depends on three numbers: the distance of the sensor from the edge, the direction of the edge in
the sensor's frame, and its curvature. The table is filled once by the sensor model; predictions are interpolations,
needed only in the ring about each edge, at a few hundred of many thousand places.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.interpolate import CubicSpline

from probewise._arrays import FloatArray, IntArray, read_only_floats
from probewise.effects import Known
from probewise.effects.optics import EdgeBlur, Halo
from probewise.errors import ParameterError
from probewise.inquiry.grid import Grid
from probewise.inquiry.scanlines import ROWS, Interval, PlacesNearEdges, ScanlineIntervals, to_single_precision
from probewise.recordings.plan import Plan
from probewise.scene import CardedScene, Circle, HypothesisScene
from probewise.sensor import Chain, FixedMixture, NaiveSensor
from probewise.sensor.commanded import led_state
from probewise.sensor.stages import AnyEffect, SensorModel, require_theta_columns

NAMES = ("x_mm", "y_mm", "radius_mm")

_COARSE_MM = 0.5  # spacing of distances at which the model is evaluated, for a cubic spline
_FINE_MM = 0.125  # spacing of entries
_PROBE_MM = 80.0  # largest distance from the edge that is evaluated
_FLAT = 1e-5  # share of the levels' difference below which a level counts as constant
_DIRECTIONS = 128
_BENDS = 8
_TINY = 1e-30


@dataclass(frozen=True, eq=False)
class DiscTable:
    """A sensor model over one disc, as a table: parameters x_mm, y_mm, radius_mm.

    Attributes
    ----------
    dark, bright
        Readings far outside and far inside.
    margin_mm
        Distance from the edge within which the level differs from `dark` or `bright`.
    bend_per_mm
        Least and greatest 1 / radius of the table.
    levels
        Noise-free readings, (n_bends, n_directions + 1, n_distances): evenly spaced in 1 / radius, in a pseudo-angle of
        the direction (0 to 4, rising with the angle; the last repeats the first), and in distance from -margin to
        margin.
    """

    dark: float
    bright: float
    margin_mm: float
    bend_per_mm: tuple[float, float]
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
        directions = _unit_vectors_of_pseudo_angles(np.linspace(0.0, 4.0, _DIRECTIONS, endpoint=False))
        margin = _distance_to_constant_reading_mm(model, low, high, directions[:: _DIRECTIONS // 16], dark, bright)
        if margin >= _PROBE_MM:
            return None
        coarse = np.linspace(-margin, margin, 2 * int(np.ceil(margin / _COARSE_MM)) + 1)
        fine = np.linspace(-margin, margin, 2 * int(np.ceil(margin / _FINE_MM)) + 1)
        asked = np.stack(
            [_readings_around_disc(model, 1.0 / b, directions, coarse) for b in np.linspace(*bends, _BENDS)]
        )
        asked = np.concatenate([asked, asked[:, :1]], axis=1)
        levels = np.ascontiguousarray(CubicSpline(coarse, asked, axis=-1)(fine))  # so that it is flat for free
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
        bend, along_bend = _index_and_fraction(
            (1.0 / theta[:, 2] - self.bend_per_mm[0]) * self._entries_per_curvature, n_bends
        )
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
        n_levels = len(levels)
        per_level = 1.0 / (levels[1] - levels[0])
        dark, bright = np.rint((np.array([self.dark, self.bright]) - levels[0]) * per_level).astype(np.int64).tolist()
        nearest = np.clip(np.rint((self.levels - levels[0]) * per_level), 0, n_levels - 1).astype(np.int16)
        margin = self._distance_to_constant_level_mm(nearest, (dark, bright))
        discs = to_single_precision(theta)
        mass = np.empty((grid.n_places, n_levels))
        turn = turn_rad.reshape(grid.n_y, grid.n_x)
        for start in range(0, grid.n_y, ROWS):
            y_mm = to_single_precision(grid.y_mm[start : start + ROWS])
            intervals = _intervals_of_discs(discs, grid, y_mm, margin)
            ring = intervals.places_near_edges()
            level: IntArray = np.full(len(ring.place), bright)  # a place exactly on the edge is inside
            if margin > 0.0:
                away = _DiscPlacePairs.of(discs, intervals, ring, y_mm, turn[start : start + ROWS].ravel())
                level = nearest.reshape(-1)[self._nearest_entry_index(away)]
            rows = slice(start * grid.n_x, (start + ROWS) * grid.n_x)
            mass[rows] = intervals.level_histogram(weight, ring, level, (dark, bright), n_levels)
        return mass

    def _distance_to_constant_level_mm(self, nearest: IntArray, ends: tuple[int, int]) -> float:
        """Return the distance from an edge beyond which the nearest level is constant.

        `nearest`: its index for each entry of the table; `ends`: that of the dark and the bright level.
        """
        if self.margin_mm == 0.0:
            return 0.0
        distance = np.linspace(-self.margin_mm, self.margin_mm, nearest.shape[2])
        off = (nearest != np.where(distance <= 0.0, ends[1], ends[0])).any(axis=(0, 1))
        return float(np.abs(distance[off]).max(initial=0.0))

    def _nearest_entry_index(self, away: _DiscPlacePairs) -> IntArray:
        """Return the index, in the flattened table, of the nearest entry for pairs of disc and place, (n_pairs,)."""
        _, n_directions, n_distances = self.levels.shape
        step = away.distance_mm + np.float32(self.margin_mm)
        step *= self._entries_per_mm
        step += 0.5
        turn = _pseudo_angle(away.x_mm, away.y_mm)
        turn *= (n_directions - 1) / 4.0
        turn += 0.5
        bend = (1.0 / away.radius_mm - self.bend_per_mm[0]) * self._entries_per_curvature + 0.5
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
    return isinstance(effect, Known) and isinstance(effect.effect, EdgeBlur | Halo)


def _intervals_of_discs(discs: FloatArray, grid: Grid, y_mm: FloatArray, margin_mm: float) -> ScanlineIntervals:
    """Return the intervals in which discs, (n_samples, 3), cross rows of a grid, (n_rows,), in single precision."""
    x, y, radius = discs.T
    every_up = y_mm[:, None] - y
    row, hypothesis = np.nonzero(np.abs(every_up) <= radius + np.float32(margin_mm))
    x, radius, up = x[hypothesis], radius[hypothesis], every_up[row, hypothesis]

    def interval_within(reach: FloatArray) -> Interval:
        half = np.sqrt(np.maximum(reach * reach - up * up, 0.0))
        return np.where(np.abs(up) < reach, x - half, np.inf), x + half

    outer = radius + np.float32(margin_mm)
    inner = np.maximum(radius - np.float32(margin_mm), 0.0)
    return ScanlineIntervals.from_interval_ends(
        grid, len(y_mm), row, hypothesis, interval_within(outer), interval_within(inner)
    )


@dataclass(frozen=True, eq=False)
class _DiscPlacePairs:
    """Pairs of a disc and a place near its edge, (n_pairs,) each.

    `x_mm`, `y_mm`: the place relative to the disc's centre, in the sensor's frame. `radius_mm`: the disc's.
    `distance_mm`: from the edge, positive outside.
    """

    x_mm: FloatArray
    y_mm: FloatArray
    radius_mm: FloatArray
    distance_mm: FloatArray

    @classmethod
    def of(
        cls,
        discs: FloatArray,
        intervals: ScanlineIntervals,
        ring: PlacesNearEdges,
        y_mm: FloatArray,
        turn_rad: FloatArray,
    ) -> Self:
        own = discs[intervals.hypothesis]
        up, radius = (y_mm[intervals.row] - own[:, 1])[ring.interval], own[:, 2][ring.interval]
        x = to_single_precision(ring.column)
        x *= np.float32(intervals.grid.width_mm / (intervals.grid.n_x - 1))
        x -= own[:, 0][ring.interval]
        distance = np.sqrt(x * x + up * up) - radius
        if turn_rad.any():
            cosine, sine = (to_single_precision(f(turn_rad))[ring.place] for f in (np.cos, np.sin))
            return cls(cosine * x + sine * up, cosine * up - sine * x, radius, distance)
        return cls(x, up, radius, distance)


def _pseudo_angle(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return a pseudo-angle from 0 to 4 around the origin: it rises with the angle, but needs no trigonometry."""
    across = x / np.maximum(np.abs(x) + np.abs(y), _TINY)
    return np.asarray(2.0 - np.copysign(1.0 + across, y))


def _unit_vectors_of_pseudo_angles(pseudo_angle: FloatArray) -> FloatArray:
    """Convert pseudo-angles to unit vectors, (n, 2)."""
    upper = pseudo_angle <= 2.0
    across = np.where(upper, 1.0 - pseudo_angle, pseudo_angle - 3.0)
    up = np.where(upper, 1.0, -1.0) * (1.0 - np.abs(across))
    return np.asarray(np.stack([across, up], axis=-1) / np.hypot(across, up)[:, None])


def _index_and_fraction(position: FloatArray, n: int) -> tuple[IntArray, FloatArray]:
    """Split positions in units of the spacing into the index below, of `n`, and the fraction to the next."""
    below = np.clip(position.astype(np.int64), 0, n - 2)
    return below, position - below


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
    if dark == bright:
        raise ParameterError(
            "levels", (dark, bright), "two different levels: a sensor that tells the disc from its surroundings"
        )
    return float(dark), float(bright)


def _distance_to_constant_reading_mm(
    model: SensorModel, low_mm: float, high_mm: float, directions: FloatArray, dark: float, bright: float
) -> float:
    """Return the distance from a disc's edge beyond which the reading is constant, for small and large discs alike."""
    margin = _COARSE_MM
    for radius in (low_mm, high_mm):
        distance = np.arange(-min(radius, _PROBE_MM), _PROBE_MM, _COARSE_MM)
        asked = _readings_around_disc(model, radius, directions, distance)
        off = np.abs(asked - np.where(distance <= 0.0, bright, dark)) > _FLAT * abs(bright - dark)
        margin = max(margin, float(np.abs(distance[off.any(axis=0)]).max(initial=0.0)) + _COARSE_MM)
    return margin
