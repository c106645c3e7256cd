"""Simulated systems with concealed effects, for challenges; the code is independent of the library's systems.

It produces what a user would provide (a table and a short simulator file) and, separately, the truth; it implements
the integration of laws, the effects and the fits a second time.
"""

from probewise.proof.systems.alternatives import nats_of_alternative
from probewise.proof.systems.cases import KINDS, DrawnSystem, SystemCase, SystemEffect, draw_system, draw_system_case
from probewise.proof.systems.files import simulator_file_text, truth_json, write_system_case
from probewise.proof.systems.noise import OTHER_NOISE
from probewise.proof.systems.right_model import right_predictions
from probewise.proof.systems.strata import SYSTEMS_WHEEL, system_stratum_of

__all__ = [
    "KINDS",
    "OTHER_NOISE",
    "SYSTEMS_WHEEL",
    "DrawnSystem",
    "SystemCase",
    "SystemEffect",
    "draw_system",
    "draw_system_case",
    "nats_of_alternative",
    "right_predictions",
    "simulator_file_text",
    "system_stratum_of",
    "truth_json",
    "write_system_case",
]
