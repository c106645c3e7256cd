"""The result of one round, and of a whole investigation."""

from __future__ import annotations

from dataclasses import dataclass

from probewise._display import ShowsItself
from probewise.diagnosis import Diagnosis
from probewise.recordings.plan import Recording

SURE = 0.95  # probability from which a hypothesis is settled


@dataclass(frozen=True, eq=False)
class Round:
    """One round: its readings, and the diagnosis of all readings so far.

    Attributes
    ----------
    number
        From 1.
    recording
        Recording of this round.
    asked
        Reason for these readings, in words.
    diagnosis
        Diagnosis of this and all earlier readings.
    stop_reason
        Reason why the investigation ends here; None: it continues.
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
        """Number of readings after the first round."""
        return sum(len(each.recording) for each in self.rounds[1:])

    def summary(self) -> str:
        """Return a plain-text summary of the rounds."""
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
    """Return the hypothesis that settles a diagnosis, the first with probability `SURE`, in words; else None.

    Aliased effects, which the verdict does not state, are not settled.
    """
    first = diagnosis.hypotheses[0]
    if diagnosis.verdict == "cannot_tell" or first.probability < SURE:
        return None
    return f"{first.label.replace('_', ' ')} has probability {first.probability:.3f}"
