"""The type of a clock, and a virtual clock that advances only by `sleep`."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from probewise.errors import ParameterError

Clock: TypeAlias = Callable[[], float]
"""Seconds since any fixed moment; `time.monotonic` is one."""


class VirtualClock:
    """A clock that advances only by `sleep`, which returns at once: minutes of simulated work take seconds.

    It replaces Python's module `time` in code that uses only `monotonic` and `sleep`.
    """

    def __init__(self) -> None:
        self._now_s = 0.0

    def __call__(self) -> float:
        """Return the time in seconds."""
        return self._now_s

    monotonic = __call__

    def sleep(self, seconds: float) -> None:
        """Advance the clock.

        Raises
        ------
        ParameterError
            If `seconds` is negative.
        """
        if seconds < 0:
            raise ParameterError("seconds", seconds, "0 or more")
        self._now_s += seconds
