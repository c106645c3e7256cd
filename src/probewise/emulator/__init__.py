"""An emulated LEGO NXT brick with the arm of the paper's test bed (section "Robotic Arm Test Bed").

The emulator answers LEGO's Bluetooth protocol byte for byte, simulates motors that overshoot, and reads a light sensor
over a `world`. It shares no code with the driver in `arm`, so each tests the other.
"""

from probewise.emulator.arm import (
    EmulatedArm,
    Geometry,
    Joint,
    JointParameters,
    SensorPose,
    read_geometry,
    shipped_geometry_path,
)
from probewise.emulator.bench import EmulatedBench, LightModel, Tabletop, parse_scene, set_up_bench
from probewise.emulator.brick import Brick
from probewise.emulator.inputs import LightSensor, Sensor, empty_port
from probewise.emulator.motors import Motor
from probewise.emulator.protocol import Clock, VirtualClock
from probewise.emulator.radio import Faults, Radio, Trace, VirtualLine

__all__ = [
    "Brick",
    "Clock",
    "EmulatedArm",
    "EmulatedBench",
    "Faults",
    "Geometry",
    "Joint",
    "JointParameters",
    "LightModel",
    "LightSensor",
    "Motor",
    "Radio",
    "Sensor",
    "SensorPose",
    "Tabletop",
    "Trace",
    "VirtualClock",
    "VirtualLine",
    "empty_port",
    "parse_scene",
    "read_geometry",
    "set_up_bench",
    "shipped_geometry_path",
]
