"""Our driver against our emulator, which share no code, on a clock that nobody waits for."""

from __future__ import annotations

import math

import numpy as np
import pytest

from probewise import arm
from probewise.arm.nxt import Brick, BrickMachine, Link, Timing
from probewise.arm.nxt.telegram import Request
from probewise.emulator import Bench, Faults, VirtualClock, VirtualLine, read_geometry, set_up, shipped_geometry
from probewise.errors import LinkError, ReachError
from probewise.recordings import Disc
from probewise.world.shipped import truth

SEED = 11
WORLD, CIRCLE = truth("paper"), Disc((600.0, 250.0), 80.0)

RATES = {
    "fragment": Faults(fragment=0.5),
    "late": Faults(late=0.05, late_s=2.5),
    "drop": Faults(drop=0.005),
    "silence": Faults(silence=0.05),
    "deaf": Faults(deaf=0.05),
    "unasked": Faults(unasked=0.2),
    "disconnect": Faults(disconnect=0.01),
}


class TimedLink(Link):
    """A link that remembers its longest question."""

    longest_s = 0.0

    def ask(self, request: Request[object]) -> object:  # type: ignore[override, type-var]
        began_s = self._clock.monotonic()
        try:
            return super().ask(request)
        finally:
            self.longest_s = max(self.longest_s, self._clock.monotonic() - began_s)


def measured(bench: Bench, clock: VirtualClock, places_mm: np.ndarray) -> tuple[list[arm.Reading], float]:
    """Read at each place, going on after every end of the line; return also the longest time that a question took."""
    geometry = arm.read_geometry(arm.shipped_geometry())
    readings: list[arm.Reading] = []
    longest_s = 0.0
    for _ in range(1 + 5 * len(places_mm)):
        link = TimedLink(VirtualLine(bench.radio, clock), clock=clock)
        try:
            with arm.LegoArm(BrickMachine(Brick(link, clock=clock), geometry), geometry, clock=clock) as lego:
                for place in places_mm[len(readings) :]:
                    (orientation_rad,) = lego.orientation_rad(place[None, :])
                    readings.append(lego.measure(arm.Pose(place[0], place[1], orientation_rad)))
        except LinkError:
            pass  # go on where it ended, as a resumed run does
        except ReachError:  # it stands where it cannot rise from: a person brings it home
            for joint in bench.arm.joints:
                joint.bring_to(joint.numbers.home_deg)
        longest_s = max(longest_s, link.longest_s)
        if len(readings) == len(places_mm):
            break
    return readings, longest_s


def some_places(n: int) -> np.ndarray:
    """Draw places within reach, none where a millimetre more or less matters."""
    rng = np.random.default_rng(SEED)
    geometry = arm.read_geometry(arm.shipped_geometry())
    places = np.stack([rng.uniform(100, 950, 20 * n), rng.uniform(50, 480, 20 * n)], axis=1)
    from_edge = np.hypot(places[:, 0] - 600, places[:, 1] - 250) - 80
    # Half of them over the circle, which is small.
    places[: 10 * n] = [600, 250] + (places[: 10 * n] - [525, 265]) / 12
    from_edge = np.hypot(places[:, 0] - 600, places[:, 1] - 250) - 80
    good = geometry.holds(places) & (abs(from_edge) > 20)
    inside = places[good & (from_edge < 0)][: n // 2]
    return np.concatenate([inside, places[good & (from_edge > 0)][: n - len(inside)]])


def bench_with(faults: Faults, clock: VirtualClock) -> Bench:
    bench = set_up(read_geometry(shipped_geometry()), WORLD, CIRCLE, clock, seed=SEED)
    bench.radio.faults = faults
    return bench


def right(readings: list[arm.Reading], places_mm: np.ndarray) -> bool:
    """Whether every place has its reading: noise, a whole step, and 3 % for a millimetre of height."""
    expected = np.array([60.0 if math.dist(place, (600, 250)) < 80 else 10.0 for place in places_mm])
    return len(readings) == len(places_mm) and bool(
        (abs(np.array([r.value for r in readings]) - expected) <= 4 + 0.05 * expected).all()
    )


def test_readings_are_those_of_the_simulated_arm_with_the_same_seed(clock: VirtualClock) -> None:
    """Up to what the motors miss: most are the same whole number, none is off by more than 5 %."""
    places = some_places(12)
    bench = bench_with(Faults(), clock)
    readings, _ = measured(bench, clock, places)
    number = iter(range(len(places)))

    def light(pose: arm.Pose, time_s: float, height_mm: float) -> float:
        rng = np.random.default_rng([SEED, next(number)])
        return WORLD.read(CIRCLE, pose.x_mm, pose.y_mm, pose.orientation_rad, time_s=time_s, rng=rng)

    simulated = arm.SimulatedArm(light, reach=arm.Reach.everywhere())
    same = np.array([simulated.measure(arm.Pose(*place)).value for place in places])
    found = np.array([reading.value for reading in readings])
    assert (abs(found - same) <= 1 + 0.05 * same).all()
    assert np.mean(found == same) > 0.4


@pytest.mark.parametrize("name", RATES)
def test_the_arm_reads_on_under_every_fault(clock: VirtualClock, name: str) -> None:
    places = some_places(4)
    bench = bench_with(RATES[name], clock)
    readings, longest_s = measured(bench, clock, places)
    assert right(readings, places)
    assert longest_s <= 2 * Timing().longest_s
    clock.sleep(2.0)
    bench.radio.brick.advance()
    assert not any(motor.speed_deg_s for motor in bench.arm.motors())


@pytest.mark.slow
@pytest.mark.parametrize("name", RATES)
def test_a_hundred_and_fifty_mishaps_of_a_kind_lose_and_double_nothing(clock: VirtualClock, name: str) -> None:
    """1,050 in all: no question outlasts its deadline, no reading is another place's, no motor is left running."""
    places = some_places(10)
    bench = bench_with(RATES[name], clock)
    n_readings = 0
    while bench.radio.mishaps[name] < 150:
        readings, longest_s = measured(bench, clock, places)
        n_readings += len(readings)
        assert right(readings, places)
        assert longest_s <= 2 * Timing().longest_s
        clock.sleep(2.0)
        bench.radio.brick.advance()
        assert not any(motor.speed_deg_s for motor in bench.arm.motors())
    assert n_readings >= 10
