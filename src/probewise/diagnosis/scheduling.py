"""What could be measured next, whatever carries it out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from probewise._arrays import IntArray
from probewise.recordings.plan import Plan

__all__ = ["MOST_READINGS", "Command", "rows_of"]

MOST_READINGS = 102


class Command(Protocol):
    """Some rows that could be taken next: of which kind, in words, the rows, and how long they take."""

    @property
    def kind(self) -> str:
        """What is done."""
        ...

    @property
    def description(self) -> str:
        """The same in words."""
        ...

    @property
    def plan(self) -> Plan:
        """The rows."""
        ...

    @property
    def minutes(self) -> float:
        """How long they take, with the break before them."""
        ...


def rows_of(commands: Sequence[Command]) -> list[IntArray]:
    """Give the row numbers of each command, where all are set behind each other."""
    ends = np.cumsum([len(command.plan) for command in commands])
    return [np.arange(end - len(command.plan), end) for end, command in zip(ends.tolist(), commands, strict=True)]
