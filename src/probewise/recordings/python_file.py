"""Running of a user's Python file, with errors in it reported in one line."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from probewise._kinds import checked_path
from probewise.errors import FileError, shortened
from probewise.recordings.text import read_text

_LONGEST = 200


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
    except (SyntaxError, ValueError) as error:
        found = f"is no Python: {error_on_one_line(error)}"
        raise FileError(path, found, "a file that Python can run", row=getattr(error, "lineno", None)) from error
    module = ModuleType(f"probewise_file_{path.stem}")  # a prefix, so that serial.py cannot hide the package serial
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # dataclasses look their module up
    folder = str(path.absolute().parent)
    if folder not in sys.path:
        sys.path.insert(0, folder)
    try:
        exec(code, module.__dict__)
    except (Exception, SystemExit) as error:
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
        found = f"stops with {type(error).__name__}: {error_on_one_line(error)}"
        raise FileError(path, found, "a file that Python can run", row=lines[-1] if lines else None) from error
    return module.__dict__


def error_on_one_line(error: BaseException) -> str:
    """Return an error's message on one line, cut where it is long."""
    return shortened(" ".join(str(error).split()), _LONGEST)
