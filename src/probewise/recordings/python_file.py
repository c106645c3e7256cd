"""Running of a user's Python file, with errors in it reported in one line."""

from __future__ import annotations

import functools
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from probewise._kinds import checked_path
from probewise.errors import FileError, message_of
from probewise.recordings.text import read_text


def run_python_file(path: str | os.PathLike[str], what: str) -> Mapping[str, Any]:
    """Run a user's file as `import` would, and return the names that it defines.

    Its folder is added to the module search path, as by `python FILE.py`.

    Parameters
    ----------
    path
        The file.
    what
        What the file should be, for messages.

    Raises
    ------
    FileError
        If it cannot be read or run; the error names the line if there is one.
    """
    path = checked_path("path", path, what)
    return run_python_text(read_text(path, what), path)


def run_python_text(text: str, path: Path) -> Mapping[str, Any]:
    """Run the text of a user's file and return the names that it defines, as `run_python_file` does."""
    try:
        code = compile(text, str(path), "exec")
    except Exception as error:
        found = f"is no Python: {message_of(error, kind=False)}"
        if isinstance(error, MemoryError | RecursionError):  # of the parser
            found = f"has an expression that is too long or too deeply nested for Python ({type(error).__name__})"
        raise FileError(path, found, "a file that Python can run", row=getattr(error, "lineno", None)) from error
    module = ModuleType(f"probewise_file_{path.stem}")  # a prefix, so that serial.py cannot hide the package serial
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # dataclasses look their module up
    folder = str(path.absolute().parent)
    if folder not in sys.path:
        sys.path.insert(0, folder)
    try:
        with np.errstate(), warnings.catch_warnings():  # what the file sets is its own affair
            exec(code, module.__dict__)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
        found = f"stops with {message_of(error)}"
        raise FileError(path, found, "a file that Python can run", row=lines[-1] if lines else None) from error
    return module.__dict__


class EndedByFile(Exception):
    """What a function of a user's file raised that is no Exception, such as SystemExit; the text names it."""


def raising_exceptions(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of a user's file so that whatever it raises, but for Ctrl-C, is an Exception."""

    @functools.wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        try:
            return function(*args, **named)
        except (Exception, KeyboardInterrupt):
            raise
        except BaseException as error:
            raise EndedByFile(message_of(error)).with_traceback(error.__traceback__) from error

    return call
