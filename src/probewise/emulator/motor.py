"""A motor as a thing that turns: inertia, friction, coasting, stops, play behind it; no firmware in it.

Orders of magnitude are those measured on the NXT motor: 170 revolutions a minute at full power and 9 V
without load, speed proportional to power and to voltage, too weak to start below some 8 % of power,
about 60 degrees of run-on from a plain limited run at power 75.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

__all__ = ["Motor", "MotorNature"]


@dataclass(frozen=True)
class MotorNature:
    """What one motor under its load is like.

    Parameters
    ----------
    full_speed_deg_s
        Speed without load at power 100 and `rated_mv`.
    driven_s
        Time constant towards the speed that is asked for, and of the electric brake.
    coasting_s
        Time constant of slowing down without current.
    friction_deg_s2
        Slowing down by dry friction; it also keeps a weakly driven motor from starting.
    stops_deg
        Angles of the shaft that it cannot pass.
    play_deg
        How far the shaft turns, after it has reversed, before what it drives follows.
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
    """Where a motor's shaft is, how fast it turns, and how far it has driven what hangs on it."""

    nature: MotorNature = field(default_factory=MotorNature)
    angle_deg: float = 0.0
    speed_deg_s: float = 0.0
    driven_deg: float = 0.0

    def step(self, seconds: float, power: float, *, brake: bool, battery_mv: float) -> None:
        """Turn for a short while, much shorter than the time constants.

        Parameters
        ----------
        seconds
            How long.
        power
            -100 to 100.
        brake
            At power 0: shorted rather than without current.
        battery_mv
            What drives it.
        """
        nature = self.nature
        if power or brake:
            asked = nature.full_speed_deg_s * (power / 100) * (battery_mv / nature.rated_mv)
            speed = self.speed_deg_s + (asked - self.speed_deg_s) * seconds / nature.driven_s
        else:
            speed = self.speed_deg_s * (1 - seconds / nature.coasting_s)
        # Dry friction takes speed away whichever way it goes, and never turns it round.
        lost = nature.friction_deg_s2 * seconds
        self.speed_deg_s = speed - lost if speed > lost else speed + lost if speed < -lost else 0.0
        low, high = nature.stops_deg
        angle = self.angle_deg + self.speed_deg_s * seconds
        if not low <= angle <= high:
            angle, self.speed_deg_s = min(max(angle, low), high), 0.0
        self.angle_deg = angle
        slack = nature.play_deg / 2
        self.driven_deg = min(max(self.driven_deg, angle - slack), angle + slack)
