"""Challenges for the diagnosis of users' simulators: systems with concealed effects."""

from probewise.proof.challenge.systems.case import run_system_case
from probewise.proof.challenge.systems.table import name_without_target, score_systems

__all__ = ["name_without_target", "run_system_case", "score_systems"]
