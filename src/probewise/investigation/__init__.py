"""Investigations: record, diagnose, take the advised readings, and repeat until one explanation is settled.

One diagnosis says what a sensor model leaves out and which readings would tell more. An investigation takes them:
each round records the plan that the previous diagnosis advised, and diagnoses all readings so far.
"""

from probewise.investigation.budget import Budget
from probewise.investigation.folder import RoundsFolder, Take
from probewise.investigation.loop import MOST_ROUNDS, Record, investigate
from probewise.investigation.rounds import SURE, Investigation, Round, reason_if_settled
from probewise.investigation.simulated import SimulatedRecorder, parse_concealed

__all__ = [
    "MOST_ROUNDS",
    "SURE",
    "Budget",
    "Investigation",
    "Record",
    "Round",
    "RoundsFolder",
    "SimulatedRecorder",
    "Take",
    "investigate",
    "parse_concealed",
    "reason_if_settled",
]
