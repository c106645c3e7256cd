"""Types that arm and brick share: a clock, and the direction from which a motor arrives at a count."""

from __future__ import annotations

from typing import Literal, Protocol, TypeAlias

Side: TypeAlias = Literal[-1, 1]
"""Direction of arrival: -1 with the count decreasing, 1 increasing."""


class Clock(Protocol):
    """A clock that can wait; Python's module `time` is one."""

    def monotonic(self) -> float:
        """Return seconds since an arbitrary time."""
        ...

    def sleep(self, seconds: float, /) -> None:
        """Wait for some seconds."""
        ...
