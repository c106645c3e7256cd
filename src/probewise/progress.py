"""How far a long computation is: told to whoever asked for it, and to nobody by default."""

from __future__ import annotations

from typing import Protocol

__all__ = ["Progress", "silent"]


class Progress(Protocol):
    """What is called as a computation goes on; the command line shows a bar, a notebook may print."""

    def __call__(self, stage: str, done: int = 0, total: int = 0, note: str = "") -> None:
        """Tell how far a stage is.

        Parameters
        ----------
        stage
            What is being done, in a few words; a new text begins a new stage.
        done, total
            Steps done, and how many there are; 0 where nobody can know.
        note
            What there is to say of it now.
        """


def silent(stage: str, done: int = 0, total: int = 0, note: str = "") -> None:
    """Tell nobody."""
