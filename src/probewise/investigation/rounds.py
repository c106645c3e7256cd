"""What one round found, and what all of them came to."""

from __future__ import annotations

from dataclasses import dataclass

from probewise._display import ShowsItself
from probewise.diagnosis import Diagnosis
from probewise.recordings.plan import Recording

__all__ = ["SURE", "Investigation", "Round", "settled_by"]

SURE = 0.95  # probability from which a hypothesis is settled


@dataclass(frozen=True, eq=False)
class Round:
    """One round: its readings, and the diagnosis of all readings so far.

    Attributes
    ----------
    number
        From 1.
    recording
        What this round read.
    asked
        Why these readings were taken, in words.
    diagnosis
        Of this round's readings and all before.
    stop_reason
        Why the investigation ends here; None: it goes on.
    settled
        Whether it ends because one hypothesis has probability `SURE`.
    """

    number: int
    recording: Recording
    asked: str
    diagnosis: Diagnosis
    stop_reason: str | None
    settled: bool

    @property
    def believed(self) -> tuple[tuple[str, float], ...]:
        """The hypotheses after this round with their probabilities, most probable first."""
        return tuple((h.label, h.probability) for h in self.diagnosis.hypotheses)


@dataclass(frozen=True, eq=False)
class Investigation(ShowsItself):
    """All rounds of an investigation."""

    rounds: tuple[Round, ...]

    @property
    def last(self) -> Round:
        """The last round, whose diagnosis is of all readings."""
        return self.rounds[-1]

    @property
    def extra_readings(self) -> int:
        """How many readings were taken beyond the first round's."""
        return sum(len(each.recording) for each in self.rounds[1:])

    def summary(self) -> str:
        """Tell the rounds in plain text."""
        lines = []
        for each in self.rounds:
            label, probability = each.believed[0]
            lines.append(
                f"round {each.number}: {len(each.recording)} readings ({each.asked}); "
                f"{each.diagnosis.verdict}, {label} {probability:.3f}"
            )
        lines.append(f"ended: {self.last.stop_reason}")
        lines.append(self.last.diagnosis.reason)
        return "\n".join(lines)


def settled_by(diagnosis: Diagnosis) -> str | None:
    """Say which hypothesis settles a diagnosis: the first with probability `SURE`; None where none does.

    What the verdict does not state, such as aliases that readings cannot tell apart, is not settled.
    """
    first = diagnosis.hypotheses[0]
    if diagnosis.verdict == "cannot_tell" or first.probability < SURE:
        return None
    return f"{first.label.replace('_', ' ')} has probability {first.probability:.3f}"
