"""The arm's geometry: forward and inverse kinematics, and the limits of the joints.

A base turns about a vertical axis; an upper and a lower link move in a vertical plane that turns with the base.
Parallelograms keep the sensor looking straight down whatever the links do (paper: the trapezoidal linkage keeps it at
nadir); about the vertical, the sensor turns with the base alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.arm.instrument import Side
from probewise.errors import ReachError, ShapeError, require

JOINTS = ("base", "shoulder", "elbow")
"""The joints in the order of the columns of all arrays of angles."""

ROOM_COUNTS = 110
"""Counts that a motor may have to overshoot, to approach a place from the right side."""


@dataclass(frozen=True)
class Joint:
    """A joint and the motor that turns it."""

    port: int  # of the motor, 0 to 2 for A to C
    gear_ratio: float  # turns of the motor per turn of the joint; negative if they turn in opposite directions
    home_rad: float  # angle at which the motor's counter is 0
    low_rad: float  # limits of the angle
    high_rad: float
    play_rad: float = 0.0  # over which the joint is loose while its motor holds; 0 if its weight keeps it on one side
    stop_rad: float | None = None  # angle of a mechanical stop, at or beyond a limit, used to find home

    def __post_init__(self) -> None:
        low, high = _rounded_degrees(self.low_rad, self.high_rad)
        require(self.port in (0, 1, 2), "port", self.port, "0 to 2, for A to C")
        usable = math.isfinite(self.gear_ratio) and abs(self.gear_ratio) >= 0.1
        require(usable, "gear_ratio", self.gear_ratio, "a finite number, 0.1 or more in magnitude")
        ordered = -2 * math.pi <= self.low_rad < self.high_rad <= 2 * math.pi
        require(ordered, "low_deg, high_deg", (low, high), "-360 to 360, the low one below the high")
        within = self.low_rad <= self.home_rad <= self.high_rad
        allowed = f"an angle between low_deg and high_deg, {low:g} to {high:g}"
        require(within, "home_deg", math.degrees(self.home_rad), allowed)
        small = 0 <= self.play_rad < self.high_rad - self.low_rad
        require(small, "play_deg", math.degrees(self.play_rad), "0 or more, less than the joint's range")
        if (stop := self.stop_rad) is not None:
            beyond = -2 * math.pi <= stop <= self.low_rad or self.high_rad <= stop <= 2 * math.pi
            require(beyond, "stop_deg", math.degrees(stop), "low_deg or less, or high_deg or more, within -360 to 360")

    @property
    def counts_per_rad(self) -> float:
        """Motor counts (degrees of its shaft) per radian of the joint."""
        return math.degrees(self.gear_ratio)

    @property
    def stop_side(self) -> Side | None:
        """1 for a stop at or beyond the upper limit, -1 at or beyond the lower one; None without a stop."""
        if self.stop_rad is None:
            return None
        return 1 if self.stop_rad >= self.high_rad else -1

    @property
    def stop_counts(self) -> int:
        """Motor count with the joint, which has a stop, at that stop."""
        assert self.stop_rad is not None
        assert self.stop_side is not None
        return self.counts_at(self.stop_rad, self.stop_side)

    def counts_at(self, angle_rad: float, side: int = 0) -> int:
        """Return the motor count that puts the joint at an angle, approached with the angle rising (1) or falling (-1).

        The joint lags behind its motor by half the play; with side 0 it is in the middle of the play, as at home.
        """
        return round((angle_rad + side * self.play_rad / 2 - self.home_rad) * self.counts_per_rad)

    def angle_at(self, counts: float, side: int = 0) -> float:
        """Return the joint angle, in radians, at a motor count reached from `side`: the inverse of `counts_at`."""
        return self.home_rad + counts / self.counts_per_rad - side * self.play_rad / 2


UNMEASURED_RAD = math.radians(2.0)
"""Largest error of home angles of the links set by eye."""

N_FITTED = 9  # numbers of a geometry that marks determine

FIELD_STEPS = 12  # places along each side of the field at which errors are worked out


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of a geometry fitted to a number of marks."""

    marks: int
    place_sd_mm: float  # of the sensor's place along x and y, root mean square over the field
    height_sd_mm: float  # of the sensor's height, the largest over the field
    scale_sd: float  # of the ratio of true lengths on the field to lengths as the arm measures them
    covariance: tuple[tuple[float, ...], ...]  # of the errors of the parameters `FITTED`, nine rows; radians, mm

    def __post_init__(self) -> None:
        require(self.marks >= 1, "marks", self.marks, "1 or more")
        for name in ("place_sd_mm", "height_sd_mm", "scale_sd"):
            require(0 <= getattr(self, name) < math.inf, name, getattr(self, name), "0 or more")
        shape, square = [len(row) for row in self.covariance], [N_FITTED] * N_FITTED
        require(shape == square, "covariance", f"rows of {shape}", f"{N_FITTED} rows of {N_FITTED} numbers")
        matrix = np.array(self.covariance)
        symmetric = np.isfinite(matrix).all() and np.allclose(matrix, matrix.T, rtol=1e-6, atol=1e-12)
        require(symmetric, "covariance", "a matrix that differs from its transpose", "a symmetric matrix")
        sds = np.sqrt(np.maximum(np.diagonal(matrix), np.finfo(np.float64).tiny))
        positive = np.linalg.eigvalsh(matrix / np.outer(sds, sds)).min() >= -1e-6
        require(positive, "covariance", "a matrix with negative eigenvalues", "a covariance: none is negative")


@dataclass(frozen=True)
class Geometry:
    """All dimensions of the arm; `read_geometry` reads them from a file. Pairs of a place are x and y, lab frame."""

    field_mm: tuple[float, float]  # width and height of the field; its lower left corner is the lab frame's origin
    axis_mm: tuple[float, float]  # place of the base's vertical axis
    shoulder_mm: tuple[float, float]  # of the shoulder's axis: forward of the base's axis, and above the surface
    links_mm: tuple[float, float]  # upper link, shoulder to elbow, and lower link, elbow to wrist
    elbow_is_relative: bool  # whether the elbow's angle counts from the upper link; otherwise, from the horizontal
    sensor_port: int  # 0 to 3, for inputs 1 to 4
    sensor_mm: tuple[float, float]  # from the wrist forward to the sensor's origin, and down to its face
    mounting_rad: float  # the sensor's orientation is this plus the base's angle minus a right angle
    read_height_mm: float  # heights of the sensor's face above the surface: when reading, ...
    travel_height_mm: float  # ... when moving,
    lowest_mm: float  # ... and the lowest allowed
    base: Joint
    shoulder: Joint
    elbow: Joint
    whole_percent: bool = True  # whether readings are truncated to whole percent, as the brick shows them
    accuracy: Accuracy | None = None  # of a geometry fitted to marks
    light_per_mm: float | None = None  # fall of readings over white per mm of height; None: with the height's square

    def __post_init__(self) -> None:
        finite = (*self.field_mm, *self.axis_mm, *self.shoulder_mm, *self.links_mm, *self.sensor_mm, self.mounting_rad)
        require(all(math.isfinite(number) for number in finite), "geometry", finite, "finite numbers")
        for name, value in (("field_mm", min(self.field_mm)), ("links_mm", min(self.links_mm))):
            require(value > 0, name, value, "greater than 0")
        heights = lowest, read, travel = self.lowest_mm, self.read_height_mm, self.travel_height_mm
        names, rising = "lowest_mm, read_height_mm, travel_height_mm", 0 < lowest < read < travel < math.inf
        require(rising, names, heights, "heights above 0, each above the one before")
        falls = self.light_per_mm is None or 0 <= self.light_per_mm < 1
        require(falls, "light_per_mm", self.light_per_mm, "0 or more, less than 1")
        require(self.sensor_port in range(4), "sensor port", self.sensor_port, "0 to 3, for 1 to 4")
        ports = tuple("ABC"[joint.port] for joint in self.joints)
        require(len({*ports}) == len(ports), "ports", ports, "a port of its own for each joint")
        if any(joint.stop_rad is not None for joint in (self.shoulder, self.elbow)):
            ends = [[joint.home_rad if joint.stop_rad is None else joint.stop_rad for joint in self.joints]]
            height_mm = float(self.position_mm(np.array(ends))[0, 2])
            allowed = (
                f"stops of the links at which the sensor is {travel:g} mm up or more, not {height_mm:.0f} mm: on the "
                "way there nothing else guards it"
            )
            require(height_mm >= travel, "stop_deg", _rounded_degrees(*ends[0]), allowed)

    @property
    def joints(self) -> tuple[Joint, Joint, Joint]:
        """Base, shoulder and elbow."""
        return self.base, self.shoulder, self.elbow

    @property
    def rest_mm(self) -> tuple[float, float]:
        """Place (x, y) of the sensor when all joints are at home."""
        x_mm, y_mm, _ = self.position_mm(np.array([[joint.home_rad for joint in self.joints]]))[0]
        return float(x_mm), float(y_mm)

    @property
    def max_height_error_mm(self) -> float:
        """Largest amount by which the sensor may be lower than commanded.

        Two sds of the height if the geometry was fitted; otherwise that of two degrees of error in both links' home
        angles.
        """
        if self.accuracy is not None:
            return 2 * self.accuracy.height_sd_mm
        rises = np.abs(self.height_slopes_mm_rad(self.angles_rad(self.reachable_grid_mm, self.read_height_mm)))
        return float(rises.sum(axis=-1).max(initial=0.0) * UNMEASURED_RAD)

    @property
    def reachable_grid_mm(self) -> FloatArray:
        """Places, (n, 2), of a 12 by 12 grid over the field at which the sensor can read."""
        sides = [np.linspace(0.0, side, FIELD_STEPS + 1)[:-1] + side / (2 * FIELD_STEPS) for side in self.field_mm]
        places = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
        return places[self.contains(places)]

    def position_mm(self, angles_rad: FloatArray) -> FloatArray:
        """Compute x, y and height of the sensor's face, (n, 3), lab frame, from joint angles, (n, 3)."""
        return _position_mm(self, angles_rad, self.links_mm, self.axis_mm, self.shoulder_mm)

    def joints_from_side_mm(self, shoulder_rad: float, elbow_rad: float) -> list[FloatArray]:
        """Return shoulder, elbow, wrist and sensor's face as distance from the base's axis and height, (2,) each."""
        lower_rad = shoulder_rad + elbow_rad if self.elbow_is_relative else elbow_rad
        joints = [np.array(self.shoulder_mm)]
        for length_mm, turn in zip(self.links_mm, (shoulder_rad, lower_rad), strict=True):
            joints.append(joints[-1] + length_mm * np.array([np.cos(turn), np.sin(turn)]))
        return [*joints, joints[-1] + [self.sensor_mm[0], -self.sensor_mm[1]]]

    def height_slopes_mm_rad(self, angles_rad: FloatArray) -> FloatArray:
        """Return the derivative of the sensor's height by each joint angle, (n, 3), at joint angles, (n, 3)."""
        _, shoulder, elbow = np.moveaxis(_checked_rows(angles_rad, 3), -1, 0)
        lower = shoulder + elbow if self.elbow_is_relative else elbow
        upper_rise, lower_rise = self.links_mm[0] * np.cos(shoulder), self.links_mm[1] * np.cos(lower)
        both = upper_rise + lower_rise if self.elbow_is_relative else upper_rise
        return np.stack([np.zeros_like(both), both, lower_rise], axis=-1)

    def angles_rad(self, places_mm: FloatArray, height_mm: float) -> FloatArray:
        """Solve the inverse kinematics, elbow up, for places, (n, 2), lab frame, and a height of the sensor's face.

        Returns joint angles, shape (n, 3); NaN for places too far, too near, or beyond a joint's limits.
        """
        places = _checked_rows(places_mm, 2)
        dx, dy = places[:, 0] - self.axis_mm[0], places[:, 1] - self.axis_mm[1]
        # Any equivalent angle within the base's limits will do: -190 and 170 degrees are one direction.
        base = self.base.low_rad + np.mod(np.arctan2(dy, dx) - self.base.low_rad, 2 * math.pi)
        out = np.hypot(dx, dy) - self.shoulder_mm[0] - self.sensor_mm[0]
        up = height_mm + self.sensor_mm[1] - self.shoulder_mm[1]
        upper_mm, lower_mm = self.links_mm
        span = np.hypot(out, up)
        rise = np.arctan2(up, out)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # arccos beyond 1: too far or too near
            shoulder = rise + np.arccos((upper_mm**2 + span**2 - lower_mm**2) / (2 * upper_mm * span))
            lower = rise - np.arccos((lower_mm**2 + span**2 - upper_mm**2) / (2 * lower_mm * span))
        elbow = lower - shoulder if self.elbow_is_relative else lower
        angles = np.stack([base, shoulder, elbow], axis=-1)
        angles[~self.are_within_joint_limits(angles)] = np.nan
        return angles

    def contains(self, places_mm: FloatArray) -> BoolArray:
        """Return which places, (n, 2), are on the field and in reach with room for the motors to overshoot: (n,)."""
        places = _checked_rows(places_mm, 2)
        on_field = ((places >= 0) & (places <= self.field_mm)).all(axis=-1)
        return np.asarray(on_field & self._room_to_approach_mask(places))

    def are_within_joint_limits(self, angles_rad: FloatArray) -> BoolArray:
        """Return which rows of joint angles, (n, 3), are within all joints' limits, shape (n,); NaN is outside."""
        angles = _checked_rows(angles_rad, 3)
        low = np.array([joint.low_rad for joint in self.joints])
        high = np.array([joint.high_rad for joint in self.joints])
        with np.errstate(invalid="ignore"):
            return np.asarray(((angles >= low) & (angles <= high)).all(axis=-1))

    def orientation_rad(self, places_mm: FloatArray) -> FloatArray:
        """Return the sensor's orientation at places, (n, 2): mounting + base - a right angle, (n,), -pi to pi."""
        places = _checked_rows(places_mm, 2)
        base = np.arctan2(places[:, 1] - self.axis_mm[1], places[:, 0] - self.axis_mm[0])
        return wrapped_to_pi(self.mounting_rad + base - math.pi / 2)

    def sentence(self) -> str:
        """Describe the allowed places in words."""
        (width, height), (x_mm, y_mm), (nearest, farthest) = self.field_mm, self.axis_mm, self.radii_in_reach_mm()
        return (
            f"a place on the field, 0 to {width:g} mm by 0 to {height:g} mm, that is {nearest:.0f} to "
            f"{farthest:.0f} mm from the arm's axis at ({x_mm:g}, {y_mm:g}) mm, within its joints' limits"
        )

    def _room_to_approach_mask(self, places_mm: FloatArray) -> BoolArray:
        """Return which places, (n, 2), leave each motor `ROOM_COUNTS` both ways, at reading and travel height: (n,)."""
        room = np.array([ROOM_COUNTS / abs(joint.counts_per_rad) for joint in self.joints])
        read, travel = (self.angles_rad(places_mm, height) for height in (self.read_height_mm, self.travel_height_mm))
        roomy = [self.are_within_joint_limits(angles + sign * room) for angles in (read, travel) for sign in (-1, 1)]
        return np.asarray(np.all(roomy, axis=0))

    def radii_in_reach_mm(self) -> tuple[float, float]:
        """Return the least and the greatest distance from the axis in reach, in whole mm; NaN: none is."""
        middle = (self.base.low_rad + self.base.high_rad) / 2
        away = np.arange(1.0, self.shoulder_mm[0] + sum(self.links_mm) + self.sensor_mm[0] + 1.0)
        places = self.axis_mm + away[:, None] * [math.cos(middle), math.sin(middle)]
        within = away[self._room_to_approach_mask(places)]
        return (float(within[0]), float(within[-1])) if within.size else (math.nan, math.nan)


N_CHECKED = 33  # points checked along a move


class SoftLimits:
    """Allowed range of each joint and of the sensor's height; moves are checked from the motors' last counts."""

    def __init__(self, geometry: Geometry) -> None:
        self._geometry = geometry
        self._counts = [0, 0, 0]

    def record_present_count(self, joint: int, count: int) -> None:
        """Record the present count of one joint's motor."""
        self._counts[joint] = count

    @property
    def last_counts(self) -> tuple[int, int, int]:
        """Last recorded counts of the motors: base, shoulder, elbow; 0 at the start."""
        base, shoulder, elbow = self._counts
        return base, shoulder, elbow

    def heights_along_move_mm(self, counts: Sequence[int], joint: int, to: int, here: int | None = None) -> FloatArray:
        """Return the sensor's height at 33 points along a move of one joint to the count `to`, shape (33,).

        `counts` are those of all motors at the start, but for the moving joint's where `here` is given.
        """
        joints = self._geometry.joints
        way = np.empty((N_CHECKED, 3))
        way[:] = [mechanics.angle_at(count) for mechanics, count in zip(joints, counts, strict=True)]
        start = joints[joint].angle_at(counts[joint] if here is None else here)
        way[:, joint] = np.linspace(start, joints[joint].angle_at(to), N_CHECKED)
        return np.asarray(self._geometry.position_mm(way)[:, 2])

    def require_allowed_move(self, joint: int, here: int, to: int) -> None:
        """Raise ReachError if a move of one joint from count `here` to `to` leaves the allowed range.

        The others are at rest. A joint beyond its limits may move back, and a sensor below the lowest height may rise.
        """
        geometry, mechanics = self._geometry, self._geometry.joints[joint]
        angle, start = mechanics.angle_at(to), mechanics.angle_at(here)
        low, high = min(mechanics.low_rad, start), max(mechanics.high_rad, start)
        if not low <= angle <= high:
            allowed = f"{math.degrees(mechanics.low_rad):g} to {math.degrees(mechanics.high_rad):g} degrees"
            raise ReachError(JOINTS[joint], f"{math.degrees(angle):.1f} degrees", allowed)
        heights = self.heights_along_move_mm(self.last_counts, joint, to, here)
        if heights.min() < min(geometry.lowest_mm, float(heights[0])):
            moving = f"the sensor's height while the {JOINTS[joint]} moves"
            allowed = f"{geometry.lowest_mm:g} mm or more; is the arm where its counters say? home it"
            raise ReachError(moving, f"{heights.min():.0f} mm", allowed)


def _position_mm(arm: Geometry, angles_rad: FloatArray, links_mm: Any, axis_mm: Any, shoulder_mm: Any) -> FloatArray:
    """Compute x, y and height of the sensor's face, (n, 3), from joint angles, (n, 3), and pairs of other lengths."""
    base, shoulder, elbow = np.moveaxis(_checked_rows(angles_rad, 3), -1, 0)
    lower = shoulder + elbow if arm.elbow_is_relative else elbow
    away = shoulder_mm[0] + links_mm[0] * np.cos(shoulder) + links_mm[1] * np.cos(lower) + arm.sensor_mm[0]
    height = shoulder_mm[1] + links_mm[0] * np.sin(shoulder) + links_mm[1] * np.sin(lower) - arm.sensor_mm[1]
    return np.stack([axis_mm[0] + away * np.cos(base), axis_mm[1] + away * np.sin(base), height], axis=-1)


def wrapped_to_pi(angle_rad: FloatArray) -> FloatArray:
    """Wrap angles, of any shape, to -pi to pi."""
    return np.asarray(np.mod(angle_rad + math.pi, 2 * math.pi) - math.pi)


def _checked_rows(values: FloatArray, n: int) -> FloatArray:
    rows = np.asarray(values, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != n:
        raise ShapeError(f"the rows have shape {rows.shape}; allowed: (n, {n})")
    return rows


def _rounded_degrees(*angles_rad: float) -> tuple[float, ...]:
    return tuple(round(math.degrees(angle), 6) for angle in angles_rad)


FITTED = (
    *("base home", "shoulder home", "elbow home", "upper link", "lower link"),
    *("base x", "base y", "shoulder forward", "shoulder height"),
)
"""Fitted parameters, angles in radians, lengths in mm; the sensor's own lengths are collinear with the shoulder's."""

RULER_SDS = np.array([*np.radians([5.0, 5.0, 5.0]), 5.0, 5.0, 10.0, 10.0, 10.0, 10.0])
"""Prior sd of each, as measured with a ruler and by eye."""


def fitted_parameter_values(geometry: Geometry) -> FloatArray:
    """Return the values of the parameters `FITTED`, (9,)."""
    homes = [joint.home_rad for joint in geometry.joints]
    return np.array([*homes, *geometry.links_mm, *geometry.axis_mm, *geometry.shoulder_mm])


def places_at_parameters(geometry: Geometry, values: FloatArray, turned_rad: FloatArray) -> FloatArray:
    """Return x, y, height of the sensor, (n, 3), for values of `FITTED`, (9,), and joint angles from home, (n, 3)."""
    return _position_mm(geometry, values[:3] + turned_rad, values[3:5], values[5:7], values[7:9])


def place_jacobian(geometry: Geometry, places_mm: FloatArray) -> FloatArray:
    """Return the derivatives of x, y and height by each parameter `FITTED`, joint angles from home fixed: (n, 3, 9).

    `places_mm`, (n, 2), are places of the sensor by the geometry, at the reading height; NaN at one out of reach.
    """
    values = fitted_parameter_values(geometry)
    turned = geometry.angles_rad(places_mm, geometry.read_height_mm) - values[:3]
    slopes = np.empty((len(turned), 3, len(values)))
    for k, step in enumerate(RULER_SDS * 1e-4):
        up, down = values.copy(), values.copy()
        up[k] += step
        down[k] -= step
        above, below = places_at_parameters(geometry, up, turned), places_at_parameters(geometry, down, turned)
        slopes[:, :, k] = (above - below) / (2 * step)
    return slopes
