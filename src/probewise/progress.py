"""The protocol by which a long computation reports its progress; silent by default."""

from __future__ import annotations

from typing import Protocol

__all__ = ["Progress", "silent"]


class Progress(Protocol):
    """A function called as a computation proceeds; the command line shows a bar, a notebook may print."""

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
    """Ignore the report: a `Progress` that shows nothing."""
