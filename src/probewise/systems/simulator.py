"""A user's simulator: parameters with priors, and a function or a law; and FILE.py, the file that describes it."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, TypeAlias, cast, get_args

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import FloatArray
from probewise._kinds import (
    checked_path,
    checked_text,
    checked_texts,
    require_callable,
    require_flag,
    require_kind,
    require_mapping,
    require_one_of,
    require_text,
)
from probewise.effects import EFFECTS, RARE_EFFECTS
from probewise.errors import FileError, ParameterError, message_of, printable, require, shown
from probewise.priors import Marginal, parse_prior
from probewise.recordings.io import FunctionOfFile, read_text, run_python_text
from probewise.sensor import Stage
from probewise.systems.table import RunTable, median_sd_of_column, read_run_table

_OF_SYSTEM = ("reading", "unit", "time", "time_unit", "run", "parameters", "per_run", "controls", "noise", "vectorized")
_OF_LAW = ("states", "hold", "max_step_s")
_NAMES = (*_OF_SYSTEM, "simulate", *_OF_LAW, "rates", "observe", "extra")  # in a file

Values: TypeAlias = Mapping[str, Any]
"""Parameters by name: floats, or arrays that broadcast against the rows."""

Columns: TypeAlias = Mapping[str, NDArray[Any]]
"""Columns of the table by name, (n_points,)."""

Simulate: TypeAlias = Callable[[Values, Columns], FloatArray]
"""Function of parameters and columns; returns noise-free readings.

(n_points,), or (n_samples, n_points) where parameters are (n_samples, 1).
"""

Rates: TypeAlias = Callable[[Values, Values, Values], Mapping[str, Any]]
"""Function of states, parameters and columns; returns the rate of each state; arrays broadcast."""

Observe: TypeAlias = Callable[[Values, Values, Values], Any]
"""Function of states, parameters and columns; returns the noise-free reading."""

Hold: TypeAlias = Literal["previous", "linear"]

_OF_NOISE = (name for name, kind in EFFECTS.items() if kind.stage is Stage.NOISE)
_TAKEN = (*_OF_NOISE, *RARE_EFFECTS, "unknown", "clean")  # names that no effect of a user may have


@dataclass(frozen=True)
class Noise:
    """Prior knowledge of the noise.

    `sd` is the expected sd of a reading, in its unit; or the name of a column of sds, of which only the ratios count;
    or None. The size of the noise is fitted in any case. `step` is the rounding step of the readings, None if not
    declared. `range` are the smallest and largest reading of the instrument, which reads an end where the signal and
    its noise are beyond it; None for an open end. `zero` is the reading at zero signal, about which a gain acts.
    """

    sd: float | str | None = None
    step: float | None = None
    range: tuple[float | None, float | None] = (None, None)
    zero: float = 0.0

    @classmethod
    def of(cls, given: object) -> Noise:
        """Build from a user's dict with some of "sd", "step", "range", "zero"; a Noise is returned as it is."""
        if isinstance(given, Noise):
            return given
        meant = f"; was {{'sd': {given}}} meant?" if isinstance(given, int | float) else ""
        is_dict = isinstance(given, Mapping) and not given.keys() - {"sd", "step", "range", "zero"}
        require(is_dict, "noise", given, f'a dict with some of "sd", "step", "range", "zero"{meant}')
        return cls(**cast(Mapping[str, Any], given))

    def __post_init__(self) -> None:
        is_sd = self.sd is None or isinstance(self.sd, str) or (_is_finite_number(self.sd) and self.sd > 0)
        require(is_sd, 'noise["sd"]', self.sd, "a number greater than 0, the name of a column, or None")
        is_step = self.step is None or (_is_finite_number(self.step) and self.step > 0)
        require(is_step, 'noise["step"]', self.step, "a number greater than 0, or None")
        require(_is_finite_number(self.zero), 'noise["zero"]', self.zero, "a finite number, the reading at zero signal")
        is_pair = isinstance(self.range, Sequence) and not isinstance(self.range, str) and len(self.range) == 2
        numbers = (int, float, np.integer, np.floating)
        are_numbers = is_pair and all(isinstance(e, numbers) and not isinstance(e, bool) for e in self.ends)
        rises = are_numbers and self.ends[0] < self.ends[1]
        require(rises, 'noise["range"]', self.range, "(low, high) with low < high; None for an open end")
        object.__setattr__(self, "range", tuple(self.range))

    @property
    def ends(self) -> tuple[float, float]:
        """Smallest and largest reading of the instrument, infinite for an open end."""
        low, high = self.range
        return -np.inf if low is None else low, np.inf if high is None else high


@dataclass(frozen=True)
class Law:
    """A dynamical system: initial states, rates of the states, and the observation.

    `states` are the initial value of each state in every run: the name of a parameter, or a number. `rates` returns the
    rate of each state by name, per unit of time; all are arrays that broadcast against each other: np.where and np.sin,
    no `if` and no math.sin. `observe` returns the reading, an array that broadcasts to the states' shape; None: the
    first state. `hold` says how columns go on between rows: "previous" (held) or "linear". `max_step_s` is the largest
    integration step, in the unit of time; None: chosen automatically.
    """

    states: Mapping[str, str | float]
    rates: Rates
    observe: Observe | None = None
    hold: Hold = "previous"
    max_step_s: float | None = None

    def __post_init__(self) -> None:
        require_mapping("states", self.states, "where each state starts, by name: {'temp_c': 'start_c'}")
        require_callable("rates", self.rates, "a function rates(states, parameters, columns)")
        if self.observe is not None:
            require_callable("observe", self.observe, "a function observe(states, parameters, columns), or None")
        require(self.states, "states", dict(self.states), "one state or more, each with where it starts")
        require_one_of("hold", self.hold, get_args(Hold))
        is_step = self.max_step_s is None or (_is_finite_number(self.max_step_s) and self.max_step_s > 0)
        require(is_step, "max_step_s", self.max_step_s, "greater than 0")


@dataclass(frozen=True)
class Extra:
    """A user's own effect: an extra parameter that `simulate` or `rates` finds among the parameters.

    `null` is its value when the effect is absent; `says` is a sentence that contains {value}.
    """

    prior: Marginal
    null: float
    says: str


@dataclass(frozen=True, eq=False)
class Simulator:
    """A simulator of readings and the priors of its parameters, with either `simulate` or `law`.

    It, and a diagnosis or fit with it, can be pickled if its functions can: those of FILE.py, which is then run again,
    or that `def` defines in a module, no lambdas, none within a function. Of any other `save` the result.

    Parameters
    ----------
    reading, unit
        Name of the predicted column, and its unit.
    parameters
        Prior of each parameter, as in FILE.py: (low, high), ("log", low, high), ("normal", mean, sd), or a prior.
    simulate, law
        Function that predicts the readings of the whole table; or a law, which is integrated between the rows of each
        run.
    time, time_unit, run
        Name of the time column, if any, and its unit; name of the column that assigns rows to runs, if any.
    per_run, controls
        Parameters with a separate value in every run; columns that the user can set.
    noise
        Prior knowledge of the noise; may be a dict with some of "sd", "step", "range", "zero".
    extra
        The user's own effects, by name: each an `Extra`, or as in FILE.py a dict with "prior", "null" and "says".
    vectorized
        Whether `simulate` takes parameters (n_samples, 1), those of `per_run` (n_samples, n_points), and returns
        (n_samples, n_points). False: trial calls find out.
    source, fingerprint
        The file that it was read from, and the fingerprint of its text.
    """

    reading: str
    unit: str
    parameters: Mapping[str, Any]
    simulate: Simulate | None = None
    law: Law | None = None
    time: str | None = None
    time_unit: str = "s"
    run: str | None = None
    per_run: tuple[str, ...] = ()
    controls: tuple[str, ...] = ()
    noise: Noise = field(default_factory=Noise)
    extra: Mapping[str, Any] = field(default_factory=dict)
    vectorized: bool = False
    source: str = ""
    fingerprint: str = ""

    def __post_init__(self) -> None:
        found, from_python = "neither" if self.simulate is None else "both", "simulate=..., or law=Law(states, rates)"
        in_a_file = "def simulate(p, data), or states and def rates(s, p, u)"
        allowed = f"one of them: {from_python}; in a file {in_a_file}"
        require((self.simulate is None) != (self.law is None), "simulate, rates", found, allowed)
        checked_text("reading", self.reading, 'the name of the column that is predicted: reading = "..."')
        require_text("unit", self.unit, 'a text: unit = "..."')
        require_flag("vectorized", self.vectorized)
        checked_text("time_unit", self.time_unit, 'a text, such as "min"')
        known = {self.reading: "the reading"}
        for name, column in (("time", self.time), ("run", self.run)):
            if column is not None:
                checked_text(name, column, f'the name of a column, {name} = "...", or None')
                allowed = f"another column than {known.setdefault(column, name)}"
                require(known[column] == name, name, column, allowed)
        if self.simulate is not None:
            way = "a function simulate(parameters, columns); of a file: read_simulator('FILE.py') of probewise.systems"
            require_callable("simulate", self.simulate, way)
        else:
            require_kind("law", self.law, Law, "a law of motion: Law(states, rates)")
        require_mapping("parameters", self.parameters, "the prior of each by name: {'tau_s': ('log', 1, 1000)}")
        require(self.parameters, "parameters", {}, "one parameter or more, each with its prior")
        names = ", ".join(self.parameters)
        priors = {name: parse_prior(f"parameters[{name!r}]", prior) for name, prior in self.parameters.items()}
        given: dict[str, Any] = {
            "parameters": priors,
            "per_run": checked_texts("per_run", self.per_run, "names of parameters"),
            "controls": checked_texts("controls", self.controls, "names of columns"),
            "noise": Noise.of(self.noise),
        }
        for name in given["per_run"]:
            require(name in self.parameters, "per_run", name, f"a parameter: {names}")
        allowed = 'nothing, or run = "..." with the column that names the runs'
        require(not given["per_run"] or self.run is not None, "per_run", list(given["per_run"]), allowed)
        if self.law is not None:
            require(self.time is not None, "time", None, "the column of time, which rates are integrated over")
            for state, start in self.law.states.items():
                is_start = start in self.parameters if isinstance(start, str) else _is_finite_number(start)
                require(is_start, f"states[{state!r}]", start, f"a number or a parameter: {names}")
        require_mapping("extra", self.extra, "effects by name: {'drag': {'prior': ..., 'null': 0, 'says': ...}}")
        own = given["extra"] = {}
        for name, effect in self.extra.items():
            if isinstance(effect, Mapping) and effect.keys() == {"prior", "null", "says"}:
                effect = Extra(effect["prior"], effect["null"], str(effect["says"]))
            require_kind(f"extra[{name!r}]", effect, Extra, 'a dict with "prior", "null" and "says"')
            is_null = _is_finite_number(effect.null)
            require(is_null, f"extra[{name!r}].null", effect.null, "a finite number, at which it is absent")
            prior = parse_prior(f"extra[{name!r}].prior", effect.prior)
            own[name] = replace(effect, prior=prior, null=float(effect.null))
            require(name not in self.parameters, "extra", name, "names that no parameter has")
            allowed = f"names that no effect of this program has: {', '.join(_TAKEN)}"
            require(name not in _TAKEN, "extra", name, allowed)
        for name, value in given.items():
            object.__setattr__(self, name, value)

    def declared_sd(self, table: RunTable) -> float | None:
        """Return the declared sd of a reading, or the median of a column of sds; None if there is none."""
        return median_sd_of_column(table, self.noise.sd) if isinstance(self.noise.sd, str) else self.noise.sd

    def inputs(self, columns: Columns) -> dict[str, NDArray[Any]]:
        """Return columns by name without the reading and its declared sd."""
        return {name: values for name, values in columns.items() if name not in (self.reading, self.noise.sd)}

    def interpolated_inputs(self, table: RunTable) -> dict[str, NDArray[Any]]:
        """Return the columns of numbers that have gaps, by name, each interpolated within runs."""
        inputs = self.inputs(table.covariates).items()
        return {n: table.interpolated_within_runs(v) for n, v in inputs if 0 < np.isfinite(v).sum() < len(v)}


def table_for(simulator: Simulator, data: RunTable | Mapping[str, Any]) -> RunTable:
    """Build a simulator's table from columns by name (a dict of arrays, a DataFrame); return a RunTable as it is."""
    allowed = "a Simulator(reading, unit, parameters, simulate=...), or read_simulator('FILE.py'), of probewise.systems"
    require_kind("simulator", simulator, Simulator, f"{allowed}; then comes the table")
    if isinstance(data, RunTable):
        return data
    return RunTable(data, simulator.time, simulator.run, time_unit=simulator.time_unit)


def read_table_for(simulator: Simulator, path: str | os.PathLike[str]) -> RunTable:
    """Read a simulator's table from a file, as `read_run_table` does."""
    own = simulator
    return read_run_table(path, time=own.time, run=own.run, reading=own.reading, time_unit=own.time_unit)


def _is_finite_number(value: object) -> bool:
    array = np.asarray(value)
    return array.ndim == 0 and array.dtype.kind in "biuf" and bool(np.isfinite(array))


def read_simulator(path: str | os.PathLike[str]) -> Simulator:
    """Run a user's file and return the simulator that it describes.

    Raises FileError if it cannot be read or run, or is inconsistent; the message names the line, if there is one.
    """
    path = checked_path("path", path, "the name of a Python file that describes a simulator")
    return run_simulator_text(read_text(path, "a Python file that describes a simulator"), path)


def fingerprint_of_text(text: str) -> str:
    """Return the fingerprint of the text of a user's file."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def run_simulator_text(text: str, path: Path) -> Simulator:
    """Run the text of a user's file, as `read_simulator` does."""
    said = run_python_text(text, path)
    named = ((name, said.get(name)) for name in ("simulate", "rates", "observe"))
    simulate, rates, observe = (
        cast(Any, FunctionOfFile(function, name, text, path) if callable(function) else function)
        for name, function in named
    )
    given: dict[str, Any] = dict.fromkeys(("reading", "unit", "parameters"))
    given |= {name: said[name] for name in _OF_SYSTEM if name in said}
    try:
        law = None
        if "rates" in said or "states" in said:
            of_law: dict[str, Any] = {"states": None} | {name: said[name] for name in _OF_LAW if name in said}
            law = Law(rates=rates, observe=observe, **of_law)
        given |= {"source": printable(path.name), "fingerprint": fingerprint_of_text(text)}
        return Simulator(simulate=simulate, law=law, extra=said.get("extra", {}), **given)
    except ParameterError as error:
        found = f"{error.name} is {shown(error.value)}" if error.value is not None else f"{error.name} is missing"
        like = get_close_matches(error.name, said.keys() - set(_NAMES), 1) if error.value is None else []
        hint = f"; was {like[0]} meant to be {error.name}?" if like else ""
        raise FileError(path, found, error.allowed + hint) from error
    except Exception as error:  # objects of the file may raise anything
        found = f"what it says does not fit together ({message_of(error)})"
        raise FileError(path, found, f"these names: {', '.join(_NAMES)}") from error
