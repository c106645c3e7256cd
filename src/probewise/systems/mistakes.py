"""Errors of a user's functions as a FileError on one line: which function, where, and what is allowed."""

from __future__ import annotations

import inspect
import traceback
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probewise.errors import FileError, message_of
from probewise.recordings.python_file import EndedByFile
from probewise.systems.simulator import Simulator

_WAY_OUT_BY_WORDS = {  # of Python's and NumPy's messages
    "output operand": "k = k * x in place of k *= x: an array changed in place keeps its shape",
    "converted to Python scalar": "np.sin(x) in place of math.sin(x), and so on: states and columns are arrays",
    "truth value of an array": "np.where(condition, a, b) in place of if: states and columns are arrays",
}


def user_function_error(
    what: str, error: Exception, simulator: Simulator, columns: Mapping[str, NDArray[Any]]
) -> FileError:
    """Return a FileError for an exception that `simulate`, `rates` or `observe` raises at every call.

    Parameters
    ----------
    what
        Name of the function.
    error
        The exception.
    simulator, columns
        The simulator, and the columns passed to the function.
    """
    where = _files_of_user_functions(simulator)
    if simulator.law is not None and simulator.law.observe is not None:
        raised_in = {frame.f_code for frame, _ in traceback.walk_tb(error.__traceback__)}
        what = "observe" if getattr(inspect.unwrap(simulator.law.observe), "__code__", None) in raised_in else what
    frames = traceback.extract_tb(error.__traceback__)
    lines = [f.lineno for f in frames if f.filename in where]
    said = message_of(error, kind=False)
    found = f"{what} raises {said if isinstance(error, EndedByFile) else message_of(error)}"
    law, outside = simulator.law, not frames or frames[-1].filename not in where
    if law is not None and outside:
        by_name = f"a dict with a rate for each state, under its name: {', '.join(law.states)}"
        if isinstance(error, KeyError) and error.args and error.args[0] in law.states:
            return FileError(simulator.source or what, f"rates returns no {error.args[0]!r}", by_name)
        if isinstance(error, TypeError) and ("list indices" in said or "tuple indices" in said):
            return FileError(simulator.source or what, "rates returns a list or a tuple", by_name)
    is_of_values = isinstance(error, TypeError | ValueError)
    way_out = next((out for words, out in _WAY_OUT_BY_WORDS.items() if words in said), "")
    texts = [name for name, values in columns.items() if values.dtype != np.float64]
    if isinstance(error, KeyError):
        names = ", ".join(columns)
        states = f", states {', '.join(simulator.law.states)}" if simulator.law is not None else ""
        allowed = (
            f"columns {names or 'none'}, parameters {', '.join((*simulator.parameters, *simulator.extra))}{states}"
        )
    elif is_of_values and way_out:
        allowed = way_out
    elif is_of_values and texts:
        shown = ", ".join(f"{name} ({_first_non_numeric_cell(columns[name])!r})" for name in texts[:4])
        allowed = f"calculations with numeric columns; these contain text: {shown}"
    elif law is not None and what == "rates":
        allowed = f"a function that returns a rate for each state somewhere in the prior: {', '.join(law.states)}"
    else:
        allowed = f"a function that returns a reading for each of the {_n_rows(columns)} rows somewhere in the prior"
    return FileError(simulator.source or what, found, allowed, row=lines[-1] if lines else None)


def _files_of_user_functions(simulator: Simulator) -> set[str]:
    functions: list[Any] = [simulator.simulate]
    if simulator.law is not None:
        functions += [simulator.law.rates, simulator.law.observe]
    codes = (getattr(inspect.unwrap(function), "__code__", None) for function in functions if function is not None)
    return {code.co_filename for code in codes if code is not None}


def _first_non_numeric_cell(values: NDArray[Any]) -> str:
    """Return the first cell that is not a number; the first cell if all are numbers, "" if there is none."""
    for cell in values.tolist():
        try:
            float(cell)
        except ValueError:
            return str(cell)
    return str(values[0]) if len(values) else ""


def _n_rows(columns: Mapping[str, NDArray[Any]]) -> int:
    return max((np.shape(values)[-1] for values in columns.values()), default=0)
