"""What the arm and the brick below it both speak of: a clock, and the side that a move comes from."""

from __future__ import annotations

from typing import Literal, Protocol, TypeAlias

__all__ = ["Clock", "Side"]

Side: TypeAlias = Literal[-1, 1]
"""Arriving with the count going down, or up."""


class Clock(Protocol):
    """A clock that can be waited for; the module `time` is one."""

    def monotonic(self) -> float:
        """Seconds since some moment."""
        ...

    def sleep(self, seconds: float, /) -> None:
        """Wait."""
        ...
