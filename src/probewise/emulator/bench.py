"""The whole emulated bench: the arm as built, a scene on the table, light sensor, brick and radio link.

Motors turn joints through gears with backlash, and joints place the sensor. The arm takes its numbers from the geometry
file itself, so that driver and emulator cannot share a mistake.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeAlias

import numpy as np

from probewise.emulator.brick import Brick, LightSensor, Sensor, empty_port
from probewise.emulator.motors import Motor
from probewise.emulator.protocol import Clock
from probewise.emulator.radio import Faults, Radio, Trace, ignore_trace
from probewise.errors import ParameterError
from probewise.recordings import read_text
from probewise.recordings.patterns import Disc, HalfPlane, Polygon, Quadrant, Uniform
from probewise.world import Oval, Reader, Surface, World

Numbers: TypeAlias = Mapping[str, Any]
"""The tables and entries of a geometry file, in mm and degrees; the shipped one explains each."""


def read_geometry(path: Path) -> Numbers:
    """Read an arm's dimensions from a TOML file of format "arm/1", in which `probewise.arm` finds no fault."""
    return tomllib.loads(read_text(path, "an arm's file of format arm/1"))


_BEYOND_LIMITS_DEG = 3.0  # a mechanical stop that the file does not give lies this far outside the limit


@dataclass(frozen=True)
class SensorPose:
    """Pose of the sensor in the lab frame: place, height of its face above the surface, angle from X to its u axis."""

    x_mm: float
    y_mm: float
    height_mm: float
    orientation_rad: float


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint and the motor that drives it through gears; backlash is measured at the motor."""

    numbers: Numbers
    motor: Motor

    @classmethod
    def create_at_home(cls, numbers: Numbers) -> Self:
        """Make a joint at its home position, with the motor at 0."""
        low_deg, high_deg = numbers["low_deg"] - _BEYOND_LIMITS_DEG, numbers["high_deg"] + _BEYOND_LIMITS_DEG
        if (stop_deg := numbers.get("stop_deg", low_deg)) >= numbers["high_deg"]:
            high_deg = stop_deg
        else:
            low_deg = stop_deg
        ratio = numbers["gear_ratio"]
        ends = sorted((angle_deg - numbers["home_deg"]) * ratio for angle_deg in (low_deg, high_deg))
        play_deg = numbers["play_deg"] * abs(ratio)
        # The stops are the joint's: its motor turns half the backlash further.
        stops_deg = (ends[0] - play_deg / 2, ends[1] + play_deg / 2)
        return cls(numbers, Motor(stops_deg=stops_deg, play_deg=play_deg))

    @property
    def angle_rad(self) -> float:
        """Angle of the joint, which follows its motor with backlash."""
        return math.radians(self.numbers["home_deg"] + self.motor.driven_deg / self.numbers["gear_ratio"])

    def set_angle_by_hand(self, angle_deg: float) -> None:
        """Set the joint to an angle, as by hand; the motor follows and rests in the middle of the backlash."""
        self.motor.angle_deg = self.motor.driven_deg = (angle_deg - self.numbers["home_deg"]) * self.numbers[
            "gear_ratio"
        ]
        self.motor.speed_deg_s = 0.0


class EmulatedArm:
    """The arm, at first at home: `joints` base, shoulder and elbow, and the sensor at its end.

    `lowest` is the lowest pose of the sensor so far; a height below 0 means that it went through the table.
    """

    def __init__(self, numbers: Numbers) -> None:
        self._numbers = numbers
        self.joints = tuple(Joint.create_at_home(numbers["joints"][name]) for name in ("base", "shoulder", "elbow"))
        self.lowest = self.sensor_pose()

    def motors(self) -> tuple[Motor, ...]:
        """Return the motors at ports A, B, C."""
        by_port = {joint.numbers["port"]: joint.motor for joint in self.joints}
        return tuple(by_port[port] for port in "ABC")

    def record_lowest(self) -> None:
        """Update `lowest`, the lowest pose of the sensor so far."""
        here = self.sensor_pose()
        if here.height_mm < self.lowest.height_mm:
            self.lowest = here

    def sensor_pose(self) -> SensorPose:
        """Return the sensor's pose (the paper's arm: two links on a turning base)."""
        base, links, sensor = (self._numbers[name] for name in ("base", "links", "sensor"))
        turned, shoulder, elbow = (joint.angle_rad for joint in self.joints)
        lower, upper_mm, lower_mm = elbow, links["upper_mm"], links["lower_mm"]
        if links["elbow"] == "relative":
            lower = shoulder + elbow
        out_mm = base["shoulder_forward_mm"] + upper_mm * math.cos(shoulder) + lower_mm * math.cos(lower)
        out_mm += sensor["forward_mm"]
        up_mm = base["shoulder_height_mm"] + upper_mm * math.sin(shoulder) + lower_mm * math.sin(lower)
        return SensorPose(
            x_mm=base["x_mm"] + out_mm * math.cos(turned),
            y_mm=base["y_mm"] + out_mm * math.sin(turned),
            height_mm=up_mm - sensor["drop_mm"],
            orientation_rad=math.radians(sensor["mounting_deg"] - 90) + turned,
        )


FORMS = (
    "[circle:]X,Y,RADIUS",
    "ellipse:X,Y,A,B,ANGLE",
    "polygon:X,Y,X,Y,X,Y,...",
    "edge:ANGLE,OFFSET",
    "corner:X,Y,DX,DY",
    "uniform:ALBEDO",
)
"""Forms of a scene; mm and degrees. White is inside, beyond the edge, or towards DX, DY = +1 or -1."""


def parse_scene(text: str) -> Surface:
    """Parse a scene from a text in one of the `FORMS`, such as `circle:524,300,100`; ParameterError if it has none."""
    name, _, listed = text.rpartition(":")
    try:
        return _MAKERS[name or "circle"](*(_parse_finite(cell) for cell in listed.split(",")))
    except (KeyError, TypeError, ValueError) as error:
        raise ParameterError("--scene", text, f"{'; '.join(FORMS)}; in mm and degrees") from error


def _parse_finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _ellipse(x_mm: float, y_mm: float, a_mm: float, b_mm: float, angle_deg: float) -> Oval:
    if min(a_mm, b_mm) <= 0:
        raise ValueError
    return Oval((x_mm, y_mm), (a_mm, b_mm), math.radians(angle_deg))


def _uniform(albedo: float) -> Uniform:
    if not 0 <= albedo <= 1:
        raise ValueError
    return Uniform(albedo)


# A pattern refuses numbers that describe none.
_MAKERS: Mapping[str, Callable[..., Surface]] = {
    "circle": lambda x_mm, y_mm, radius_mm: Disc((x_mm, y_mm), radius_mm),
    "ellipse": _ellipse,
    "polygon": lambda *numbers: Polygon(tuple(zip(numbers[::2], numbers[1::2], strict=True))),
    "edge": lambda angle_deg, offset_mm: HalfPlane(math.radians(angle_deg), offset_mm),
    "corner": lambda x_mm, y_mm, dx, dy: Quadrant((x_mm, y_mm), (dx, dy)),
    "uniform": _uniform,
}


@dataclass
class Tabletop:
    """The surface under the sensor, and the sensor's rotation by hand, relative to the geometry's mounting.

    The surface's own origin lies at `origin_mm` of the field.
    """

    surface: Surface
    turned_rad: float = 0.0
    origin_mm: tuple[float, float] = (0.0, 0.0)

    def read(self, world: World | Reader, x_mm: float, y_mm: float, turned_rad: float, **more: Any) -> float:
        """Read a world's sensor over the surface, at a place of the field; `more` as `World.read` takes it."""
        x0_mm, y0_mm = self.origin_mm
        return world.read(self.surface, x_mm - x0_mm, y_mm - y0_mm, turned_rad, **more)

    def carry_out_line(self, line: str) -> None:
        """Carry out a typed line: a scene becomes the surface, `turn DEGREES` sets the rotation of the sensor.

        ParameterError if the line is neither; nothing changes then.
        """
        verb, _, angle = line.strip().partition(" ")
        try:
            if verb == "turn":
                self.turned_rad = math.radians(_parse_finite(angle))
            else:
                self.surface, self.origin_mm = parse_scene(line.strip()), (0.0, 0.0)
        except ValueError as error:
            raise ParameterError("line", line, f"turn DEGREES; {'; '.join(FORMS)}; in mm and degrees") from error


_BRIGHTEST_MM = 8.0  # closer than this the divider between LED and photodiode shades the surface
_SAME_STAND_MM = 1.0
_CUT_OFF = 0.5


class LightModel:
    """Function of the LED's state that returns an unrounded reading on the scale 0 to 100, at the sensor's pose.

    A world's readings are whole steps like the brick's, and the brick truncates: a reading of 40 means light of 40.5 on
    average. At the reading height, at which the world simulates the sensor with the LED on, half of the light is the
    LED's. That half increases towards 8 mm, falls to zero on contact, and vanishes at a few centimetres. All readings
    within 1 mm of the n-th pose take their noise from the n-th generator of the seed, as on the simulated arm, so that
    both give the same first reading.
    """

    def __init__(
        self,
        world: World,
        table: Tabletop,
        sensor_pose: Callable[[], SensorPose],
        *,
        read_height_mm: float,
        seed: int,
        clock: Clock,
    ) -> None:
        self._world, self._table, self._sensor_pose, self._clock = world, table, sensor_pose, clock
        self._read_height_mm, self._seed = read_height_mm, seed
        self._number, self._last = -1, (math.inf, math.inf, math.inf)
        self._rng = np.random.default_rng(seed)

    def __call__(self, lit: bool) -> float:
        """Take a reading with the LED on (`lit`) or off."""
        pose = self._sensor_pose()
        here = (pose.x_mm, pose.y_mm, pose.height_mm)
        if math.dist(here, self._last) > _SAME_STAND_MM:
            self._number, self._last = self._number + 1, here
            self._rng = np.random.default_rng([self._seed, self._number])
        turned_rad = pose.orientation_rad + self._table.turned_rad
        at = (pose.x_mm, pose.y_mm, turned_rad)
        bright = self._table.read(self._world, *at, time_s=self._clock(), rng=self._rng)
        # Half is the LED's, as in two rooms: 58 and 32 % over white and black with the LED, 30 and 17 % without.
        led = lit * _led_brightness_at_height(pose.height_mm) / _led_brightness_at_height(self._read_height_mm)
        return (bright + _CUT_OFF) * (1 + led) / 2


def _led_brightness_at_height(height_mm: float) -> float:
    steps = max(height_mm, 0.0) / _BRIGHTEST_MM
    return steps * math.exp(1 - steps)


@dataclass(frozen=True)
class EmulatedBench:
    """The emulated bench; `arm` and `radio.brick` give access to its state."""

    table: Tabletop
    arm: EmulatedArm
    radio: Radio


def set_up_bench(
    numbers: Numbers,
    world: World,
    surface: Surface,
    clock: Clock,
    *,
    seed: int,
    faults: Faults | None = None,
    sleep_min: int = 10,
    trace: Trace = ignore_trace,
) -> EmulatedBench:
    """Build a bench over a surface, the arm, of a geometry file's numbers, at home.

    `seed` is that of the sensor's noise and of the link's faults; `world` simulates the light sensor at the arm's
    reading height; `sleep_min` as for `Brick`, `faults` and `trace` as for `Radio`. ParameterError if
    `sleep_min` is invalid.
    """
    faults = Faults() if faults is None else faults
    arm = EmulatedArm(numbers)
    table = Tabletop(surface)
    light = LightModel(
        world, table, arm.sensor_pose, read_height_mm=numbers["sensor"]["read_height_mm"], seed=seed, clock=clock
    )
    sensors: list[Sensor] = [empty_port] * 4
    sensors[numbers["sensor"]["port"] - 1] = LightSensor(light, clock)
    brick = Brick(
        clock, motors=arm.motors(), sensors=sensors, sag_mv_min=faults.sag, sleep_min=sleep_min, watch=arm.record_lowest
    )
    rng = np.random.default_rng([seed, 1])
    return EmulatedBench(table, arm, Radio(brick, clock, rng=rng, faults=faults, trace=trace))
