"""Where the sensor hangs: motors through gears and their play to joints, joints to a place over the field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

from probewise.emulator.geometry import Geometry, JointNumbers
from probewise.emulator.motor import Motor, MotorNature

__all__ = ["EmulatedArm", "Joint", "Stand"]

_BEYOND_LIMITS_DEG = 3.0  # a joint's own stops lie this far outside the limits of the file


@dataclass(frozen=True)
class Stand:
    """Where the sensor is: lab frame, height of its face above the surface, its u axis to the x axis."""

    x_mm: float
    y_mm: float
    height_mm: float
    orientation_rad: float


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint and the motor that drives it through gears, whose play counts on the motor's side."""

    numbers: JointNumbers
    motor: Motor

    @classmethod
    def at_home(cls, numbers: JointNumbers) -> Self:
        """Make the motor, so that the joint is at home where the motor begins."""
        ends = sorted(
            (angle_deg - numbers.home_deg) * numbers.gear_ratio
            for angle_deg in (numbers.low_deg - _BEYOND_LIMITS_DEG, numbers.high_deg + _BEYOND_LIMITS_DEG)
        )
        play_deg = numbers.play_deg * abs(numbers.gear_ratio)
        # The stops are the joint's: its motor gets there half the play later.
        stops_deg = (ends[0] - play_deg / 2, ends[1] + play_deg / 2)
        return cls(numbers, Motor(MotorNature(stops_deg=stops_deg, play_deg=play_deg)))

    @property
    def angle_rad(self) -> float:
        """Where the joint is."""
        return math.radians(self.numbers.home_deg + self.motor.driven_deg / self.numbers.gear_ratio)

    def bring_to(self, angle_deg: float) -> None:
        """Turn it by hand: the motor turns with it and comes to rest in the middle of the play."""
        self.motor.angle_deg = self.motor.driven_deg = (angle_deg - self.numbers.home_deg) * self.numbers.gear_ratio
        self.motor.speed_deg_s = 0.0


class EmulatedArm:
    """Three joints, and the sensor at the end of them.

    Parameters
    ----------
    geometry
        The arm's numbers; every joint begins at home.

    Attributes
    ----------
    joints
        Base, shoulder, elbow.
    """

    def __init__(self, geometry: Geometry) -> None:
        self._geometry = geometry
        self.joints = tuple(Joint.at_home(numbers) for numbers in geometry.joints)

    def motors(self) -> tuple[Motor, ...]:
        """Return the motors at ports A, B, C."""
        by_port = {joint.numbers.port: joint.motor for joint in self.joints}
        return tuple(by_port[port] for port in "ABC")

    def stand(self) -> Stand:
        """Return where the sensor is (the paper's arm: two links over a base that turns)."""
        g = self._geometry
        base, shoulder, elbow = (joint.angle_rad for joint in self.joints)
        lower = elbow if g.elbow_is_absolute else shoulder + elbow
        (upper_mm, lower_mm), (forward_mm, height_mm) = g.links_mm, g.shoulder_mm
        out_mm = forward_mm + upper_mm * math.cos(shoulder) + lower_mm * math.cos(lower) + g.sensor_mm[0]
        face_mm = height_mm + upper_mm * math.sin(shoulder) + lower_mm * math.sin(lower) - g.sensor_mm[1]
        return Stand(
            x_mm=g.base_mm[0] + out_mm * math.cos(base),
            y_mm=g.base_mm[1] + out_mm * math.sin(base),
            height_mm=face_mm,
            orientation_rad=math.radians(g.mounting_deg - 90) + base,
        )
