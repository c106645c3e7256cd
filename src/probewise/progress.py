"""The protocol by which a long computation reports its progress."""

from __future__ import annotations

from typing import Protocol

__all__ = ["Progress", "silent"]


class Progress(Protocol):
    """A function (stage, done, total, note) called as a computation proceeds, e.g. to show a bar or to print."""

    def __call__(self, stage: str, done: int = 0, total: int = 0, note: str = "") -> None:
        """Report `done` of `total` steps (0: unknown) of a stage, and a remark; a new name begins a new stage."""


def silent(stage: str, done: int = 0, total: int = 0, note: str = "") -> None:
    """Ignore the report: the default `Progress`, which shows nothing."""
