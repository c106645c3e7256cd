"""Progress on standard error: a bar in a terminal or notebook, otherwise an occasional line of what has changed."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Never

from tqdm import tqdm

from probewise._kinds import require_progress
from probewise.errors import printable
from probewise.nested import RoundSummary
from probewise.progress import Progress, silent

_PATIENCE_S = 2.0  # shorter work shows no bar
_BETWEEN_LINES_S = 5.0
_SHARE_OF_ALL = 0.05  # of the elapsed time, the least wait between lines, so that long work does not flood a log
_BEAT_S = 0.5
_WITH_TOTAL = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt} of {total_fmt} [{elapsed}, {remaining} left]{postfix}"
_WITHOUT = "{desc} [{elapsed}]{postfix}"


@contextlib.contextmanager
def progress_shown(*, quiet: bool, beat: bool = True, lines: bool = True) -> Iterator[Progress]:
    """Yield a progress function (a `Progress`), silent if `quiet`; its display appears after two seconds of work.

    `beat` updates the elapsed time between reports; False while the program prompts at the same terminal. Without
    `lines` nothing is written where standard error is neither a terminal nor a notebook.
    """
    stream = sys.stderr  # None in a program without a console, such as IDLE or pythonw
    looked_at = "ipykernel" in sys.modules or (stream is not None and stream.isatty())
    if quiet or stream is None or not (looked_at or lines):
        yield silent
        return
    shown = _StageBars() if looked_at else _TextProgress()
    stopped = threading.Event()

    def refresh_until_stopped() -> None:
        while not stopped.wait(_BEAT_S):
            shown.refresh()

    heart = threading.Thread(target=refresh_until_stopped, daemon=True)
    if beat:
        heart.start()
    ended = False
    try:
        yield shown
        ended = True
    finally:
        stopped.set()
        if beat:
            heart.join()
        shown.close(ended=ended)


@contextlib.contextmanager
def progress_or_bar(progress: bool | Progress) -> Iterator[Progress]:
    """Yield the caller's progress function, that of a bar in a terminal or notebook (True), or a silent one (False)."""
    if isinstance(progress, bool):
        with progress_shown(quiet=not progress, lines=False) as shown:
            yield shown
    else:
        require_progress(progress, "True, False, or a function")
        yield progress


def sampler_progress(progress: Progress) -> Callable[[int | str, RoundSummary], None]:
    """Return a function (name of the run or number of Gaussians, summary) that reports the state of nested sampling."""

    def tell(what: int | str, state: RoundSummary) -> None:
        stage = what if isinstance(what, str) else f"{what} Gaussian{'s' if what > 1 else ''}"
        progress(stage, note=state.in_words)

    return tell


class _StageBars:
    """A progress function that shows one bar per stage; bars of stages longer than two seconds stay visible."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._shows_at = time.monotonic() + _PATIENCE_S
        self._stage, self._done, self._total, self._note = "", 0, 0, ""
        self._began = 0.0
        self._bar: tqdm[Never] | None = None

    def __call__(self, stage: str, done: int = 0, total: int = 0, note: str = "") -> None:
        stage = printable(stage)
        with self._lock:
            if (stage, total) != (self._stage, self._total):
                self._close_bar(ended=True)
                self._began = time.time()
            self._stage, self._done, self._total, self._note = stage, done, total, printable(note)
            self._update_bar()

    def refresh(self) -> None:
        """Update the elapsed time."""
        with self._lock:
            self._update_bar()
            if self._bar is not None:
                self._bar.refresh()

    def close(self, *, ended: bool) -> None:
        """End the last bar."""
        with self._lock:
            self._close_bar(ended=ended)

    def _update_bar(self) -> None:
        if not self._stage or time.monotonic() < self._shows_at:
            return
        if self._bar is None:
            total = self._total or None
            self._bar = tqdm(desc=self._stage, total=total, bar_format=_WITH_TOTAL if total else _WITHOUT)
            self._bar.start_t = self._began
        self._bar.set_postfix_str(self._note, refresh=False)
        self._bar.update(self._done - self._bar.n)

    def _close_bar(self, *, ended: bool) -> None:
        if self._bar is not None:
            if ended and self._bar.total:  # a stage may end before its last step
                self._bar.n = self._bar.total
            self._bar.leave = time.time() - self._began > _PATIENCE_S
            self._bar.close()
        self._bar, self._stage = None, ""


class _TextProgress:
    """A progress function that writes a changed report as a line: after two seconds, five more, later 5 % of the time.

    A report that has not changed since the last line is not written again.
    """

    def __init__(self) -> None:
        self._began = self._last = time.monotonic()
        self._said = ""
        self._now = "getting ready"

    def __call__(self, stage: str, done: int = 0, total: int = 0, note: str = "") -> None:
        self._now = printable(f"{stage}{f', {done} of {total}' if total else ''}{f', {note}' if note else ''}")
        self.refresh()

    def refresh(self) -> None:
        """Write the last report as a line if it says something new and the wait since the line before is over."""
        now = time.monotonic()
        wait = max(_BETWEEN_LINES_S, _SHARE_OF_ALL * (now - self._began)) if self._said else _PATIENCE_S
        if now - self._last < wait or self._now == self._said:
            return
        self._last, self._said = now, self._now
        sys.stderr.write(f"{self._now} ({now - self._began:.0f} s)\n")
        sys.stderr.flush()

    def close(self, *, ended: bool) -> None:
        """Do nothing: lines need no end."""
