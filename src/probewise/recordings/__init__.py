"""Plans, recordings and predictions, and their files (paper, "Data Collection for SSF Estimation")."""

from probewise._writing import hold_lock, write_bytes_atomically, write_text_atomically
from probewise.recordings.files import (
    Prediction,
    fingerprint,
    read_plan,
    read_plan_and_readings,
    read_prediction_columns,
    read_recording,
    write_plan,
    write_prediction,
    write_recording,
)
from probewise.recordings.io import parse_json_file_text, parse_strict_json, read_bytes, read_text, shipped
from probewise.recordings.patterns import Disc, HalfPlane, Image, Pattern, Polygon, Quadrant, Ramp, Stripes, Uniform
from probewise.recordings.plan import Instrumentation, Plan, Recording
from probewise.recordings.plans import paper_plan, two_way_plan

__all__ = [
    "Disc",
    "HalfPlane",
    "Image",
    "Instrumentation",
    "Pattern",
    "Plan",
    "Polygon",
    "Prediction",
    "Quadrant",
    "Ramp",
    "Recording",
    "Stripes",
    "Uniform",
    "fingerprint",
    "hold_lock",
    "paper_plan",
    "parse_json_file_text",
    "parse_strict_json",
    "read_bytes",
    "read_plan",
    "read_plan_and_readings",
    "read_prediction_columns",
    "read_recording",
    "read_text",
    "shipped",
    "two_way_plan",
    "write_bytes_atomically",
    "write_plan",
    "write_prediction",
    "write_recording",
    "write_text_atomically",
]
