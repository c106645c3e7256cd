"""Instruments that take readings: one interface, a simulated arm and the LEGO arm (paper, "Robotic Arm Test Bed")."""

from probewise.arm.carry_out import RequestToPerson, carry_out, readings_of_recording, recording_of_readings
from probewise.arm.geometry import Geometry, Joint
from probewise.arm.geometry_file import read_geometry, shipped_geometry_path
from probewise.arm.instrument import Instrument, Pose, Reading
from probewise.arm.lego import LegoArm, percent_to_lego_units
from probewise.arm.limits import SoftLimits
from probewise.arm.machine import DryRun, Machine
from probewise.arm.own_instrument import Measures, OwnInstrument, as_instrument
from probewise.arm.reach import FIELD_MM, Reach, Workspace, require_within_reach
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

readings_of = readings_of_recording
"""The old name of `readings_of_recording`."""

Request = RequestToPerson
"""The old name of `RequestToPerson`."""

require_reach = require_within_reach
"""The old name of `require_within_reach`."""

shipped_geometry = shipped_geometry_path
"""The old name of `shipped_geometry_path`."""

recorded = recording_of_readings
"""The old name of `recording_of_readings`."""

Rehearsal = DryRun
"""The old name of `DryRun`."""

LegoScale = ReadingScale
"""The old name of `ReadingScale`."""

recording_of = recording_of_readings
"""The old name of `recording_of_readings`."""

instrument_of = as_instrument
"""The old name of `as_instrument`."""

in_lego_units = percent_to_lego_units
"""The old name of `percent_to_lego_units`."""
