"""From a doubt to an answer: record, diagnose, take the readings that the diagnosis asks for, until it is settled.

One diagnosis says what a sensor model leaves out and which readings would tell more. An investigation takes them:
each round records what the round before asked for and diagnoses everything read so far.
"""

from probewise.investigation.budget import Budget
from probewise.investigation.folder import RoundsFolder, Take
from probewise.investigation.loop import MOST_ROUNDS, Record, investigate
from probewise.investigation.rounds import SURE, Investigation, Round, settled_by
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
    "settled_by",
]
