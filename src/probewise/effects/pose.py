"""Effects on the pose: where the sensor stands, and how it is turned, instead of where it was sent."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import cast

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.effect import (
    AMPLITUDE,
    PHASE,
    POSITIVE,
    Declared,
    Effect,
    LightEffect,
    WaveEffect,
    acting,
    in_words,
    light_effect,
    one_of,
    scans_in_words,
    sine_and_cosine_entries,
    single_column_bank,
)
from probewise.effects.reference import (
    Extent,
    candidate_scan_groups,
    distinct_positions_mm,
    scan_indicator,
    sign_of_change,
)
from probewise.priors import LogUniform, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.commanded import height_ratio
from probewise.sensor.stages import Poses, Stage

_STILL_MM = 1e-6  # a smaller step of an axis is rounding
_TURN_DEG = 3.0  # of a mount set by eye
_FURTHER = "{|0|} degrees further {anticlockwise/clockwise} than commanded"
_UNIT_MM = 10.0
_MOST_PLACES = 160
_N_PERIODS, _N_LONG = 40, 8  # of the bank of a periodic error, within the range and longer
_N_WAVES, _N_PHASES = 32, 6  # of the bank of stick-slip
_ORDERS = np.arange(1, 7)  # harmonics of a sawtooth; the slip takes a sixth of the period
_SHARES = np.sinc(_ORDERS / 7) / _ORDERS * 2 / np.pi  # amplitude of each, damped against Gibbs overshoot


def _moved(poses: Poses, dx_mm: FloatArray, dy_mm: FloatArray) -> Poses:
    return replace(poses, x_mm=poses.x_mm + dx_mm, y_mm=poses.y_mm + dy_mm)


def _turned(poses: Poses, turn_rad: FloatArray) -> Poses:
    return replace(poses, orientation_rad=poses.orientation_rad + turn_rad)


@light_effect("backlash", Stage.POSE, "backlash (play) of the arm", ("slope", "direction"))
def backlash(kind: LightEffect, of: Extent) -> Effect:
    """Play in the gears: position = commanded position - (width_mm / 2) d, d the unit vector of the last motion.

    The width is positive: the arm lags behind the motion, never ahead.
    """

    def says(mean: FloatArray, sd: FloatArray) -> str:
        half, whole = (value_with_sd(mean[0], sd[0], factor=factor) for factor in (0.5, 1.0))
        side = f"{half} mm short of where it was sent, on the side it came from"
        return f"the arm comes to rest {side}: gear play of {whole} mm"

    act = acting(lambda value, plan, width: _moved(value, *(-(width / 2) * d for d in plan.direction_of_motion.T)))
    return kind.bind(of, {"width_mm": (POSITIVE, "mm")}, act, says, typical=of.small_play_mm)


@light_effect("backlash", Stage.POSE, "backlash (play) of each axis", ("slope", "direction"))
def play_of_axes(kind: LightEffect, of: Extent) -> Effect:
    """Play in the gears of each axis: position = commanded - (width_mm / 2) s, s the side it last moved to."""

    def act(value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        sides = sign_of_change(np.stack([plan.x_mm, plan.y_mm]), plan.rows_by_scan(), still=_STILL_MM)
        return _moved(value, *(-(theta[:, :1] / 2) * side for side in sides))

    along_motion = cast(Effect, backlash.build(kind, of))
    return replace(along_motion, apply=act, binding=replace(along_motion.binding, form="of each axis"))


@light_effect("position_scale", Stage.POSE, "a wrong scale of the positions", ("place", "slope"), counts="place")
def position_scale(kind: LightEffect, of: Extent) -> Effect:
    """Motor steps of the wrong length: X (1 + x), Y (1 + y), from the origin.

    1 % is a typical error, which the SSF's width may absorb; a wrong wheel size makes tens of %.
    """
    x_mm, y_mm = of.origin.x_mm, of.origin.y_mm

    def act(value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        x, y = x_mm + (value.x_mm - x_mm) * (1 + theta[:, :1]), y_mm + (value.y_mm - y_mm) * (1 + theta[:, 1:2])
        return replace(value, x_mm=x, y_mm=y)

    says = "the arm moves {0} % too far along X and {1} % along Y: the scale of its positions is wrong"
    words = in_words(says, factors=(100, 100))
    sizes = np.array([1, -30, -10, 10, 30])[:, None, None] * np.eye(2)
    return kind.bind(of, {"x": (AMPLITUDE, "1"), "y": (AMPLITUDE, "1")}, act, words, sizes, typical=0.01)


_TURNED = "a wrong sensor angle in all scans"


@light_effect("orientation_error", Stage.POSE, _TURNED, ("orientation",), is_absorbed_by_ssf=lambda plan: True)
def orientation_error(kind: LightEffect, of: Extent) -> Effect:
    """The sensor is turned by deg more than was commanded, in all scans, anticlockwise: its SSF absorbs this."""
    says = in_words(f"in all scans the sensor is turned {_FURTHER}")
    act = acting(lambda value, plan, deg: _turned(value, np.radians(deg)))
    return kind.bind(of, {"deg": (AMPLITUDE, "deg")}, act, says, typical=_TURN_DEG)


@light_effect("scan_angle_error", Stage.POSE, "a wrong sensor angle in some scans", ("scan", "orientation"))
def scan_angle_error(kind: LightEffect, of: Extent) -> Effect | None:
    """The sensor is turned by deg more than was commanded in one mounting (scans of one orientation) or one scan."""

    def in_scans(scans: tuple[str, ...]) -> Effect:
        act = acting(lambda value, plan, deg: _turned(value, np.radians(deg) * scan_indicator(plan, scans)))
        says = in_words(f"in {scans_in_words(scans)} the sensor is turned {_FURTHER}")
        sizes = single_column_bank(np.array([1, -8, 8, -14, 14]))
        return kind.bind(of, {"deg": (AMPLITUDE, "deg")}, act, says, sizes, typical=_TURN_DEG, scans=scans)

    return one_of([in_scans(scans) for scans in candidate_scan_groups(of.plan)])


@light_effect("sensor_tilt", Stage.POSE, "a tilted sensor", ("orientation", "slope"))
def sensor_tilt(kind: LightEffect, of: Extent) -> Effect:
    """A tilt fixed in the lab frame: the footprint shifts by (dx_mm, dy_mm) = h tan(tilt) at any orientation.

    The shift is that at the description's height; it grows with a commanded one.
    """

    def act(value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        ratio = height_ratio(plan)
        return _moved(value, *(theta[:, k : k + 1] if ratio is None else theta[:, k : k + 1] * ratio for k in (0, 1)))

    off = "the sensor's spot is off by {0} mm along X and {1} mm along Y"
    says = in_words(f"{off}, whatever the orientation: the sensor is tilted")
    return kind.bind(of, {"dx_mm": (AMPLITUDE, "mm"), "dy_mm": (AMPLITUDE, "mm")}, act, says, typical=of.small_shift_mm)


@light_effect("bent_rails", Stage.POSE, "bent rails", ("place", "slope"), counts="place")
def bent_rails(kind: LightEffect, of: Extent) -> Effect:
    """Quadratic and cubic position error of each axis: X + x2_mm (X / 10 mm)^2 + x3_mm (X / 10 mm)^3, likewise Y.

    In the powers X and Y count from the origin.
    """

    def act(value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        x, y = (plan.x_mm - of.origin.x_mm) / _UNIT_MM, (plan.y_mm - of.origin.y_mm) / _UNIT_MM
        x_mm = value.x_mm + theta[:, :1] * x**2 + theta[:, 1:2] * x**3
        return replace(value, x_mm=x_mm, y_mm=value.y_mm + theta[:, 2:3] * y**2 + theta[:, 3:4] * y**3)

    def says(mean: FloatArray, sd: FloatArray) -> str:
        of_x, of_y = (value_with_sd(mean[k] + mean[k + 1], float(np.hypot(sd[k], sd[k + 1]))) for k in (0, 2))
        return f"the rails are bent: 10 mm from the origin the arm is off by {of_x} mm along X and {of_y} mm along Y"

    typical_mm = of.small_play_mm / max(0.5 * of.length_mm / _UNIT_MM, 1.0) ** 2
    sizes: Declared = dict.fromkeys(("x2_mm", "x3_mm", "y2_mm", "y3_mm"), (AMPLITUDE, "mm"))
    return kind.bind(of, sizes, act, says, typical=typical_mm)


@light_effect("missing_tooth", Stage.POSE, "a jump of the arm's position", ("place", "slope"))
def missing_tooth(kind: LightEffect, of: Extent) -> Effect | None:
    """A jump at one place of an axis, which shifts all positions beyond: X + amp_mm 1(X > at_mm), or likewise Y.

    Between which two of the recorded positions of an axis it lies is a discrete choice; `axis` is 0 for X, 1 for Y.
    """

    def act(value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        along_y = theta[:, 2:3] > 0.5
        jump = theta[:, :1] * (np.where(along_y, plan.y_mm, plan.x_mm) > theta[:, 1:2])
        return _moved(value, jump * ~along_y, jump * along_y)

    def says(mean: FloatArray, sd: FloatArray) -> str:
        axis = "Y" if mean[2] > 0.5 else "X"
        return in_words(f"beyond {axis} = {{1}} mm the arm is {{0}} mm off along {axis}: a tooth is missing")(mean, sd)

    def between(low_mm: float, high_mm: float, axis: int) -> Effect:
        at, which = Uniform(low_mm, high_mm), Uniform(axis - 0.5, axis + 0.5)
        parameters: Declared = {"amp_mm": (AMPLITUDE, "mm"), "at_mm": (at, "mm"), "axis": (which, "1")}
        bank = single_column_bank(1.0, (low_mm + high_mm) / 2, float(axis))
        return kind.bind(of, parameters, act, says, bank, typical=of.small_play_mm)

    places = [distinct_positions_mm(axis_mm) for axis_mm in (of.plan.x_mm, of.plan.y_mm)]
    thinned = [own[:: -(-len(own) // _MOST_PLACES)].tolist() for own in places]
    if all(len(own) <= 2 for own in thinned):
        return None
    return one_of([between(*pair, axis) for axis, own in enumerate(thinned) for pair in pairwise(own)])


@light_effect("arm_knock", Stage.POSE, "an arm or sheet that was pushed", ("time", "slope"))
def arm_knock(kind: LightEffect, of: Extent) -> Effect | None:
    """The arm is pushed: after at_s every position is off by (dx_mm, dy_mm) and the sensor is turned by turn_deg."""

    def act(value: Poses, theta: FloatArray, after: FloatArray) -> Poses:
        moved = _moved(value, theta[:, :1] * after, theta[:, 1:2] * after)
        return _turned(moved, np.deg2rad(theta[:, 2:3]) * after)

    off = "from {3} s on, all positions are off by {0} mm along X and {1} mm along Y, and the sensor is turned by {2}"
    says = in_words(f"{off} degrees: the arm or the paper was pushed")
    typical = of.small_play_mm, "mm"
    return kind.step(of, {"dx_mm": typical, "dy_mm": typical, "turn_deg": (2.0, "deg")}, act, says)


@light_effect("slow_turn", Stage.POSE, "a sensor that slowly turns", ("time", "orientation"), counts="time")
def slow_turn(kind: LightEffect, of: Extent) -> Effect:
    """The sensor turns in its holder: orientation + deg_per_hour t, t the hours since the origin."""
    act = acting(lambda value, plan, rate: _turned(value, np.deg2rad(rate) * of.origin.hours(plan)))
    says = in_words("the sensor turns by {0} degrees per hour: it is loose in its holder")
    return kind.bind(of, {"deg_per_hour": (AMPLITUDE, "deg/h")}, act, says, typical=2.0 / (of.duration_s / 3600))


_PERIODIC = "a periodic position error of the arm"


@light_effect("periodic_position_error", Stage.POSE, _PERIODIC, ("place", "slope"), counts="place")
def periodic_position_error(kind: LightEffect, of: Extent) -> Effect | None:
    """A gear or lead screw that is not round: X + amp_mm sin(2 pi (X - X0) / period_mm + phase), X0 of the origin."""
    shortest_mm, reach_mm = _shortest_period_and_range_mm(of.plan)
    if not reach_mm > 0:
        return None
    longest_mm = 2 * reach_mm

    @acting
    def act(value: Poses, plan: Plan, amp: FloatArray, period: FloatArray, phase: FloatArray) -> Poses:
        wave = amp * np.sin(2 * np.pi / period * (value.x_mm - of.origin.x_mm) + phase)
        return replace(value, x_mm=value.x_mm + wave)

    waves = np.linspace(1.0, longest_mm / 2 / shortest_mm, _N_PERIODS + 1)[1:]
    periods = np.append(longest_mm / 2 / waves, longest_mm / np.geomspace(1.05, 2.0, _N_LONG))
    period = LogUniform(shortest_mm, longest_mm)
    parameters: Declared = {"amp_mm": (POSITIVE, "mm"), "period_mm": (period, "mm"), "phase": (PHASE, "rad")}
    bank = sine_and_cosine_entries(1.0, np.maximum(periods, shortest_mm * 1.001))
    off = "the arm's position along X is off by up to {0} mm, with a period of {1} mm"
    says = in_words(f"{off}: a gear or lead screw is not round")
    return kind.bind(of, parameters, act, says, bank, typical=of.small_shift_mm, kind=WaveEffect)


@light_effect("stick_slip", Stage.POSE, "a slide that sticks and jumps", ("place", "slope"), counts="place")
def stick_slip(kind: LightEffect, of: Extent) -> Effect | None:
    """Stick-slip: X + amp_mm saw((X - X0) / period_mm + phase), saw a sawtooth of 1 to -1, X0 of the origin."""
    shortest_mm, reach_mm = _shortest_period_and_range_mm(of.plan)
    longest_mm = 0.25 * reach_mm
    if longest_mm <= shortest_mm:
        return None

    def act(value: Poses, theta: FloatArray, plan: Plan) -> Poses:
        turns = 2 * np.pi * ((value.x_mm - of.origin.x_mm) / theta[:, 1:2] + theta[:, 2:3])
        saw = sum(share * np.sin(order * turns) for order, share in zip(_ORDERS, _SHARES, strict=True))
        return replace(value, x_mm=value.x_mm + theta[:, :1] * saw)

    waves = np.linspace(1.0 / longest_mm, 1.0 / shortest_mm, _N_WAVES + 2)[1:-1]
    periods, phases = np.meshgrid(1 / waves, np.arange(_N_PHASES) / _N_PHASES - 0.5, indexing="ij")
    period, phase = LogUniform(shortest_mm, longest_mm), Uniform(-1.0, 1.0)
    parameters: Declared = {"amp_mm": (AMPLITUDE, "mm"), "period_mm": (period, "mm"), "phase": (phase, "1")}
    bank = single_column_bank(1.0, periods.ravel(), phases.ravel())
    says = "the slide sticks and then jumps by {|0|} mm, once every {1} mm along X: it lacks lubrication"
    return kind.bind(of, parameters, act, in_words(says, factors=(2,)), bank, typical=of.small_shift_mm)


def _shortest_period_and_range_mm(plan: Plan) -> tuple[float, float]:
    """Return three times the median step of X and the range of X, mm; 0 and 0 for fewer than eight positions."""
    x_mm = distinct_positions_mm(plan.x_mm)
    return (3 * float(np.median(np.diff(x_mm))), float(np.ptp(x_mm))) if len(x_mm) >= 8 else (0.0, 0.0)
