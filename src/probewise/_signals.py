"""Signals that end a program: one way for Ctrl-C, `kill` and a closed terminal to interrupt a command.

The first signal raises `Stopped` in the main thread, so that `with` blocks release the motors and remove incomplete
files. More signals within a second count as the same request; a later one raises again, which cuts clean-up short.
Libraries may swallow or convert an exception: `raise_if_stopped` raises it again, and any exception that ends a command
after a signal counts as the interruption.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Final

from probewise.errors import FileError, LinkError

# Ctrl-C, `kill`, a closed terminal, Ctrl-\; Windows has neither of the last two, but Ctrl-Break and a closed window.
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGBREAK")
ENDING: Final = tuple(signal.Signals[name] for name in _NAMES if hasattr(signal, name))
SAME_S: Final = 1.0
"""Signals within this many seconds count as one request: a closed terminal sends several."""

_asked: list[tuple[int, float]] = []  # number and time of each request to stop the command that runs
_deferring = False  # whether the main thread is in a block of `defer_signals`


class Stopped(KeyboardInterrupt):
    """The interruption of a command by signal `number`; the text says what is kept on disk."""

    def __init__(self, number: int = signal.SIGINT, kept: str = "") -> None:
        self.number = number
        super().__init__(kept)

    @property
    def status(self) -> int:
        """Exit status that shells expect after a signal: 128 + `number`."""
        return 128 + self.number


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """Let signals interrupt the block, unless they are ignored, as under `nohup`; any exception then is `Stopped`."""
    _asked.clear()
    before = sys.unraisablehook
    with _signals_handled_by(_stop):
        try:
            sys.unraisablehook = _raise_again
            yield
        except BaseException as error:
            if (stopped := _stopped_behind(error)) is None or stopped is error:
                raise
            raise stopped from error
        finally:
            sys.unraisablehook = before
            _asked.clear()  # answered: what the process does next is not interrupted by it


def raise_if_stopped() -> None:
    """Raise `Stopped` again if a signal's exception was swallowed."""
    if _asked:
        raise Stopped(_asked[0][0])


@contextlib.contextmanager
def reporting_what_is_kept(kept: Callable[[], str], *, results: bool = False) -> Iterator[None]:
    """Add what is kept on disk, in words, to the final message, if a signal or a lost connection ends the block.

    With `results` the run is over and writes its results: errors of files get the message too.
    """
    try:
        yield
    except BaseException as error:
        stopped = _stopped_behind(error)
        if stopped is None and not isinstance(error, (LinkError, FileError) if results else LinkError):
            raise
        try:
            said = kept()
        except FileError as unreadable:
            said = f"what is kept is not known: {unreadable}"
        if stopped is not None:
            raise Stopped(stopped.number, said) from error
        if isinstance(error, FileError):
            raise FileError(error.path, error.found, f"{error.allowed}; {said}") from error
        raise LinkError(f"{error}; {said}") from error


@contextlib.contextmanager
def defer_signals() -> Iterator[None]:
    """Defer signals that end the program until the block ends; another one more than a second later acts at once.

    For blocks that must not be interrupted: stopping motors, putting files in place.
    """
    global _deferring
    if _deferring or threading.current_thread() is not threading.main_thread():  # an outer block has the first signal
        yield
        return
    first: list[tuple[int, float]] = []

    def remember_signal(number: int, frame: FrameType | None) -> None:
        first.append((number, time.monotonic()))
        if first[-1][1] - first[0][1] > SAME_S:
            first.clear()
            restore()
            signal.raise_signal(number)

    try:
        with _signals_handled_by(remember_signal) as restore:
            _deferring = True
            yield
    finally:
        _deferring = False
        if first:
            signal.raise_signal(first[0][0])


@contextlib.contextmanager
def _signals_handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[Callable[[], None]]:
    """Let a function handle the signals that end the program, unless they are ignored; yield one that ends this early.

    Outside the main thread, the only one that receives signals, it does nothing.
    """
    mine = ENDING if threading.current_thread() is threading.main_thread() else ()
    before = {number: signal.getsignal(number) for number in mine}
    before = {number: earlier for number, earlier in before.items() if earlier not in (None, signal.SIG_IGN)}

    def restore() -> None:
        for number, earlier in before.items():
            signal.signal(number, earlier)

    try:
        for number in before:
            signal.signal(number, handler)
        yield restore
    finally:
        restore()


def _stop(number: int, frame: FrameType | None) -> None:
    now_s = time.monotonic()
    if not _asked or now_s - _asked[-1][1] > SAME_S:
        _asked.append((number, now_s))
        raise Stopped(_asked[0][0])


def _raise_again(ignored: sys.UnraisableHookArgs) -> None:
    """Raise `Stopped` soon again where Python ignores exceptions, as in a callback of its garbage collection.

    Not at once: while the timer starts, the exception would be ignored again.
    """
    if not isinstance(ignored.exc_value, Stopped):
        sys.__unraisablehook__(ignored)
        return
    _asked.clear()
    threading.Timer(0.25, signal.raise_signal, (ignored.exc_value.number,)).start()


def _stopped_behind(error: BaseException) -> Stopped | None:
    """Return the `Stopped` that an exception stands for, if a signal or Ctrl-C came before; else None."""
    if isinstance(error, Stopped):
        return error
    if _asked:
        return Stopped(_asked[0][0])
    return Stopped() if isinstance(error, KeyboardInterrupt) else None
