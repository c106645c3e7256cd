"""Our driver against our emulator, which share no code, on a clock that nobody waits for."""

import contextlib

import numpy as np
import pytest

from probewise import arm
from probewise.arm.nxt import Brick, BrickMachine, Link
from probewise.emulator import Faults, VirtualLine, read_geometry, set_up_bench
from probewise.errors import LinkError
from probewise.recordings import Disc
from probewise.world.shipped import true_world

SEED = 11
WORLD, CIRCLE = true_world("paper"), Disc((600.0, 250.0), 80.0)


def measured(bench, clock, places_mm):
    """Read at each place, in one session."""
    geometry = arm.read_geometry(arm.shipped_geometry_path())
    link = Link(VirtualLine(bench.radio, clock), clock=clock)
    with arm.LegoArm(BrickMachine(Brick(link, clock=clock), geometry), geometry, clock=clock) as lego:
        standing = lego.orientation_rad(places_mm)
        return [
            lego.measure(arm.Pose(x_mm, y_mm, turned))
            for (x_mm, y_mm), turned in zip(places_mm.tolist(), standing.tolist(), strict=True)
        ]


def bench_over_circle(clock):
    return set_up_bench(read_geometry(arm.shipped_geometry_path()), WORLD, CIRCLE, clock, seed=SEED)


class Cut:
    """Let the n-th telegram from now on be the last that the brick gets."""

    def __init__(self, bench, n):
        self._radio, self._left, self._answer = bench.radio, n, bench.radio.brick.answer
        bench.radio.brick.answer = self

    def __call__(self, telegram):
        self._left -= 1
        if not self._left:
            self._radio.faults = Faults(disconnect=1.0)
        return self._answer(telegram)

    def mend(self):
        self._radio.faults = Faults()


@pytest.mark.parametrize("n", [pytest.param(n, marks=[] if n % 12 == 1 else pytest.mark.slow) for n in range(1, 80, 3)])
def test_after_a_cut_anywhere_the_motors_stop_and_the_next_reading_is_taken(clock, n):
    """Also in the middle of lowering: the sensor comes up first, whatever the next place is."""
    places = np.array([[524.0, 320.0], [60.0, 300.0]])  # 76 telegrams from the one to the other and up
    bench = bench_over_circle(clock)
    (first,) = measured(bench, clock, places[:1])
    cut = Cut(bench, n)
    with contextlib.suppress(LinkError):
        measured(bench, clock, places[1:])
    assert not bench.radio.is_open or n > 75
    clock.sleep(5.0)
    bench.radio.brick.advance()
    assert not any(motor.speed_deg_s for motor in bench.arm.motors())
    assert bench.arm.sensor_pose().height_mm > 8.0
    cut.mend()
    (second,) = measured(bench, clock, places[1:])
    assert (first.value, second.value) == pytest.approx((10, 10), abs=3)
