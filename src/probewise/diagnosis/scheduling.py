"""Possible next measurements, as any apparatus lists them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from probewise._arrays import IntArray
from probewise.recordings.plan import Plan

MOST_READINGS = 102
SETTLED = 0.95
"""Probability from which a hypothesis, or the fewest that hold it, leave no question open."""
ENOUGH_NATS = 3.0
"""Expected log Bayes factor that tells two hypotheses apart, as odds of 20 to 1; readings for less are not advised."""
NOTHING_NATS = 0.5
"""Expected log Bayes factor below which readings do not tell two hypotheses apart at all: they are aliases."""


class Command(Protocol):
    """A possible next measurement, to be proposed to the user: kind, description, rows and duration."""

    @property
    def kind(self) -> str:
        """Kind of measurement, in a word or two."""
        ...

    @property
    def description(self) -> str:
        """The measurement in words, as an instruction."""
        ...

    @property
    def plan(self) -> Plan:
        """Rows of the measurement."""
        ...

    @property
    def minutes(self) -> float:
        """Duration in minutes, including the break before it."""
        ...


def rows_by_command(commands: Sequence[Command]) -> list[IntArray]:
    """Return the row numbers of each command in the plan that concatenates all commands, (n_rows,) each."""
    ends = np.cumsum([len(command.plan) for command in commands])
    return [np.arange(end - len(command.plan), end) for end, command in zip(ends.tolist(), commands, strict=True)]
