"""The interface of possible next measurements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from probewise._arrays import IntArray
from probewise.recordings.plan import Plan

MOST_READINGS = 102


class Command(Protocol):
    """Rows that could be measured next: kind, description, plan and duration."""

    @property
    def kind(self) -> str:
        """Kind of measurement."""
        ...

    @property
    def description(self) -> str:
        """Description in words."""
        ...

    @property
    def plan(self) -> Plan:
        """The rows."""
        ...

    @property
    def minutes(self) -> float:
        """Duration in minutes, including the break before them."""
        ...


def rows_of(commands: Sequence[Command]) -> list[IntArray]:
    """Return the row numbers of each command after concatenation."""
    ends = np.cumsum([len(command.plan) for command in commands])
    return [np.arange(end - len(command.plan), end) for end, command in zip(ends.tolist(), commands, strict=True)]
