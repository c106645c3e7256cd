"""The loop: record a plan, diagnose everything, ask for more, until it is settled or the budget is spent."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from probewise._kinds import require_kind, require_rng, require_takes_places, require_whole
from probewise.diagnosis import Diagnosis, NextMeasurement, SensorPrior, diagnose
from probewise.effects import VOCABULARY, NamedEffect
from probewise.investigation.budget import Budget
from probewise.investigation.rounds import Round, settled_by
from probewise.progress import Progress, silent
from probewise.recordings.plan import Plan, Recording, require_plan

__all__ = ["MOST_ROUNDS", "Record", "investigate"]

MOST_ROUNDS = 6

Record: TypeAlias = Callable[[int, Plan, str], Recording]
"""Takes a round's number, its plan and the plan in words, and gives the recording; it may hold fewer readings."""


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
    """Record and diagnose until one hypothesis has probability .95, or nothing more can be told or afforded.

    Parameters
    ----------
    record
        Takes the readings of a round's plan.
    plan
        What is recorded first.
    sensor
        An earlier calibration, whose posterior becomes the prior; without it each diagnosis calibrates its own.
    effects
        The vocabulary to choose from, by name.
    budget
        How much may be measured beyond `plan`; 400 readings where none is given.
    rounds
        How many rounds at most, the first included.
    hands
        Whether somebody can turn a sheet or lay another one; without, only scans over what lies there are taken.
    rng
        Source of randomness; each round has a child of its own, so that a resumed investigation goes on alike.
    progress
        Told of every step.

    Yields
    ------
    One `Round` a round; the last has a `stop_reason`.

    Raises
    ------
    ParameterError
        If an argument is not what it has to be; see also `diagnose`.
    """
    require_takes_places("record", record, 3, "a function of a round's number, its plan and the plan in words")
    require_plan(plan)
    require_rng(rng)
    if budget is not None:
        require_kind("budget", budget, Budget, "a Budget(readings=..., minutes=...), or None")
    require_whole("rounds", rounds)
    return _rounds(
        record,
        plan,
        partial(diagnose, sensor=sensor, effects=effects, hands=hands, progress=progress),
        Budget() if budget is None else budget,
        rounds,
        rng.spawn(rounds),
    )


def _rounds(
    record: Record,
    plan: Plan,
    diagnosed: Callable[..., Diagnosis],
    budget: Budget,
    rounds: int,
    rngs: list[np.random.Generator],
) -> Generator[Round, None, None]:
    recordings: list[Recording] = []
    asked, wanted = "the first plan", plan
    for number, rng in enumerate(rngs, start=1):
        recordings.append(record(number, wanted, asked))
        diagnosis = diagnosed(recordings, rng=rng)
        settled, following = settled_by(diagnosis), diagnosis.next_measurement
        over_s = max(float(each.plan.time_s.max()) for each in recordings)
        affordable = None if following is None else budget.affordable(following.plan, over_s)
        reason = (
            settled
            or _nothing_to_ask(following)
            or (f"{rounds} rounds are over" if number == rounds else None)
            or ("what may be spent on readings is spent" if affordable is None else None)
        )
        yield Round(number, recordings[-1], asked, diagnosis, reason, settled is not None)
        if reason is not None or following is None or affordable is None:
            return
        budget = budget.less(affordable, over_s)
        asked, wanted = following.description, affordable


def _nothing_to_ask(following: NextMeasurement | None) -> str | None:
    return "no further reading would tell more" if following is None else None
