"""The protocol by which a long computation reports its progress."""

from __future__ import annotations

from typing import Protocol

__all__ = ["Progress", "silent"]


class Progress(Protocol):
    """A function (stage, done, total, note) called as a computation proceeds, e.g. to show a bar or to print."""

    def __call__(self, stage: str, done: int = 0, total: int = 0, note: str = "") -> None:
        """Report the progress of a stage.

        Parameters
        ----------
        stage
            Name of the stage, in a few words; a new name begins a new stage.
        done, total
            Steps done, and their total number; 0 where it is unknown.
        note
            Current remark, such as the evidence so far.
        """


def silent(stage: str, done: int = 0, total: int = 0, note: str = "") -> None:
    """Ignore the report: the default `Progress`, which shows nothing."""
