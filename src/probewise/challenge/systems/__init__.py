"""Does the diagnosis of a person's simulator keep its promises? Concealed systems tell."""

from probewise.challenge.systems.case import run_system_case
from probewise.challenge.systems.table import family_of, score_systems

__all__ = ["family_of", "run_system_case", "score_systems"]
