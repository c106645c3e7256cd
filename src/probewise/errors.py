"""What can go wrong, each error also the builtin a caller would expect."""

from __future__ import annotations

from functools import partial

__all__ = [
    "DoubtfulResultWarning",
    "FileError",
    "LinkError",
    "LowBatteryWarning",
    "NotConvergedError",
    "NotSavedWarning",
    "ParameterError",
    "ProbewiseError",
    "ReachError",
    "ShapeError",
    "SlowWarning",
    "shortened",
    "shown",
]

_LONGEST_VALUE = 100  # characters of a bad value that a message repeats
_LONGEST_PART = 400  # characters of each part of a message


def shortened(text: str, most: int = _LONGEST_PART) -> str:
    """Cut a text after `most` characters, say how long it was, and escape what a terminal would obey."""
    begun = text[:most]
    if not begun.isprintable():
        begun = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in begun)
    return begun if len(text) <= most else f"{begun}... ({len(text)} characters)"


def shown(value: object, most: int = _LONGEST_VALUE) -> str:
    """Write a value in one line as Python would, cut after `most` characters."""
    try:
        text = " ".join(repr(value).split())
    except (ValueError, RecursionError):  # a whole number of thousands of digits, or a list nested as deep
        return f"a huge {type(value).__name__}"
    return shortened(text, most)


class ProbewiseError(Exception):
    """Stand above every error that this package raises on purpose."""


class ParameterError(ProbewiseError, ValueError):
    """Report a value outside what is allowed."""

    def __init__(self, name: str, value: object, allowed: str) -> None:
        self.name, self.value, self.allowed = name, value, allowed
        super().__init__(f"{shortened(name)} is {shown(value)}; allowed: {shortened(allowed)}")

    def __reduce__(self) -> tuple[object, ...]:
        # Exceptions are pickled as type(*args), which would hand the message back as the name.
        return type(self), (self.name, self.value, self.allowed)


class ShapeError(ProbewiseError, ValueError):
    """Report arrays whose shapes do not fit together."""


class FileError(ProbewiseError, ValueError):
    """Report a file that cannot be used: which file, where in it, what stood there, what is allowed."""

    def __init__(
        self, path: object, found: str, allowed: str, *, row: int | None = None, column: str | None = None
    ) -> None:
        self.path, self.found, self.allowed, self.row, self.column = str(path), found, allowed, row, column
        where = str(path)
        if row is not None:
            where += f", row {row}"
        if column is not None:
            where += f", column {shortened(column, _LONGEST_VALUE)}"
        super().__init__(f"{where}: {shortened(found)}; allowed: {shortened(allowed)}")

    def __reduce__(self) -> tuple[object, ...]:
        # As for ParameterError; `partial` carries what is keyword-only.
        return partial(type(self), row=self.row, column=self.column), (self.path, self.found, self.allowed)


class ReachError(ParameterError):
    """Report a pose that the arm cannot take."""


class LinkError(ProbewiseError, OSError):
    """Report an instrument that does not answer."""


class NotConvergedError(ProbewiseError, RuntimeError):
    """Report a computation that stopped short; `partial` holds what there is."""

    def __init__(self, message: str, partial: object = None) -> None:
        self.partial = partial
        super().__init__(message)


class DoubtfulResultWarning(UserWarning):
    """Warn of a result that can be used but not trusted blindly; the result holds the reason too."""


class SlowWarning(UserWarning):
    """Warn of a computation that takes a slow way where a quick one could be given."""


class NotSavedWarning(UserWarning):
    """Warn of a computation that goes on but could not be saved on the way."""


class LowBatteryWarning(UserWarning):
    """Warn of a battery that will not drive the instrument much longer, or not as it should."""
