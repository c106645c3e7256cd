"""Where readings come from: one interface, and the simulated arm behind it (paper, "Robotic Arm Test Bed")."""

from probewise.arm.instrument import Instrument, Pose, Reading
from probewise.arm.reach import FIELD_MM, Reach
from probewise.arm.simulated import LegoScale, Light, SimulatedArm, Speed

__all__ = ["FIELD_MM", "Instrument", "LegoScale", "Light", "Pose", "Reach", "Reading", "SimulatedArm", "Speed"]
