"""Effects on the pose: where the sensor stands, and how it is turned, instead of where it was sent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.effect import (
    PHASE,
    ChangePointEffect,
    LinearEffect,
    NamedEffect,
    PeriodicEffect,
    ScanGroupEffect,
    WaveEffect,
    candidate_change_times_s,
    scans_in_words,
    sine_and_cosine_entries,
    single_column_bank,
)
from probewise.effects.priors import HeavyTailedPrior
from probewise.effects.reference import (
    CountsPlaceFromOrigin,
    CountsTimeFromOrigin,
    Extent,
    candidate_scan_groups,
    distinct_positions_mm,
    scan_indicator,
)
from probewise.priors import LogUniform, Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.commanded import height_ratio
from probewise.sensor.stages import Poses, Stage

_LARGE_SCALES = (-0.3, -0.1, 0.1, 0.3)
_UNIT_MM = 10.0
_MOST_PLACES = 160


@dataclass(frozen=True)
class Backlash(LinearEffect[Poses]):
    """Play in the gears: position = commanded position - (width_mm / 2) d, d the unit vector of the last motion.

    The width is positive: the arm lags behind the motion, never ahead.
    """

    typical_mm: float = 0.5

    name = "backlash"
    words = "backlash (play) of the arm"
    stage = Stage.POSE
    units = ("mm",)
    covariates = ("slope", "direction")
    parameters = ("width_mm",)
    positive = True

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        return cls(typical_mm=0.005 * extent.length_mm)

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        half_mm = theta[:, :1] / 2
        return replace(
            value,
            x_mm=value.x_mm - half_mm * plan.direction_of_motion[:, 0],
            y_mm=value.y_mm - half_mm * plan.direction_of_motion[:, 1],
        )

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the arm comes to rest {value_with_sd(mean[0], sd[0], factor=0.5)} mm short of where it was sent, "
            f"on the side it came from: gear play of {value_with_sd(mean[0], sd[0])} mm"
        )


@dataclass(frozen=True)
class PositionScale(CountsPlaceFromOrigin, LinearEffect[Poses]):
    """Motor steps of the wrong length: X (1 + x), Y (1 + y), from `origin`."""

    typical: float = 0.01

    name = "position_scale"
    words = "a wrong scale of the positions"
    stage = Stage.POSE
    units = ("1", "1")
    covariates = ("place", "slope")
    parameters = ("x", "y")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with its default scale: 1 % is a typical error, a wrong wheel size makes tens of %."""
        return cls(origin=extent.origin)

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        x_mm, y_mm = self.origin.x_mm, self.origin.y_mm
        return replace(
            value,
            x_mm=x_mm + (value.x_mm - x_mm) * (1 + theta[:, :1]),
            y_mm=y_mm + (value.y_mm - y_mm) * (1 + theta[:, 1:2]),
        )

    def bank(self) -> FloatArray:
        """Return five entries, (5, 2, 2): a small one, which the SSF's width may absorb, and four large ones."""
        return np.array([self.typical, *_LARGE_SCALES])[:, None, None] * np.eye(2)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the arm moves {value_with_sd(mean[0], sd[0], factor=100)} % too far along X and "
            f"{value_with_sd(mean[1], sd[1], factor=100)} % along Y: the scale of its positions is wrong"
        )


@dataclass(frozen=True)
class OrientationError(LinearEffect[Poses]):
    """The sensor is turned by deg more than was commanded, in all scans, anticlockwise."""

    typical_deg: float = 3.0  # of a mount set by eye

    name = "orientation_error"
    words = "a wrong sensor angle in all scans"
    stage = Stage.POSE
    units = ("deg",)
    covariates = ("orientation",)
    parameters = ("deg",)

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        return replace(value, orientation_rad=value.orientation_rad + np.radians(theta))

    def is_absorbed_by_ssf(self, plan: Plan) -> bool:
        """Return True: turning the sensor turns its SSF, so calibration absorbs it."""
        return True

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return f"in all scans the sensor is turned {_extra_turn_in_words(mean[0], sd[0])}"


@dataclass(frozen=True)
class ScanAngleError(ScanGroupEffect[Poses]):
    """The sensor is turned by deg more than was commanded in one mounting (scans of one orientation) or one scan."""

    typical_deg: float = 3.0

    name = "scan_angle_error"
    words = "a wrong sensor angle in some scans"
    stage = Stage.POSE
    units = ("deg",)
    covariates = ("scan", "orientation")
    parameters = ("deg",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        choices = candidate_scan_groups(extent.plan)
        return cls(choices=choices) if choices else None

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        return replace(
            value, orientation_rad=value.orientation_rad + np.radians(theta) * scan_indicator(plan, self.scans)
        )

    def bank(self) -> FloatArray:
        return single_column_bank(self.typical_deg * np.array([1.0, -8.0, 8.0, -14.0, 14.0]))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return f"in {scans_in_words(self.scans)} the sensor is turned {_extra_turn_in_words(mean[0], sd[0])}"


def _extra_turn_in_words(deg: float, sd: float) -> str:
    way = "anticlockwise" if deg > 0 else "clockwise"
    return f"{value_with_sd(abs(deg), sd)} degrees further {way} than commanded"


@dataclass(frozen=True)
class SensorTilt(LinearEffect[Poses]):
    """A tilt fixed in the lab frame: the footprint shifts by (dx_mm, dy_mm) = h tan(tilt) at any orientation.

    The shift is that at the description's height; it grows with a commanded one.
    """

    typical_mm: float = 0.3

    name = "sensor_tilt"
    words = "a tilted sensor"
    stage = Stage.POSE
    units = ("mm", "mm")
    covariates = ("orientation", "slope")
    parameters = ("dx_mm", "dy_mm")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        return cls(typical_mm=0.003 * extent.length_mm)

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        dx_mm, dy_mm = theta[:, :1], theta[:, 1:2]
        ratio = height_ratio(plan)
        if ratio is not None:
            dx_mm, dy_mm = dx_mm * ratio, dy_mm * ratio
        return replace(value, x_mm=value.x_mm + dx_mm, y_mm=value.y_mm + dy_mm)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the sensor's spot is off by {value_with_sd(mean[0], sd[0])} mm along X and "
            f"{value_with_sd(mean[1], sd[1])} mm along Y, whatever the orientation: the sensor is tilted"
        )


@dataclass(frozen=True)
class BentRails(CountsPlaceFromOrigin, LinearEffect[Poses]):
    """Quadratic and cubic position error of each axis: X + x2_mm (X / 10 mm)^2 + x3_mm (X / 10 mm)^3, likewise Y.

    In the powers X and Y count from `origin`.
    """

    typical_mm: float = 0.1

    name = "bent_rails"
    words = "bent rails"
    stage = Stage.POSE
    units = ("mm", "mm", "mm", "mm")
    covariates = ("place", "slope")
    parameters = ("x2_mm", "x3_mm", "y2_mm", "y3_mm")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        typical_mm = 0.005 * extent.length_mm / max(0.5 * extent.length_mm / _UNIT_MM, 1.0) ** 2
        return cls(typical_mm=typical_mm, origin=extent.origin)

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        x, y = (plan.x_mm - self.origin.x_mm) / _UNIT_MM, (plan.y_mm - self.origin.y_mm) / _UNIT_MM
        return replace(
            value,
            x_mm=value.x_mm + theta[:, :1] * x**2 + theta[:, 1:2] * x**3,
            y_mm=value.y_mm + theta[:, 2:3] * y**2 + theta[:, 3:4] * y**3,
        )

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        of_x, of_y = (value_with_sd(mean[k] + mean[k + 1], float(np.hypot(sd[k], sd[k + 1]))) for k in (0, 2))
        return f"the rails are bent: 10 mm from the origin the arm is off by {of_x} mm along X and {of_y} mm along Y"


@dataclass(frozen=True)
class MissingTooth(NamedEffect[Poses]):
    """A jump at one place of an axis, which shifts all positions beyond: X + amp_mm 1(X > at_mm), or likewise Y.

    `places_mm` are the recorded positions of each axis: between which two the jump lies (`between_mm`) is a discrete
    choice. `along` is 0 for X, 1 for Y.
    """

    typical_mm: float = 0.3
    places_mm: tuple[tuple[float, ...], tuple[float, ...]] = ((-100.0, 100.0), (-100.0, 100.0))
    along: int = 0
    between_mm: tuple[float, float] = (-100.0, 100.0)

    name = "missing_tooth"
    words = "a jump of the arm's position"
    stage = Stage.POSE
    units = ("mm", "mm", "1")
    covariates = ("place", "slope")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        places = tuple(_thinned_positions(axis) for axis in (extent.plan.x_mm, extent.plan.y_mm))
        return cls(0.005 * extent.length_mm, (places[0], places[1])) if any(len(own) > 2 for own in places) else None

    @cached_property
    def prior(self) -> Product:
        axis = Uniform(self.along - 0.5, self.along + 0.5)
        return Product({"amp_mm": HeavyTailedPrior(self.typical_mm), "at_mm": Uniform(*self.between_mm), "axis": axis})

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        along_y = theta[:, 2:3] > 0.5
        beyond = np.where(along_y, plan.y_mm, plan.x_mm) > theta[:, 1:2]
        jump = theta[:, :1] * beyond
        return replace(value, x_mm=value.x_mm + jump * ~along_y, y_mm=value.y_mm + jump * along_y)

    def variants(self) -> tuple[Self, ...]:
        return tuple(
            replace(self, along=axis, between_mm=pair) for axis in (0, 1) for pair in pairwise(self.places_mm[axis])
        )

    def bank(self) -> FloatArray:
        return np.array([[[self.typical_mm, sum(self.between_mm) / 2, float(self.along)]]])

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        axis = "Y" if mean[2] > 0.5 else "X"
        return (
            f"beyond {axis} = {value_with_sd(mean[1], sd[1])} mm the arm is {value_with_sd(mean[0], sd[0])} mm off "
            f"along {axis}: a tooth is missing"
        )


def _thinned_positions(axis_mm: FloatArray) -> tuple[float, ...]:
    """Return the distinct positions of one axis, sorted and thinned to at most 160."""
    places = distinct_positions_mm(axis_mm)
    stride = -(-len(places) // _MOST_PLACES)
    return tuple(places[::stride].tolist())


@dataclass(frozen=True)
class ArmKnock(ChangePointEffect[Poses]):
    """The arm is pushed: after at_s every position is off by (dx_mm, dy_mm) and the sensor is turned by turn_deg."""

    typical_mm: float = 0.3
    typical_deg: ClassVar[float] = 2.0

    name = "arm_knock"
    words = "an arm or sheet that was pushed"
    stage = Stage.POSE
    units = ("mm", "mm", "deg", "s")
    covariates = ("time", "slope")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        times = candidate_change_times_s(extent)
        return None if times is None else cls(times, typical_mm=0.005 * extent.length_mm)

    @property
    def typical_sizes(self) -> Mapping[str, float]:
        return {"dx_mm": self.typical_mm, "dy_mm": self.typical_mm, "turn_deg": self.typical_deg}

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        since = self.after_change_mask(theta, plan)
        return replace(
            value,
            x_mm=value.x_mm + theta[:, :1] * since,
            y_mm=value.y_mm + theta[:, 1:2] * since,
            orientation_rad=value.orientation_rad + np.deg2rad(theta[:, 2:3]) * since,
        )

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"from {value_with_sd(mean[3], sd[3])} s on, all positions are off by {value_with_sd(mean[0], sd[0])} mm "
            f"along X and {value_with_sd(mean[1], sd[1])} mm along Y, and the sensor is turned by "
            f"{value_with_sd(mean[2], sd[2])} degrees: the arm or the paper was pushed"
        )


@dataclass(frozen=True)
class SlowTurn(CountsTimeFromOrigin, LinearEffect[Poses]):
    """The sensor turns in its holder: orientation + deg_per_hour t, t the hours since `origin`."""

    typical_deg_per_hour: float = 2.0

    name = "slow_turn"
    words = "a sensor that slowly turns"
    stage = Stage.POSE
    units = ("deg/h",)
    covariates = ("time", "orientation")
    parameters = ("deg_per_hour",)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        return cls(typical_deg_per_hour=2.0 / (extent.duration_s / 3600), origin=extent.origin)

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        turn = np.deg2rad(theta[:, :1]) * self.origin.hours(plan)
        return replace(value, orientation_rad=value.orientation_rad + turn)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return f"the sensor turns by {value_with_sd(mean[0], sd[0])} degrees per hour: it is loose in its holder"


_ORDERS = np.arange(1, 7)  # harmonics of a sawtooth; the slip takes a sixth of the period


_SHARES = np.sinc(_ORDERS / 7) / _ORDERS * 2 / np.pi  # amplitude of each, damped against Gibbs overshoot


@dataclass(frozen=True)
class PeriodicPositionError(CountsPlaceFromOrigin, WaveEffect[Poses]):
    """A gear or lead screw that is not round: X + amp_mm sin(2 pi (X - X0) / period_mm + phase), X0 of `origin`."""

    typical_mm: float = 0.3
    shortest_mm: float = 3.0
    longest_mm: float = 200.0
    n_periods: int = 48

    name = "periodic_position_error"
    words = "a periodic position error of the arm"
    stage = Stage.POSE
    units = ("mm", "mm", "rad")
    covariates = ("place", "slope")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        shortest, reach = _shortest_period_and_range_mm(extent.plan)
        return cls(0.003 * extent.length_mm, shortest, 2 * reach, origin=extent.origin) if reach > 0 else None

    @cached_property
    def prior(self) -> Product:
        amp = HeavyTailedPrior(self.typical_mm, positive=True)
        return Product({"amp_mm": amp, "period_mm": LogUniform(self.shortest_mm, self.longest_mm), "phase": PHASE})

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        wave = np.sin(2 * np.pi / theta[:, 1:2] * (value.x_mm - self.origin.x_mm) + theta[:, 2:3])
        return replace(value, x_mm=value.x_mm + theta[:, :1] * wave)

    def bank(self) -> FloatArray:
        n_even = self.n_periods - 8
        waves = np.linspace(1.0, self.longest_mm / 2 / self.shortest_mm, n_even + 1)[1:]
        periods = np.append(self.longest_mm / 2 / waves, self.longest_mm / np.geomspace(1.05, 2.0, 8))
        return sine_and_cosine_entries(self.typical_mm, np.maximum(periods, self.shortest_mm * 1.001))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the arm's position along X is off by up to {value_with_sd(mean[0], sd[0])} mm, with a period of "
            f"{value_with_sd(mean[1], sd[1])} mm: a gear or lead screw is not round"
        )


@dataclass(frozen=True)
class StickSlip(CountsPlaceFromOrigin, PeriodicEffect[Poses]):
    """Stick-slip of the slide: X + amp_mm saw((X - X0) / period_mm + phase), a sawtooth of 1 to -1, X0 of `origin`."""

    typical_mm: float = 0.3
    shortest_mm: float = 3.0
    longest_mm: float = 25.0
    n_periods: int = 32
    n_phases: int = 6

    name = "stick_slip"
    words = "a slide that sticks and jumps"
    stage = Stage.POSE
    units = ("mm", "mm", "1")
    covariates = ("place", "slope")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        shortest, reach = _shortest_period_and_range_mm(extent.plan)
        if 0.25 * reach <= shortest:
            return None
        return cls(0.003 * extent.length_mm, shortest, 0.25 * reach, origin=extent.origin)

    @cached_property
    def prior(self) -> Product:
        period = LogUniform(self.shortest_mm, self.longest_mm)
        return Product({"amp_mm": HeavyTailedPrior(self.typical_mm), "period_mm": period, "phase": Uniform(-1.0, 1.0)})

    def apply(self, value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        turns = 2 * np.pi * ((value.x_mm - self.origin.x_mm) / theta[:, 1:2] + theta[:, 2:3])
        saw = sum(share * np.sin(order * turns) for order, share in zip(_ORDERS, _SHARES, strict=True))
        return replace(value, x_mm=value.x_mm + theta[:, :1] * saw)

    def bank(self) -> FloatArray:
        waves = np.linspace(1.0 / self.longest_mm, 1.0 / self.shortest_mm, self.n_periods + 2)[1:-1]
        periods, phases = np.meshgrid(1 / waves, np.arange(self.n_phases) / self.n_phases - 0.5, indexing="ij")
        return single_column_bank(self.typical_mm, periods.ravel(), phases.ravel())

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the slide sticks and then jumps by {value_with_sd(abs(mean[0]), sd[0], factor=2)} mm, once every "
            f"{value_with_sd(mean[1], sd[1])} mm along X: it lacks lubrication"
        )


def _shortest_period_and_range_mm(plan: Plan) -> tuple[float, float]:
    """Return three times the median step of X and the range of X, mm; 0 and 0 for fewer than eight positions."""
    x_mm = distinct_positions_mm(plan.x_mm)
    return (3 * float(np.median(np.diff(x_mm))), float(np.ptp(x_mm))) if len(x_mm) >= 8 else (0.0, 0.0)
