"""What time it is: the wall's, or one that only moves when it is waited for."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from probewise.errors import ParameterError

__all__ = ["Clock", "VirtualClock"]

Clock: TypeAlias = Callable[[], float]
"""Seconds since any fixed moment; `time.monotonic` is one."""


class VirtualClock:
    """Stand still but for `sleep`, which takes no time: minutes of an arm's work pass in seconds.

    It stands in for the module `time` where that is asked for `monotonic` and `sleep`.
    """

    def __init__(self) -> None:
        self._now_s = 0.0

    def __call__(self) -> float:
        """Return the time in seconds."""
        return self._now_s

    monotonic = __call__

    def sleep(self, seconds: float) -> None:
        """Let time pass.

        Raises
        ------
        ParameterError
            If it were to go back.
        """
        if seconds < 0:
            raise ParameterError("seconds", seconds, "0 or more")
        self._now_s += seconds
