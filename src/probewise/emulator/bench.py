"""The whole emulated bench: arm, light sensor, brick and radio link over a surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise.emulator.arm import EmulatedArm
from probewise.emulator.brick import Battery, Brick
from probewise.emulator.clock import Clock
from probewise.emulator.faults import Faults
from probewise.emulator.geometry import Geometry
from probewise.emulator.inputs import Sensor
from probewise.emulator.light_model import LightModel
from probewise.emulator.radio import Radio, Trace, ignore_trace
from probewise.emulator.sensors import EmptyPort, LightSensor, ultrasonic_sensor
from probewise.emulator.table import Tabletop
from probewise.world import Surface, World

_WALL_CM = 42


@dataclass(frozen=True)
class EmulatedBench:
    """The emulated bench; `arm` and `radio.brick` give access to its state."""

    table: Tabletop
    arm: EmulatedArm
    radio: Radio


def set_up_bench(
    geometry: Geometry,
    world: World,
    surface: Surface,
    clock: Clock,
    *,
    seed: int,
    name: str = "NXT",
    faults: Faults | None = None,
    sleep_min: int = 10,
    trace: Trace = ignore_trace,
) -> EmulatedBench:
    """Build a bench, the arm at home.

    Parameters
    ----------
    geometry
        Dimensions of the arm.
    world
        World that simulates the readings of the light sensor at the geometry's reading height.
    surface
        The surface at the start.
    clock
        Time in seconds: `time.monotonic`, or a VirtualClock.
    seed
        Seed of the sensor's noise and of the link's faults.
    name, sleep_min
        The brick's name, and minutes until the brick switches itself off; 0: never.
    faults
        Rates of faults; None for none.
    trace
        Function that is called with every telegram and fault, see `Trace`.

    Raises
    ------
    ParameterError
        If the name or `sleep_min` is invalid.
    """
    faults = Faults() if faults is None else faults
    arm = EmulatedArm(geometry)
    table = Tabletop(surface)
    light = LightModel(world, table, arm.sensor_pose, read_height_mm=geometry.read_height_mm, seed=seed, clock=clock)
    sensors: list[Sensor] = [EmptyPort() for _ in range(4)]
    at = geometry.sensor_port - 1
    sensors[at] = LightSensor(light, clock)
    sensors[0 if at == 3 else 3] = ultrasonic_sensor(_WALL_CM)
    brick = Brick(
        clock,
        motors=arm.motors(),
        sensors=sensors,
        name=name,
        battery=Battery(sag_mv_min=faults.sag),
        sleep_min=sleep_min,
        watch=arm.record_lowest,
    )
    rng = np.random.default_rng([seed, 1])
    return EmulatedBench(table, arm, Radio(brick, clock, rng=rng, faults=faults, trace=trace))
