"""Signals that end a program, and a way to defer such a signal while a critical block runs."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import Final

# Ctrl-C, `kill`, a closed terminal, Ctrl-\; Windows has neither of the last two, but Ctrl-Break and a closed window.
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGBREAK")
ENDING: Final = tuple(signal.Signals[name] for name in _NAMES if hasattr(signal, name))
SAME_S: Final = 1.0
"""Signals within this many seconds count as one request: a closed terminal sends several."""


@contextlib.contextmanager
def defer_signals() -> Iterator[None]:
    """Defer signals that end the program until the block ends; another signal more than a second later acts at once.

    For blocks that must not be interrupted: stopping motors, putting files in place. Outside the main thread, the only
    one that receives signals, it does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {number: signal.getsignal(number) for number in ENDING}
    handlers = {number: handler for number, handler in handlers.items() if handler not in (None, signal.SIG_IGN)}
    first: tuple[int, float] | None = None

    def remember_signal(number: int, frame: FrameType | None) -> None:
        nonlocal first
        now_s = time.monotonic()
        if first is None:
            first = number, now_s
        elif now_s - first[1] > SAME_S:
            restore()
            signal.raise_signal(number)

    def restore() -> None:
        nonlocal first
        first = None
        for number, handler in handlers.items():
            signal.signal(number, handler)

    try:
        for number in handlers:
            signal.signal(number, remember_signal)
        yield
    finally:
        heard = first
        restore()
        if heard is not None:
            signal.raise_signal(heard[0])
