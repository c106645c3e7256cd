"""Read and check FILE.py, the file in which a user describes a simulator."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from probewise._kinds import checked_path
from probewise.errors import FileError, ParameterError, message_of, printable, shown
from probewise.recordings.python_file import raising_exceptions, run_python_text
from probewise.recordings.text import read_text
from probewise.systems.simulator import Extra, Law, Noise, Simulator, parse_prior

_NAMES = (
    "reading",
    "unit",
    "time",
    "time_unit",
    "run",
    "parameters",
    "per_run",
    "controls",
    "noise",
    "simulate",
    "states",
    "rates",
    "observe",
    "hold",
    "max_step_s",
    "vectorized",
    "extra",
)


def read_simulator(path: str | os.PathLike[str]) -> Simulator:
    """Run a user's file and return the simulator that it describes.

    Raises
    ------
    FileError
        If it cannot be read or run, or is inconsistent; the message names the line, if there is one.
    """
    path = checked_path("path", path, "the name of a Python file that describes a simulator")
    return run_simulator_text(read_text(path, "a Python file that describes a simulator"), path)


def fingerprint_of_text(text: str) -> str:
    """Return the fingerprint of the text of a user's file."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def run_simulator_text(text: str, path: Path) -> Simulator:
    """Run the text of a user's file, as `read_simulator` does."""
    said = run_python_text(text, path)
    try:
        return _build_simulator(said, path, text)
    except ParameterError as error:
        found = f"{error.name} is {shown(error.value)}" if error.value is not None else f"{error.name} is missing"
        like = get_close_matches(error.name, said.keys() - set(_NAMES), 1) if error.value is None else []
        hint = f"; was {like[0]} meant to be {error.name}?" if like else ""
        raise FileError(path, found, error.allowed + hint) from error
    except Exception as error:  # objects of the file may raise anything
        raise FileError(
            path,
            f"what it says does not fit together ({message_of(error)})",
            f"these names: {', '.join(_NAMES)}",
        ) from error


def _build_simulator(said: Mapping[str, Any], path: Path, text: str) -> Simulator:
    given = said.get("parameters")
    if not isinstance(given, Mapping):
        raise ParameterError("parameters", given, 'a dict from names to priors: {"gain": (0, 10)}')
    law = None
    if "rates" in said or "states" in said:
        states = said.get("states")
        if not isinstance(states, Mapping):
            raise ParameterError("states", states, 'a dict from states to where they start: {"temp_c": 20.0}')
        law = Law(
            states,
            _checked_function(said, "rates"),
            _checked_function(said, "observe") if "observe" in said else None,
            said.get("hold", "previous"),
            said.get("max_step_s"),
        )
    return Simulator(
        reading=_checked_text(said, "reading"),
        unit=_checked_text(said, "unit"),
        parameters={name: parse_prior(f"parameters[{name!r}]", prior) for name, prior in given.items()},
        simulate=_checked_function(said, "simulate") if "simulate" in said else None,
        law=law,
        time=_checked_text(said, "time") if said.get("time") is not None else None,
        time_unit=_checked_text(said, "time_unit") if "time_unit" in said else "s",
        run=_checked_text(said, "run") if said.get("run") is not None else None,
        per_run=_checked_texts(said, "per_run"),
        controls=_checked_texts(said, "controls"),
        noise=Noise.of(said.get("noise", {})),
        extra={name: _parse_extra(name, each) for name, each in _checked_mapping(said, "extra").items()},
        vectorized=bool(said.get("vectorized", False)),
        source=printable(path.name),
        fingerprint=fingerprint_of_text(text),
    )


def _checked_text(said: Mapping[str, Any], name: str) -> str:
    value = said.get(name)
    if not isinstance(value, str) or not value:
        raise ParameterError(name, value, f'a text: {name} = "..."')
    return value


def _checked_texts(said: Mapping[str, Any], name: str) -> tuple[str, ...]:
    value = said.get(name, ())
    if isinstance(value, str) or not all(isinstance(each, str) for each in value):
        raise ParameterError(name, value, f'a list of names: {name} = ["..."]')
    return tuple(value)


def _checked_mapping(said: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    value = said.get(name, {})
    if not isinstance(value, Mapping):
        raise ParameterError(name, value, "a dict")
    return value


def _checked_function(said: Mapping[str, Any], name: str) -> Any:
    value = said.get(name)
    if not callable(value):
        raise ParameterError(name, value, f"a function: def {name}(...)")
    return raising_exceptions(value)


def _parse_extra(name: str, given: object) -> Extra:
    if not isinstance(given, Mapping) or given.keys() != {"prior", "null", "says"}:
        raise ParameterError(f"extra[{name!r}]", given, 'a dict with "prior", "null" and "says"')
    return Extra(parse_prior(f"extra[{name!r}]['prior']", given["prior"]), float(given["null"]), str(given["says"]))
