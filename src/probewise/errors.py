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
]

_LONGEST = 160  # characters of a value in a message


class ProbewiseError(Exception):
    """Stand above every error that this package raises on purpose."""


class ParameterError(ProbewiseError, ValueError):
    """Report a value outside what is allowed."""

    def __init__(self, name: str, value: object, allowed: str) -> None:
        self.name, self.value, self.allowed = name, value, allowed
        super().__init__(f"{name} is {_in_one_line(value)}; allowed: {allowed}")

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
            where += f", column {column}"
        super().__init__(f"{where}: {found}; allowed: {allowed}")

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


class NotSavedWarning(UserWarning):
    """Warn of a computation that goes on but could not be saved on the way."""


class LowBatteryWarning(UserWarning):
    """Warn of a battery that will not drive the instrument much longer, or not as it should."""


def _in_one_line(value: object) -> str:
    """Show a value in one line of bearable length: a table or a long array would hide what is wrong with it."""
    shown = " ".join(repr(value).split())
    return shown if len(shown) <= _LONGEST else f"{shown[: _LONGEST - 3]}... ({type(value).__name__})"
