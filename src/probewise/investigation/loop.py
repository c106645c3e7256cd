"""The loop of an investigation: record a plan, diagnose all readings so far, plan further ones."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from probewise._arrays import own_arithmetic
from probewise._kinds import checked_whole, require_accepts_positional, require_kind, require_rng
from probewise.diagnosis import Diagnosis, SensorPrior, diagnose
from probewise.effects import VOCABULARY, NamedEffect
from probewise.investigation.budget import Budget
from probewise.investigation.rounds import Round, reason_if_settled
from probewise.progress import Progress, silent
from probewise.recordings.plan import Plan, Recording, require_plan

MOST_ROUNDS = 6

Record: TypeAlias = Callable[[int, Plan, str], Recording]
"""Function of a round's number, its plan and the plan in words; returns the recording, which may be shorter."""


@own_arithmetic
def investigate(
    record: Record,
    plan: Plan,
    *,
    sensor: SensorPrior | None = None,
    effects: Mapping[str, type[NamedEffect[Any]]] = VOCABULARY,
    budget: Budget | None = None,
    rounds: int = MOST_ROUNDS,
    hands: bool = True,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> Generator[Round, None, None]:
    """Yield rounds of an investigation until an explanation is settled, no reading would help, or the budget is spent.

    A round, a recording and its diagnosis, is carried out only when it is asked for. An explanation is settled if it
    has probability 0.95 and the verdict is not `cannot_tell`. There are at most `rounds` rounds.

    Parameters
    ----------
    record
        Function that takes the readings: of a round's number, its plan and the plan in words; returns the recording.
    plan
        The first plan.
    sensor
        An earlier calibration, whose posterior becomes the prior; without it each diagnosis calibrates its own.
    effects
        The vocabulary: classes of effects, by name.
    budget
        Budget beyond `plan`; default: 400 readings.
    rounds
        Largest number of rounds, including the first.
    hands
        Whether a person can turn or exchange sheets; if not, plans only scan the sheet in place.
    rng
        Random generator; each round has its own child, so that a resumed investigation is reproducible.
    progress
        Called at every step.

    Yields
    ------
    Round
        One per round; the last has a `stop_reason`.

    Raises
    ------
    ParameterError
        If an argument is invalid; see also `diagnose`.
    """
    require_accepts_positional("record", record, 3, "a function of a round's number, its plan and the plan in words")
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
        rounds,
        rng.spawn(rounds),
    )


def _rounds_until_stop(
    record: Record,
    plan: Plan,
    diagnosed: Callable[..., Diagnosis],
    budget: Budget,
    rounds: int,
    rngs: list[np.random.Generator],
) -> Generator[Round, None, None]:
    """Yield the rounds; `diagnosed` diagnoses all recordings so far, `rngs` has one generator per round."""
    recordings: list[Recording] = []
    asked, wanted = "the first plan", plan
    for number, rng in enumerate(rngs, start=1):
        recordings.append(record(number, wanted, asked))
        diagnosis = diagnosed(recordings, rng=rng)
        settled, following = reason_if_settled(diagnosis), diagnosis.next_measurement
        over_s = max(float(each.plan.time_s.max()) for each in recordings)
        affordable = None if following is None else budget.affordable_scans(following.plan, over_s)
        spent = None
        if following is not None and affordable is None:
            spent = f"the budget of {budget.exhausted_part(following.plan)} is spent"
        reason = (
            settled
            or ("no further reading would tell more" if following is None else None)
            or (f"the limit of {rounds} rounds is reached" if number == rounds else None)
            or spent
        )
        yield Round(number, recordings[-1], asked, diagnosis, reason, settled is not None)
        if reason is not None or following is None or affordable is None:
            return
        budget = budget.minus(affordable, over_s)
        asked, wanted = following.description, affordable
        if affordable is not following.plan:
            asked = f"{asked.rstrip('.')}; the budget allows {len(affordable)} of {len(following.plan)} readings"
