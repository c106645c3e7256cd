"""Instruments that take readings: one interface, a simulated arm and the LEGO arm (paper, "Robotic Arm Test Bed")."""

from probewise.arm.carry_out import Request, carry_out, readings_of, recording_of
from probewise.arm.geometry import Geometry, Joint
from probewise.arm.geometry_file import read_geometry, shipped_geometry
from probewise.arm.instrument import Instrument, Pose, Reading
from probewise.arm.lego import LegoArm, in_lego_units
from probewise.arm.limits import SoftLimits
from probewise.arm.machine import DryRun, Machine
from probewise.arm.own_instrument import Measures, OwnInstrument, instrument_of
from probewise.arm.reach import FIELD_MM, Reach, Workspace, require_reach
from probewise.arm.scale import ReadingScale
from probewise.arm.simulated import Light, SimulatedArm, Speed

__all__ = [
    "FIELD_MM",
    "DryRun",
    "Geometry",
    "Instrument",
    "Joint",
    "LegoArm",
    "Light",
    "Machine",
    "Measures",
    "OwnInstrument",
    "Pose",
    "Reach",
    "Reading",
    "ReadingScale",
    "Request",
    "SimulatedArm",
    "SoftLimits",
    "Speed",
    "Workspace",
    "carry_out",
    "in_lego_units",
    "instrument_of",
    "read_geometry",
    "readings_of",
    "recording_of",
    "require_reach",
    "shipped_geometry",
]

recorded = recording_of
"""The old name of `recording_of`."""

Rehearsal = DryRun
"""The old name of `DryRun`."""

LegoScale = ReadingScale
"""The old name of `ReadingScale`."""
