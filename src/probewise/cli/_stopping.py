"""Interrupt a command in one way for all signals: Ctrl-C, `kill`, a closed terminal.

The first signal raises `Stopped` in the main thread, so that `with` blocks release the motors and remove incomplete
files. More signals within a second count as the same request; a later one raises again, which cuts clean-up short.
Libraries may swallow or convert an exception: `raise_if_stopped` raises it again, and any exception that ends a command
after a signal counts as the interruption.
"""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Callable, Iterator
from types import FrameType

from probewise._signals import SAME_S, signals_handled_by
from probewise.errors import FileError, LinkError


class Stopped(KeyboardInterrupt):
    """The interruption of a command by signal `number`; the text says what is kept on disk."""

    def __init__(self, number: int = signal.SIGINT, kept: str = "") -> None:
        self.number = number
        super().__init__(kept)

    @property
    def status(self) -> int:
        """Exit status that shells expect after a signal: 128 + `number`."""
        return 128 + self.number


class _LastStopRequest:
    """State: number and time of the signal that asked the command to stop; None if there was none."""

    number: int | None = None
    at_s: float = 0.0


_request = _LastStopRequest()


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """Let signals interrupt the block, but for those that are ignored, as under `nohup`.

    Any exception after a signal becomes `Stopped`.
    """
    _request.number = None
    with signals_handled_by(_on_signal):
        try:
            yield
        except BaseException as error:
            if (stopped := _stopped_behind(error)) is None or stopped is error:
                raise
            raise stopped from error
        finally:
            _request.number = None  # answered: what the process does next is not interrupted by it


def raise_if_stopped() -> None:
    """Raise `Stopped` again if a signal's exception was swallowed."""
    if _request.number is not None:
        raise Stopped(_request.number)


@contextlib.contextmanager
def reporting_what_is_kept(kept: Callable[[], str], *, results: bool = False) -> Iterator[None]:
    """Add what is kept on disk, in words, to the final message, if a signal or a lost connection ends the block.

    With `results` the run is over and writes its results: errors of files get the message too.
    """
    try:
        yield
    except BaseException as error:
        if (asked := _stopped_behind(error)) is not None:
            raise Stopped(asked.number, _text_of_what_is_kept(kept)) from error
        if isinstance(error, LinkError):
            raise LinkError(f"{error}; {_text_of_what_is_kept(kept)}") from error
        if results and isinstance(error, FileError):
            raise FileError(error.path, error.found, f"{error.allowed}; {_text_of_what_is_kept(kept)}") from error
        raise


def _on_signal(number: int, frame: FrameType | None) -> None:
    """Raise `Stopped`, unless this signal came within a second of the last that raised it."""
    now_s = time.monotonic()
    if _request.number is not None and now_s - _request.at_s <= SAME_S:
        return
    _request.number, _request.at_s = _request.number or number, now_s
    raise Stopped(_request.number)


def _stopped_behind(error: BaseException) -> Stopped | None:
    """Return the `Stopped` that an exception stands for, if a signal or Ctrl-C came before; else None."""
    if isinstance(error, Stopped):
        return error
    if _request.number is not None:
        return Stopped(_request.number)
    return Stopped() if isinstance(error, KeyboardInterrupt) else None


def _text_of_what_is_kept(kept: Callable[[], str]) -> str:
    try:
        return kept()
    except FileError as error:
        return f"what is kept is not known: {error}"
