"""Mechanics of a motor, without firmware: inertia, friction, coasting, stops and backlash.

The magnitudes are those measured on the NXT motor: 170 revolutions per minute at full power and 9 V without load, speed
proportional to power and voltage, no start below about 8 % of power, and an overshoot of about 60 degrees after an
unregulated limited run at power 75.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field


@dataclass(frozen=True)
class MotorParameters:
    """Parameters of a motor under its load.

    Parameters
    ----------
    full_speed_deg_s
        Speed without load at power 100 and a battery of `rated_mv`.
    driven_s
        Time constant of the approach to the commanded speed, and of the electric brake.
    coasting_s
        Time constant of slowing down without current.
    friction_deg_s2
        Deceleration by dry friction, which also keeps a weakly driven motor from starting.
    stops_deg
        Angles of the shaft at its mechanical stops.
    play_deg
        Backlash: angle the shaft turns after a reversal before its load follows.
    """

    full_speed_deg_s: float = 1020.0
    rated_mv: float = 9000.0
    driven_s: float = 0.06
    coasting_s: float = 0.4
    friction_deg_s2: float = 1200.0
    stops_deg: tuple[float, float] = (-math.inf, math.inf)
    play_deg: float = 0.0


@dataclass
class Motor:
    """State of a motor: angle and speed of the shaft, and angle of its load."""

    parameters: MotorParameters = field(default_factory=MotorParameters)
    angle_deg: float = 0.0
    speed_deg_s: float = 0.0
    driven_deg: float = 0.0

    def step(self, seconds: float, power: float, *, brake: bool, battery_mv: float) -> None:
        """Simulate a time step, much shorter than the time constants.

        Parameters
        ----------
        seconds
            Length of the step.
        power
            -100 to 100.
        brake
            Whether the motor brakes at power 0 (shorted), instead of coasting without current.
        battery_mv
            Voltage of the battery.
        """
        parameters = self.parameters
        if power or brake:
            asked = parameters.full_speed_deg_s * (power / 100) * (battery_mv / parameters.rated_mv)
            speed = self.speed_deg_s + (asked - self.speed_deg_s) * seconds / parameters.driven_s
        else:
            speed = self.speed_deg_s * (1 - seconds / parameters.coasting_s)
        # Dry friction reduces the speed towards zero and never reverses it.
        lost = parameters.friction_deg_s2 * seconds
        self.speed_deg_s = speed - lost if speed > lost else speed + lost if speed < -lost else 0.0
        low, high = parameters.stops_deg
        angle = self.angle_deg + self.speed_deg_s * seconds
        if not low <= angle <= high:
            angle, self.speed_deg_s = min(max(angle, low), high), 0.0
        self.angle_deg = angle
        slack = parameters.play_deg / 2
        self.driven_deg = min(max(self.driven_deg, angle - slack), angle + slack)
