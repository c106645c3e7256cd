"""Challenges: simulated recordings with concealed effects, diagnosed blind and scored.

The paper judges a sensor model by the inferences made with it (section "Efficacy of Sensor Model"); a diagnosis is
judged here the same way, on recordings of an independent simulator whose truth it never sees.
"""

from probewise.proof.challenge.case import RunCaseInRounds, Task, run_case
from probewise.proof.challenge.confusion import confusion_counts
from probewise.proof.challenge.estimates import Estimate
from probewise.proof.challenge.null_refit import NullRefit
from probewise.proof.challenge.reliability import Bin, calibration_error, reliability_bins
from probewise.proof.challenge.rounds import score_rounds
from probewise.proof.challenge.run import run_challenge
from probewise.proof.challenge.table import Decision, ScoreRow, detected_and_named_by_effect, score

__all__ = [
    "Bin",
    "Decision",
    "Estimate",
    "NullRefit",
    "RunCaseInRounds",
    "ScoreRow",
    "Task",
    "calibration_error",
    "confusion_counts",
    "detected_and_named_by_effect",
    "reliability_bins",
    "run_case",
    "run_challenge",
    "score",
    "score_rounds",
]
