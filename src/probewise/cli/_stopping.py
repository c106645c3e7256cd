"""One way to stop a command, whichever signal asks for it: Ctrl-C, `kill`, a closed terminal.

The first signal raises `Stopped` where the program stands, so that `with` blocks release the motors and
remove what is half written. More signals within a second are the same request; a later one raises again,
which cuts a clean-up short. Libraries may swallow an exception that arises inside them, or turn it into
another: `require_going_on` raises again, and whatever ends a command after a signal counts as the stop.
"""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType

from probewise._signals import ENDING, SAME_S
from probewise.errors import FileError, LinkError

__all__ = ["Stopped", "require_going_on", "saying_what_is_kept", "stoppable"]


class Stopped(KeyboardInterrupt):
    """Report that a signal, its `number`, has asked the program to end; the text says what is kept."""

    def __init__(self, number: int = signal.SIGINT, kept: str = "") -> None:
        self.number = number
        super().__init__(kept)

    @property
    def status(self) -> int:
        """The exit status that shells expect of a program that a signal has ended."""
        return 128 + self.number


class _Request:
    """Whether the program has been asked to stop: by which signal, and when last."""

    number: int | None = None
    at_s: float = 0.0


_request = _Request()


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """Let signals stop the block; whatever it raises after one leaves it as `Stopped`.

    A signal that is ignored, as under `nohup`, stays ignored.
    """
    _request.number = None
    mine = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in ENDING} if mine else {}
    before = {number: handler for number, handler in before.items() if handler not in (None, signal.SIG_IGN)}
    try:
        for number in before:
            signal.signal(number, _ask)
        yield
    except Stopped:
        raise
    except BaseException as error:
        if (asked := _asked(error)) is None:
            raise
        raise asked from error
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def require_going_on() -> None:
    """Raise `Stopped` where a signal has come whose exception somebody swallowed."""
    if _request.number is not None:
        raise Stopped(_request.number)


@contextlib.contextmanager
def saying_what_is_kept(kept: Callable[[], str], *, results: bool = False) -> Iterator[None]:
    """Add to the last words of a run that a signal or a dead line ends what of it is on the disk.

    Parameters
    ----------
    kept
        Says it.
    results
        The run is over and writes its results: add it to what is wrong with a file too.
    """
    try:
        yield
    except BaseException as error:
        if (asked := _asked(error)) is not None:
            raise Stopped(asked.number, _told(kept)) from error
        if isinstance(error, LinkError):
            raise LinkError(f"{error}; {_told(kept)}") from error
        if results and isinstance(error, FileError):
            raise FileError(error.path, error.found, f"{error.allowed}; {_told(kept)}") from error
        raise


def _ask(number: int, frame: FrameType | None) -> None:
    """Raise `Stopped` unless this signal is part of the last request."""
    now_s = time.monotonic()
    if _request.number is not None and now_s - _request.at_s <= SAME_S:
        return
    _request.number, _request.at_s = _request.number or number, now_s
    raise Stopped(_request.number)


def _asked(error: BaseException) -> Stopped | None:
    """Read the request to stop that an exception is the outcome of; None where it has another cause."""
    if isinstance(error, Stopped):
        return error
    if _request.number is not None:
        return Stopped(_request.number)
    return Stopped() if isinstance(error, KeyboardInterrupt) else None


def _told(kept: Callable[[], str]) -> str:
    try:
        return kept()
    except FileError as error:
        return f"what is kept is not known: {error}"
