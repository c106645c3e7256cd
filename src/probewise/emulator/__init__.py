"""A LEGO NXT brick in software, with the arm of the paper's test bed hanging on it ("Robotic Arm Test Bed").

It answers LEGO's Bluetooth protocol byte for byte, turns motors that run on past their goal, and reads a
light sensor over a `world`. It shares no code with the driver in `arm`: each is the other's proof.
"""

from probewise.emulator.arm import EmulatedArm, Joint, Stand
from probewise.emulator.bench import Bench, set_up
from probewise.emulator.brick import Battery, Brick
from probewise.emulator.clock import Clock, VirtualClock
from probewise.emulator.faults import Faults
from probewise.emulator.geometry import Geometry, JointNumbers, read_geometry, shipped_geometry
from probewise.emulator.line import VirtualLine
from probewise.emulator.motor import Motor, MotorNature
from probewise.emulator.radio import Radio, Trace
from probewise.emulator.scenes import parse_scene
from probewise.emulator.sensors import Analog, Digital, Light, NothingAnalog, sonar
from probewise.emulator.sight import Sight
from probewise.emulator.table import Table

__all__ = [
    "Analog",
    "Battery",
    "Bench",
    "Brick",
    "Clock",
    "Digital",
    "EmulatedArm",
    "Faults",
    "Geometry",
    "Joint",
    "JointNumbers",
    "Light",
    "Motor",
    "MotorNature",
    "NothingAnalog",
    "Radio",
    "Sight",
    "Stand",
    "Table",
    "Trace",
    "VirtualClock",
    "VirtualLine",
    "parse_scene",
    "read_geometry",
    "set_up",
    "shipped_geometry",
    "sonar",
]
