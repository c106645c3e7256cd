"""Investigations: record, diagnose, take the advised readings, and repeat until one explanation is settled.

One diagnosis says what a sensor model leaves out and which readings would tell more. An investigation takes them:
each round records the plan that the previous diagnosis advised, and diagnoses all readings so far.
"""

from __future__ import annotations

import inspect
import json
import math
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from probewise._arrays import own_arithmetic
from probewise._display import Reported
from probewise._kinds import checked_number, checked_whole, require_accepts, require_kind, require_rng
from probewise.arm import Reading, readings_of_recording, recording_of_readings
from probewise.arm.carry_out import readings_begun_with
from probewise.diagnosis import SETTLED, Diagnosis, SensorPrior, diagnose
from probewise.diagnosis.words import hypothesis_in_words
from probewise.effects import VOCABULARY, LightEffect
from probewise.errors import FileError, ParameterError, did_you_mean, require, shown
from probewise.progress import Progress, silent
from probewise.recordings import (
    parse_json_file_text,
    read_plan,
    read_recording,
    read_text,
    write_plan,
    write_recording,
    write_text_atomically,
)
from probewise.recordings.plan import Plan, Recording, require_plan
from probewise.world import World
from probewise.world.stages import KINDS, Concealed

__all__ = [
    "MOST_ROUNDS",
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

MOST_ROUNDS = 6

Record: TypeAlias = Callable[[int, Plan, str], Recording]
"""Function of a round's number, its plan and the plan in words; returns the recording, which may be shorter."""


@own_arithmetic
def investigate(
    record: Record,
    plan: Plan,
    *,
    sensor: SensorPrior | None = None,
    effects: Mapping[str, LightEffect] = VOCABULARY,
    budget: Budget | None = None,
    rounds: int = MOST_ROUNDS,
    hands: bool = True,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> Generator[Round, None, None]:
    """Yield rounds of an investigation until an explanation is settled, no reading would help, or the budget is spent.

    A round, a recording and its diagnosis, is carried out only when it is asked for; the last has a `stop_reason`. An
    explanation is settled if it has probability 0.95 and the verdict is not `cannot_tell`.

    `record` takes the readings: of a round's number, its plan and the plan in words; returns the recording. `plan` is
    the first plan; `sensor` an earlier calibration, whose posterior becomes the prior, without which each diagnosis
    calibrates its own; `effects` the vocabulary, by name; `budget` what may be spent beyond `plan`, by default 400
    readings; `rounds` the largest number of rounds, including the first; `hands` whether a person can turn or exchange
    sheets; if not, plans only scan the sheet in place. Each round has its own child of `rng`, so that a resumed
    investigation is reproducible. ParameterError if an argument is invalid; see also `diagnose`.
    """
    takes = "a function of a round's number, its plan and the plan in words"
    require_accepts("record", record, takes, None, None, None)
    require_plan(plan)
    require_rng(rng)
    if budget is not None:
        require_kind("budget", budget, Budget, "a Budget(readings=..., minutes=...), or None")
    checked_whole("rounds", rounds)
    return _rounds_until_stop(
        record,
        plan,
        partial(diagnose, sensor=sensor, effects=effects, hands=hands, progress=progress),
        Budget() if budget is None else budget,
        rng.spawn(rounds),
    )


def _rounds_until_stop(
    record: Record, plan: Plan, diagnosed: Callable[..., Diagnosis], budget: Budget, rngs: list[np.random.Generator]
) -> Generator[Round, None, None]:
    """Yield the rounds; `diagnosed` diagnoses all recordings so far, `rngs` has one generator per round."""
    recordings: list[Recording] = []
    in_words = "the first plan"
    for number, rng in enumerate(rngs, start=1):
        recordings.append(record(number, plan, in_words))
        diagnosis = diagnosed(recordings, rng=rng)
        settled, following = reason_if_settled(diagnosis), diagnosis.next_measurement
        over_s = max(float(recording.plan.time_s.max()) for recording in recordings)
        affordable = None if following is None else budget.affordable_scans(following.plan, over_s)
        reason = settled
        if reason is None and following is None:
            reason = "no further reading would tell more"
        elif reason is None and number == len(rngs):
            reason = f"the limit of {number} rounds is reached"
        elif reason is None and following is not None and affordable is None:
            first = next((rows for rows in following.plan.rows_by_scan() if rows.size), ())
            reason = f"the budget of {'readings' if len(first) > budget.readings else 'minutes'} is spent"
        yield Round(number, recordings[-1], in_words, diagnosis, reason, settled is not None)
        if reason is not None or following is None or affordable is None:
            return
        minutes = max(budget.minutes - _minutes_of_plan(affordable, over_s), 0.0)
        budget = Budget(max(budget.readings - len(affordable), 0), minutes)
        plan, in_words = affordable, following.description
        if affordable is not following.plan:
            in_words = f"{in_words.rstrip('.')}; the budget allows {len(affordable)} of {len(following.plan)} readings"


@dataclass(frozen=True)
class Budget:
    """Readings and minutes that may be spent after the first plan; either may be infinite.

    Minutes are measured by the times in the plans, breaks between rounds included.
    """

    readings: float = 400
    minutes: float = math.inf

    def __post_init__(self) -> None:
        for name in ("readings", "minutes"):
            require(checked_number(name, getattr(self, name)) >= 0, name, getattr(self, name), "0 or more")

    def affordable_scans(self, plan: Plan, after_s: float) -> Plan | None:
        """Return the plan's first scans that fit the budget, in minutes from the time `after_s`; None if none does."""
        kept = np.zeros(0, dtype=np.int64)
        for rows in plan.rows_by_scan():
            more = np.concatenate([kept, rows])
            if len(more) > self.readings or _minutes_of_plan(plan.take(more), after_s) > self.minutes:
                break
            kept = more
        if len(kept) == len(plan):
            return plan
        return plan.take(kept) if kept.size else None


def _minutes_of_plan(plan: Plan, after_s: float) -> float:
    return (float(plan.time_s.max()) - after_s) / 60.0


@dataclass(frozen=True, eq=False)
class Round:
    """One round: its recording, the plan in words (`reason_for_readings`), and the diagnosis of all readings so far.

    Rounds count from 1. `stop_reason` says why the investigation ends here (None: it continues), `settled` whether
    because one hypothesis has probability 0.95 or more.
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
class Investigation(Reported):
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
    if diagnosis.verdict == "cannot_tell" or first.probability < SETTLED:
        return None
    return f"{hypothesis_in_words(first.effects)}: probability {first.probability:.3f}"


Take: TypeAlias = Callable[[int, Plan, str, Sequence[Reading]], Iterator[Reading]]
"""Function of a round's number, its plan, the plan in words and the readings so far; yields the further readings."""

_SETTINGS = "settings.json"
_ALLOWED = "the settings of an investigation, a JSON object"
_KEPT_AGAIN_S = 0.5  # an arm takes longer per reading, so that none of its readings is lost


class RoundsFolder:
    """The folder of one investigation: plan and readings of each round; made with the first round.

    `settings`, as JSON takes them, determine the investigation. FileError if the folder holds an investigation and
    `resume` is False, or holds none, or one with other settings, and `resume` is True.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any], *, resume: bool) -> None:
        self.path = path
        file, self._settings = path / _SETTINGS, dict(settings)
        if not resume:
            # A process killed as it wrote may have left a hidden file.
            if path.exists() and any(not entry.name.startswith(".") for entry in path.iterdir()):
                found = "an investigation is" if file.exists() else "files of a person are"
                raise FileError(path, f"{found} in this folder", "--resume to continue it, or another --out")
            return
        if not file.exists():
            raise FileError(file, "no such file", "an investigation to resume; omit --resume to begin a new one")
        before = parse_json_file_text(file, read_text(file, _ALLOWED), _ALLOWED)
        if not isinstance(before, dict):
            raise FileError(file, "no JSON object", _ALLOWED)
        for name, value in self._settings.items():
            if before.get(name) != value:
                found, allowed = f"{name} {shown(before.get(name))}", f"{shown(value)}, as asked now"
                if name in ("plan", "sensor"):  # their digests say nothing to a person
                    found, allowed = f"another {name}", f"the {name} that it was begun with, or another --out"
                raise FileError(file, f"an investigation with {found}", allowed)

    def record_round(
        self, number: int, plan: Plan, asked: str, *, take: Take, progress: Progress = silent
    ) -> Recording:
        """Take the readings of a round, or those still missing, write them to the folder, and return all of them.

        A plan of the round that is in the folder already is used in place of `plan`; `asked` is the plan in words.
        FileError if the readings there are not of its first rows.
        """
        planned, readings_file = self.path / f"{number}_plan.csv", self.path / f"{number}.csv"
        if not planned.exists():
            self.path.mkdir(parents=True, exist_ok=True)
            if not (self.path / _SETTINGS).exists():
                text = json.dumps(self._settings, indent=1, allow_nan=False) + "\n"
                write_text_atomically(self.path / _SETTINGS, text)
            write_plan(plan, planned)
        plan = read_plan(planned)
        readings = readings_begun_with(plan, readings_file) if readings_file.exists() else []
        kept_s = time.monotonic()
        progress(f"round {number}, readings", len(readings), len(plan))
        try:
            for reading in take(number, plan, asked, tuple(readings)):
                readings.append(reading)
                progress(f"round {number}, readings", len(readings), len(plan))
                if time.monotonic() - kept_s > _KEPT_AGAIN_S:
                    write_recording(recording_of_readings(plan, readings), readings_file)
                    kept_s = time.monotonic()
        finally:  # an error or an interruption loses none of them
            if readings:
                write_recording(recording_of_readings(plan, readings), readings_file)
        return read_recording(readings_file)

    @property
    def n_readings(self) -> int:
        """Number of readings in the folder, of all rounds."""
        return sum(map(len, self._recordings_of_rounds()))

    @property
    def last_time_s(self) -> float:
        """Time of the last reading in seconds; 0 if there is none."""
        return max((float(recording.plan.time_s.max()) for recording in self._recordings_of_rounds()), default=0.0)

    def _recordings_of_rounds(self) -> Iterator[Recording]:
        return (read_recording(file) for file in self.path.glob("[0-9]*.csv") if file.stem.isdigit())


NOTHING = "nothing"
_LARGEST = 1e9  # largest magnitude of a parameter of an effect


@dataclass(frozen=True)
class SimulatedRecorder:
    """A `Take` function that simulates a plan in a world, with noise by the seed and the round's number."""

    world: World
    seed: int

    def __call__(self, number: int, plan: Plan, asked: str, taken: Sequence[Reading]) -> Iterator[Reading]:
        """Yield the readings of a round's plan after those already taken."""
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(number,)))
        yield from readings_of_recording(self.world.simulate(plan, rng=rng))[len(taken) :]


def parse_concealed(text: str, option: str = "--truth") -> tuple[Concealed, ...]:
    """Parse concealed effects: NAME:VALUE,VALUE, several joined by +, or "nothing" for none.

    ParameterError, of `option`, if an effect is unknown, or its values are too few, too many, or no numbers up to 1e9.
    """
    return () if text == NOTHING else tuple(_parse_one_effect(part, option) for part in text.split("+"))


def _parse_one_effect(text: str, option: str) -> Concealed:
    name, _, numbers = text.partition(":")
    names_of = {own: inspect.signature(kind).parameters for own, kind in KINDS.items()}
    kinds = {own for own, taken in names_of.items() if {each.annotation for each in taken.values()} == {"float"}}
    allowed = f"{NOTHING}, or an effect of probewise.world.concealed with its values{did_you_mean(name, kinds)}"
    require(name in kinds, option, name, allowed)
    allowed = f"{name}:{','.join(names_of[name])}, all of them numbers of magnitude up to {_LARGEST:g}"
    try:
        values = [float(number) for number in numbers.split(",")]
        effect: Concealed = KINDS[name](*values)
    except (TypeError, ValueError) as error:
        raise ParameterError(option, text, allowed) from error
    require(all(abs(value) <= _LARGEST for value in values), option, text, allowed)  # nor NaN
    return effect
