"""An emulated LEGO NXT brick with the arm of the paper's test bed (section "Robotic Arm Test Bed").

The emulator answers LEGO's Bluetooth protocol byte for byte, simulates motors that overshoot, and reads a light sensor
over a `world`. It shares no code with the driver in `arm`, so each tests the other.
"""

from probewise.emulator.bench import (
    EmulatedArm,
    EmulatedBench,
    LightModel,
    SensorPose,
    Tabletop,
    parse_scene,
    read_geometry,
    set_up_bench,
)
from probewise.emulator.brick import Brick, LightSensor, empty_port
from probewise.emulator.motors import Motor
from probewise.emulator.protocol import VirtualClock
from probewise.emulator.radio import Faults, Radio, Trace, VirtualLine

__all__ = [
    "Brick",
    "EmulatedArm",
    "EmulatedBench",
    "Faults",
    "LightModel",
    "LightSensor",
    "Motor",
    "Radio",
    "SensorPose",
    "Tabletop",
    "Trace",
    "VirtualClock",
    "VirtualLine",
    "empty_port",
    "parse_scene",
    "read_geometry",
    "set_up_bench",
]
