"""The light at the sensor's pose: the world's reading, corrected for height and for the LED."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from probewise.emulator.arm import SensorPose
from probewise.emulator.clock import Clock
from probewise.emulator.table import Tabletop
from probewise.world import World

_BRIGHTEST_MM = 8.0  # closer than this the divider between LED and photodiode shades the surface
_SAME_STAND_MM = 1.0
_CUT_OFF = 0.5


class LightModel:
    """Function of the LED's state that returns an unrounded reading on the scale 0 to 100, at the sensor's pose.

    A world's readings are whole steps like the brick's, and the brick truncates: a reading of 40 means light of 40.5 on
    average. At the reading height, half of the light is the LED's. That half increases towards 8 mm, falls to zero on
    contact, and vanishes at a few centimetres.

    Parameters
    ----------
    world
        World that simulates the sensor's readings at `read_height_mm`, with the LED on.
    table
        The surface, and the sensor's rotation in its mount.
    sensor_pose
        Function that returns the sensor's current pose.
    read_height_mm
        Height at which the world's readings are taken.
    seed
        Seed of the noise. All readings within 1 mm of the n-th pose come from the n-th generator, as on the simulated
        arm, so that both give the same first reading.
    clock
        Time in seconds, for drifts.
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
        sensor_pose = self._sensor_pose()
        here = (sensor_pose.x_mm, sensor_pose.y_mm, sensor_pose.height_mm)
        if math.dist(here, self._last) > _SAME_STAND_MM:
            self._number, self._last = self._number + 1, here
            self._rng = np.random.default_rng([self._seed, self._number])
        bright = self._world.read(
            self._table.surface,
            sensor_pose.x_mm,
            sensor_pose.y_mm,
            sensor_pose.orientation_rad + self._table.turned_rad,
            time_s=self._clock(),
            rng=self._rng,
        )
        # Half is the LED's, as in two rooms: 58 and 32 % over white and black with the LED, 30 and 17 % without.
        return (
            (bright + _CUT_OFF)
            * (
                1
                + lit
                * _led_brightness_at_height(sensor_pose.height_mm)
                / _led_brightness_at_height(self._read_height_mm)
            )
            / 2
        )


def _led_brightness_at_height(height_mm: float) -> float:
    """Return the relative brightness of the LED at a height, 1 at the brightest."""
    steps = max(height_mm, 0.0) / _BRIGHTEST_MM
    return steps * math.exp(1 - steps)
