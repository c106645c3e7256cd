"""Forward kinematics of the arm: from motors through gears with backlash to joints and the sensor's pose."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

from probewise.emulator.geometry import Geometry, JointParameters
from probewise.emulator.motor import Motor, MotorParameters

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
        return cls(numbers, Motor(MotorParameters(stops_deg=stops_deg, play_deg=play_deg)))

    @property
    def angle_rad(self) -> float:
        """Angle of the joint, which follows its motor with backlash."""
        return math.radians(self.numbers.home_deg + self.motor.driven_deg / self.numbers.gear_ratio)

    def set_angle_by_hand(self, angle_deg: float) -> None:
        """Set the joint to an angle, as by hand; the motor follows and rests in the middle of the backlash."""
        self.motor.angle_deg = self.motor.driven_deg = (angle_deg - self.numbers.home_deg) * self.numbers.gear_ratio
        self.motor.speed_deg_s = 0.0


class EmulatedArm:
    """The arm: three joints and the sensor at its end.

    Parameters
    ----------
    geometry
        Dimensions of the arm; every joint starts at home.

    Attributes
    ----------
    joints
        Base, shoulder, elbow.
    lowest
        Lowest pose of the sensor so far; a height below 0 means that the sensor went through the table.
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
