"""What the light sensor sees from where it hangs: the world's reading, dimmed by height and without the LED."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from probewise.emulator.arm import Stand
from probewise.emulator.clock import Clock
from probewise.emulator.table import Table
from probewise.world import World

__all__ = ["Sight"]

_BRIGHTEST_MM = 8.0  # nearer than this the divider between LED and diode shades the surface
_SAME_STAND_MM = 1.0
_CUT_OFF = 0.5


class Sight:
    """A scale 0 to 100 without steps, LED on or off.

    A world's readings are whole steps as the brick shows them, and the brick cuts fractions off: so behind
    a reading of 40 on average stands light of 40.5.

    Without the LED everything is half as bright, as measured in two rooms (58 and 32 % over white and
    black with it, 30 and 17 % without). The LED's share is whole at the height of the world's readings,
    rises towards 8 mm, falls to nothing on contact, and is gone at a few centimetres.

    Parameters
    ----------
    world
        How the sensor reads at `read_height_mm`.
    table
        What lies there.
    stand
        Where the sensor is now.
    read_height_mm
        Height that the world's readings are taken at.
    seed
        Of the noise. Readings at the n-th stand, however many, come from the n-th generator, as they do on
        the simulated arm, so that both give the same first reading.
    clock
        Seconds, for what drifts.
    """

    def __init__(
        self,
        world: World,
        table: Table,
        stand: Callable[[], Stand],
        *,
        read_height_mm: float,
        seed: int,
        clock: Clock,
    ) -> None:
        self._world, self._table, self._stand, self._clock = world, table, stand, clock
        self._read_height_mm, self._seed = read_height_mm, seed
        self._number, self._last = -1, (math.inf, math.inf, math.inf)
        self._rng = np.random.default_rng(seed)

    def __call__(self, lit: bool) -> float:
        """Take a reading."""
        stand = self._stand()
        here = (stand.x_mm, stand.y_mm, stand.height_mm)
        if math.dist(here, self._last) > _SAME_STAND_MM:
            self._number, self._last = self._number + 1, here
            self._rng = np.random.default_rng([self._seed, self._number])
        bright = self._world.read(
            self._table.surface,
            stand.x_mm,
            stand.y_mm,
            stand.orientation_rad + self._table.turned_rad,
            time_s=self._clock(),
            rng=self._rng,
        )
        return (bright + _CUT_OFF) * (1 + lit * _led(stand.height_mm) / _led(self._read_height_mm)) / 2


def _led(height_mm: float) -> float:
    """Return the LED's share of the light at a height, 1 at the brightest."""
    steps = max(height_mm, 0.0) / _BRIGHTEST_MM
    return steps * math.exp(1 - steps)
