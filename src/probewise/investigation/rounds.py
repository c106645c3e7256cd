"""The results of one round, and of a whole investigation."""

from __future__ import annotations

from dataclasses import dataclass

from probewise._display import ShowsItself
from probewise.diagnosis import SETTLED, Diagnosis
from probewise.diagnosis.words import hypothesis_in_words
from probewise.recordings.plan import Recording

SURE = SETTLED
"""Probability from which a hypothesis is settled."""


@dataclass(frozen=True, eq=False)
class Round:
    """One round: its readings, and the diagnosis of all readings so far.

    Attributes
    ----------
    number
        Number of the round, from 1.
    recording
        Recording of this round.
    reason_for_readings
        The plan of this round in words.
    diagnosis
        Diagnosis of this and all earlier readings.
    stop_reason
        Reason why the investigation ends here; None: it continues.
    settled
        Whether it ends because one hypothesis has probability 0.95 or more.
    """

    number: int
    recording: Recording
    reason_for_readings: str
    diagnosis: Diagnosis
    stop_reason: str | None
    settled: bool

    @property
    def hypothesis_probabilities(self) -> tuple[tuple[str, float], ...]:
        """Labels of the hypotheses after this round with their probabilities, most probable first."""
        return tuple((h.label, h.probability) for h in self.diagnosis.hypotheses)


@dataclass(frozen=True, eq=False)
class Investigation(ShowsItself):
    """All rounds of an investigation, in order."""

    rounds: tuple[Round, ...]

    @property
    def last(self) -> Round:
        """The last round, whose diagnosis is of all readings."""
        return self.rounds[-1]

    @property
    def extra_readings(self) -> int:
        """Number of readings after the first round."""
        return sum(len(each.recording) for each in self.rounds[1:])

    def summary(self) -> str:
        """Return a plain-text summary of the rounds."""
        lines = []
        for each in self.rounds:
            label, probability = each.hypothesis_probabilities[0]
            lines.append(
                f"round {each.number}: {len(each.recording)} readings ({each.reason_for_readings}); "
                f"{each.diagnosis.verdict}, {label} {probability:.3f}"
            )
        lines.append(f"ended: {self.last.stop_reason}")
        lines.append(self.last.diagnosis.reason)
        return "\n".join(lines)


def reason_if_settled(diagnosis: Diagnosis) -> str | None:
    """Return a sentence on the leading hypothesis if its probability is 0.95 or more; else None.

    None also for the verdict cannot_tell: aliased effects are not settled.
    """
    first = diagnosis.hypotheses[0]
    if diagnosis.verdict == "cannot_tell" or first.probability < SURE:
        return None
    return f"{hypothesis_in_words(first.effects)}: probability {first.probability:.3f}"
