"""Signals that end a program, and a way to defer such a signal while a critical block runs."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Final

# Ctrl-C, `kill`, a closed terminal, Ctrl-\; Windows has neither of the last two, but Ctrl-Break and a closed window.
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGBREAK")
ENDING: Final = tuple(signal.Signals[name] for name in _NAMES if hasattr(signal, name))
SAME_S: Final = 1.0
"""Signals within this many seconds count as one request: a closed terminal sends several."""


@contextlib.contextmanager
def signals_handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[Callable[[], None]]:
    """Let a function handle the signals that end the program, unless they are ignored; yield one that ends this early.

    Outside the main thread, the only one that receives signals, it does nothing.
    """
    mine = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in ENDING} if mine else {}
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


@contextlib.contextmanager
def defer_signals() -> Iterator[None]:
    """Defer signals that end the program until the block ends; another signal more than a second later acts at once.

    For blocks that must not be interrupted: stopping motors, putting files in place.
    """
    first: list[tuple[int, float]] = []

    def remember_signal(number: int, frame: FrameType | None) -> None:
        first.append((number, time.monotonic()))
        if first[-1][1] - first[0][1] > SAME_S:
            first.clear()
            restore()
            signal.raise_signal(number)

    try:
        with signals_handled_by(remember_signal) as restore:
            yield
    finally:
        if first:
            signal.raise_signal(first[0][0])
