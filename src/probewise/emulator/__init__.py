"""An emulated LEGO NXT brick with the arm of the paper's test bed (section "Robotic Arm Test Bed").

The emulator answers LEGO's Bluetooth protocol byte for byte, simulates motors that overshoot, and reads a light sensor
over a `world`. It shares no code with the driver in `arm`, so each tests the other.
"""

from probewise.emulator.arm import EmulatedArm, Joint, SensorPose
from probewise.emulator.bench import EmulatedBench, set_up_bench
from probewise.emulator.brick import Battery, Brick
from probewise.emulator.clock import Clock, VirtualClock
from probewise.emulator.faults import Faults
from probewise.emulator.geometry import Geometry, JointParameters, read_geometry, shipped_geometry_path
from probewise.emulator.light_model import LightModel
from probewise.emulator.line import VirtualLine
from probewise.emulator.motor import Motor, MotorParameters
from probewise.emulator.radio import Radio, Trace
from probewise.emulator.scenes import parse_scene
from probewise.emulator.sensors import AnalogSensor, DigitalSensor, EmptyPort, LightSensor, ultrasonic_sensor
from probewise.emulator.table import Tabletop

__all__ = [
    "AnalogSensor",
    "Battery",
    "Brick",
    "Clock",
    "DigitalSensor",
    "EmptyPort",
    "EmulatedArm",
    "EmulatedBench",
    "Faults",
    "Geometry",
    "Joint",
    "JointParameters",
    "LightModel",
    "LightSensor",
    "Motor",
    "MotorParameters",
    "Radio",
    "SensorPose",
    "Tabletop",
    "Trace",
    "VirtualClock",
    "VirtualLine",
    "parse_scene",
    "read_geometry",
    "set_up_bench",
    "shipped_geometry_path",
    "ultrasonic_sensor",
]
