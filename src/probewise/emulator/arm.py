"""The arm as built, read from its TOML file: motors turn joints through gears with backlash, joints place the sensor.

The emulator has its own reader, so that driver and emulator cannot share a mistake.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Self

from probewise.emulator.motors import Motor
from probewise.errors import FileError, shown
from probewise.recordings import read_text

LARGEST = 1e6


@dataclass(frozen=True)
class JointParameters:
    """One joint: motor port, gear ratio (motor turns per joint turn), angle at count 0, limits, backlash, stop."""

    port: str
    gear_ratio: float
    home_deg: float
    low_deg: float
    high_deg: float
    play_deg: float
    stop_deg: float | None = None


@dataclass(frozen=True)
class Geometry:
    """Dimensions of the arm, in mm and degrees; the shipped TOML file explains each."""

    base_mm: tuple[float, float]
    shoulder_mm: tuple[float, float]  # forward of the base's axis, above the surface
    links_mm: tuple[float, float]
    elbow_is_absolute: bool
    sensor_port: int
    sensor_mm: tuple[float, float]  # forward of the wrist, below it
    mounting_deg: float
    read_height_mm: float
    joints: tuple[JointParameters, JointParameters, JointParameters]  # base, shoulder, elbow


def shipped_geometry_path() -> Path:
    """Return the path of the arm file shipped with the package."""
    return Path(str(resources.files("probewise"))) / "data" / "lego_arm.toml"


def read_geometry(path: Path) -> Geometry:
    """Read an arm's dimensions from a TOML file of format "arm/1".

    Raises FileError if the file is missing or not TOML, or an entry is missing or not allowed.
    """
    text = read_text(path, "an arm's file of format arm/1")
    try:
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # not TOML, a number of thousands of digits, or nested too deep
        raise FileError(path, f"not TOML: {error}", "an arm's file of format arm/1") from error

    def entry(*keys: str) -> object:
        found: Any = table
        for key in keys:
            if not isinstance(found, Mapping) or key not in found:
                raise FileError(path, f"{'.'.join(keys)} is missing", "every number of format arm/1")
            found = found[key]
        return found

    def number(*keys: str) -> float:
        value = entry(*keys)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
            raise FileError(path, f"{'.'.join(keys)} is {shown(value)}", f"a number of magnitude up to {LARGEST:g}")
        return float(value)

    def joint(name: str) -> JointParameters:
        port = entry("joints", name, "port")
        if port not in ("A", "B", "C"):
            raise FileError(path, f"joints.{name}.port is {shown(port)}", "A, B or C")
        ratio = number("joints", name, "gear_ratio")
        if ratio == 0:
            raise FileError(path, f"joints.{name}.gear_ratio is 0", "any other number")
        home, low, high, play = (number("joints", name, f"{key}_deg") for key in ("home", "low", "high", "play"))
        if not low <= home <= high:
            raise FileError(path, f"joints.{name}.home_deg is {home:g}", f"within its limits, {low:g} to {high:g}")
        stop = number("joints", name, "stop_deg") if "stop_deg" in table["joints"][name] else None
        if stop is not None and low < stop < high:
            allowed = f"at or beyond a limit, {low:g} or {high:g}"
            raise FileError(path, f"joints.{name}.stop_deg is {stop:g}", allowed)
        return JointParameters(port, ratio, home_deg=home, low_deg=low, high_deg=high, play_deg=play, stop_deg=stop)

    elbow = entry("links", "elbow")
    if elbow not in ("absolute", "relative"):
        raise FileError(path, f"links.elbow is {shown(elbow)}", '"absolute" or "relative"')
    joints = (joint("base"), joint("shoulder"), joint("elbow"))
    if len({j.port for j in joints}) < len(joints):
        raise FileError(path, f"the joints' ports are {', '.join(j.port for j in joints)}", "three different ports")
    sensor_port = number("sensor", "port")
    if sensor_port not in (1, 2, 3, 4):
        raise FileError(path, f"sensor.port is {sensor_port:g}", "1, 2, 3 or 4")
    return Geometry(
        base_mm=(number("base", "x_mm"), number("base", "y_mm")),
        shoulder_mm=(number("base", "shoulder_forward_mm"), number("base", "shoulder_height_mm")),
        links_mm=(number("links", "upper_mm"), number("links", "lower_mm")),
        elbow_is_absolute=elbow == "absolute",
        sensor_port=int(sensor_port),
        sensor_mm=(number("sensor", "forward_mm"), number("sensor", "drop_mm")),
        mounting_deg=number("sensor", "mounting_deg"),
        read_height_mm=number("sensor", "read_height_mm"),
        joints=joints,
    )


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

    numbers: JointParameters
    motor: Motor

    @classmethod
    def create_at_home(cls, numbers: JointParameters) -> Self:
        """Make a joint at its home position, with the motor at 0."""
        low_deg, high_deg = numbers.low_deg - _BEYOND_LIMITS_DEG, numbers.high_deg + _BEYOND_LIMITS_DEG
        if numbers.stop_deg is not None and numbers.stop_deg >= numbers.high_deg:
            high_deg = numbers.stop_deg
        elif numbers.stop_deg is not None:
            low_deg = numbers.stop_deg
        ends = sorted((angle_deg - numbers.home_deg) * numbers.gear_ratio for angle_deg in (low_deg, high_deg))
        play_deg = numbers.play_deg * abs(numbers.gear_ratio)
        # The stops are the joint's: its motor turns half the backlash further.
        stops_deg = (ends[0] - play_deg / 2, ends[1] + play_deg / 2)
        return cls(numbers, Motor(stops_deg=stops_deg, play_deg=play_deg))

    @property
    def angle_rad(self) -> float:
        """Angle of the joint, which follows its motor with backlash."""
        return math.radians(self.numbers.home_deg + self.motor.driven_deg / self.numbers.gear_ratio)

    def set_angle_by_hand(self, angle_deg: float) -> None:
        """Set the joint to an angle, as by hand; the motor follows and rests in the middle of the backlash."""
        self.motor.angle_deg = self.motor.driven_deg = (angle_deg - self.numbers.home_deg) * self.numbers.gear_ratio
        self.motor.speed_deg_s = 0.0


class EmulatedArm:
    """The arm, at first at home: `joints` base, shoulder and elbow, and the sensor at its end.

    `lowest` is the lowest pose of the sensor so far; a height below 0 means that it went through the table.
    """

    def __init__(self, geometry: Geometry) -> None:
        self._geometry = geometry
        self.joints = tuple(Joint.create_at_home(numbers) for numbers in geometry.joints)
        self.lowest = self.sensor_pose()

    def motors(self) -> tuple[Motor, ...]:
        """Return the motors at ports A, B, C."""
        by_port = {joint.numbers.port: joint.motor for joint in self.joints}
        return tuple(by_port[port] for port in "ABC")

    def record_lowest(self) -> None:
        """Update `lowest`, the lowest pose of the sensor so far."""
        here = self.sensor_pose()
        if here.height_mm < self.lowest.height_mm:
            self.lowest = here

    def sensor_pose(self) -> SensorPose:
        """Return the sensor's pose (the paper's arm: two links on a turning base)."""
        g = self._geometry
        base, shoulder, elbow = (joint.angle_rad for joint in self.joints)
        lower = elbow if g.elbow_is_absolute else shoulder + elbow
        (upper_mm, lower_mm), (forward_mm, height_mm) = g.links_mm, g.shoulder_mm
        out_mm = forward_mm + upper_mm * math.cos(shoulder) + lower_mm * math.cos(lower) + g.sensor_mm[0]
        face_mm = height_mm + upper_mm * math.sin(shoulder) + lower_mm * math.sin(lower) - g.sensor_mm[1]
        return SensorPose(
            x_mm=g.base_mm[0] + out_mm * math.cos(base),
            y_mm=g.base_mm[1] + out_mm * math.sin(base),
            height_mm=face_mm,
            orientation_rad=math.radians(g.mounting_deg - 90) + base,
        )
