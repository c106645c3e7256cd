"""Errors and warnings of the package; each error also derives from the builtin error that a caller would expect."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable
from functools import partial

__all__ = [
    "DoubtfulResultWarning",
    "FileError",
    "LinkError",
    "LowBatteryWarning",
    "NotConvergedError",
    "NotSavedWarning",
    "ParameterError",
    "PipeWarning",
    "ProbewiseError",
    "ReachError",
    "ShapeError",
    "SlowWarning",
    "UnitWarning",
    "did_you_mean",
    "message_of",
    "shortened",
    "shown",
]

_LONGEST_VALUE = 100  # characters of a bad value that a message shows
_LONGEST_CAUSE = 200  # characters of another error's message
_LONGEST_PART = 400  # characters of each part of a message


def shortened(text: str, most: int = _LONGEST_PART) -> str:
    """Return a text cut after `most` characters, with its full length then, and with control characters escaped."""
    begun = printable(text[:most])
    return begun if len(text) <= most else f"{begun}... ({len(text)} characters)"


def printable(text: str, *, keep: str = "") -> str:
    """Return a text with control characters escaped, which could command a terminal, but for those of `keep`."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else c.encode("unicode_escape").decode() for c in text)


def shown(value: object, most: int = _LONGEST_VALUE) -> str:
    """Return the `repr` of a value on one line, cut after `most` characters; never fails for huge values."""
    try:
        text = " ".join(repr(value).split())
    except (ValueError, RecursionError):  # an integer of thousands of digits, or a list nested too deep
        return f"a huge {type(value).__name__}"
    except Exception:  # of a user's own __repr__
        return f"a {type(value).__name__}"
    return shortened(text, most)


def warn(message: str, category: type[Warning]) -> None:
    """Warn at the line of the caller's program that called this package."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and str(frame.f_globals.get("__name__")).partition(".")[0] == "probewise":
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


def message_of(error: BaseException, *, kind: bool = True) -> str:
    """Return an exception's kind, unless False, and its message on one line, cut where it is long; never fails."""
    try:
        text = shortened(" ".join(str(error).split()), _LONGEST_CAUSE)
    except BaseException as failure:  # of a user's own __str__
        if isinstance(failure, KeyboardInterrupt):
            raise
        text = f"its message raises {type(failure).__name__}"
    return f"{type(error).__name__}: {text}".removesuffix(": ") if kind else text


def did_you_mean(value: object, known: Iterable[str]) -> str:
    """Return "; did you mean NAME?" with the known name nearest to a misspelt one, or "" if none is near."""
    import difflib  # here, since no help needs it

    near = difflib.get_close_matches(value, list(known), n=1) if isinstance(value, str) else []
    return f"; did you mean {near[0]}?" if near else ""


class ProbewiseError(Exception):
    """Base class of the errors that this package raises on purpose."""


class ParameterError(ProbewiseError, ValueError):
    """Report an argument outside what is allowed; `name`, `value` and `allowed` are in the message."""

    def __init__(self, name: str, value: object, allowed: str) -> None:
        self.name, self.value, self.allowed = name, value, allowed
        super().__init__(f"{shortened(name)} is {shown(value)}; allowed: {shortened(allowed)}")

    def __reduce__(self) -> tuple[object, ...]:
        # Exceptions are pickled as type(*args), which would hand the message back as the name.
        return type(self), (self.name, self.value, self.allowed)


def require(holds: object, name: str, value: object, allowed: str) -> None:
    """Raise ParameterError, of an argument's name and value and what is allowed, unless a condition holds."""
    if not holds:
        raise ParameterError(name, value, allowed)


class ShapeError(ProbewiseError, ValueError):
    """Report arrays whose shapes do not fit together."""


class FileError(ProbewiseError, ValueError):
    """Report a file that cannot be used: `path`, place (`row`, `column`), what was `found`, what is `allowed`.

    `row` counts from 1; it is called the row of a table, and the line of any other file.
    """

    def __init__(
        self, path: object, found: str, allowed: str, *, row: int | None = None, column: str | None = None
    ) -> None:
        self.path, self.found, self.allowed, self.row, self.column = str(path), found, allowed, row, column
        where = printable(str(path))
        if row is not None:
            where += f", {'row' if where.lower().endswith('.csv') else 'line'} {row}"
        if column is not None:
            where += f", column {shortened(column, _LONGEST_VALUE)}"
        super().__init__(f"{where}: {shortened(found)}; allowed: {shortened(allowed)}")

    def __reduce__(self) -> tuple[object, ...]:
        # As for ParameterError; `partial` carries the keyword-only arguments.
        return partial(type(self), row=self.row, column=self.column), (self.path, self.found, self.allowed)


class ReachError(ParameterError):
    """Report a pose that the arm cannot take."""


class LinkError(ProbewiseError, OSError):
    """Report an instrument, such as a robot, that does not answer."""


class NotConvergedError(ProbewiseError, RuntimeError):
    """Report a computation that did not converge; `partial` holds the result so far."""

    def __init__(self, message: str, partial: object = None) -> None:
        self.partial = partial
        super().__init__(message)


class NotDrawnError(ProbewiseError):
    """Report figures or pages that could not be drawn, beside results that are complete."""


class DoubtfulResultWarning(UserWarning):
    """Warn of a usable but doubtful result; the result holds the reason too."""


class SlowWarning(UserWarning):
    """Warn of a slow fallback where the caller could provide a fast method."""


class NotSavedWarning(UserWarning):
    """Warn that intermediate results could not be saved; the computation goes on."""


class PipeWarning(UserWarning):
    """Warn that reading from a pipe waits until its writer ends."""


class UnitWarning(UserWarning):
    """Warn of a value that looks as if it were in another unit, such as degrees for radians."""


class LowBatteryWarning(UserWarning):
    """Warn of a battery too low to drive the instrument reliably or for much longer."""
