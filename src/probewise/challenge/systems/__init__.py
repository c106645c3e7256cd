"""Challenges for the diagnosis of users' simulators: systems with concealed effects."""

from probewise.challenge.systems.case import run_system_case
from probewise.challenge.systems.table import family_of, score_systems

__all__ = ["family_of", "run_system_case", "score_systems"]
