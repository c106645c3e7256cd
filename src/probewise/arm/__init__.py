"""Instruments that take readings: one interface, a simulated arm and the LEGO arm (paper, section 2.1)."""

from probewise.arm.carry_out import RequestToPerson, carry_out, readings_of_recording, recording_of_readings
from probewise.arm.geometry import Geometry, Joint, SoftLimits
from probewise.arm.geometry_file import read_geometry, shipped_geometry_path
from probewise.arm.instrument import Instrument, Pose, Reach, Reading, ReadingScale, require_within_reach
from probewise.arm.lego import DryRun, LegoArm, percent_to_lego_units
from probewise.arm.own import Measures, OwnInstrument, as_instrument
from probewise.arm.simulated import SimulatedArm, Speed, Workspace

__all__ = [
    "DryRun",
    "Geometry",
    "Instrument",
    "Joint",
    "LegoArm",
    "Measures",
    "OwnInstrument",
    "Pose",
    "Reach",
    "Reading",
    "ReadingScale",
    "RequestToPerson",
    "SimulatedArm",
    "SoftLimits",
    "Speed",
    "Workspace",
    "as_instrument",
    "carry_out",
    "percent_to_lego_units",
    "read_geometry",
    "readings_of_recording",
    "recording_of_readings",
    "require_within_reach",
    "shipped_geometry_path",
]
