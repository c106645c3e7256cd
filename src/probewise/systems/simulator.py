"""What a person brings beside the table: parameters with priors, and a function or a law."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import FloatArray
from probewise._kinds import require_callable, require_kind, require_mapping, require_text, require_texts
from probewise.errors import ParameterError
from probewise.priors import LogUniform, Marginal, Normal, Uniform
from probewise.systems.table import RunTable

__all__ = [
    "Columns",
    "Extra",
    "Law",
    "Noise",
    "Observe",
    "Rates",
    "Simulate",
    "Simulator",
    "Values",
    "marginal_of",
    "table_for",
]

Values: TypeAlias = Mapping[str, Any]
"""Parameters by name: floats, or arrays that broadcast against the rows."""

Columns: TypeAlias = Mapping[str, NDArray[Any]]
"""Columns of the table by name, (n_points,)."""

Simulate: TypeAlias = Callable[[Values, Columns], FloatArray]
"""Parameters and columns to noise-free readings, (n_points,)."""

Rates: TypeAlias = Callable[[Values, Values, Values], Mapping[str, Any]]
"""States, parameters and columns to the rate of each state; arrays broadcast."""

Observe: TypeAlias = Callable[[Values, Values, Values], Any]
"""States, parameters and columns to the noise-free reading."""

Hold: TypeAlias = Literal["previous", "linear"]


@dataclass(frozen=True)
class Noise:
    """What is known of the noise.

    Parameters
    ----------
    sd
        Sd of a reading: a number, the name of a column, or None where it is not known.
    step
        What readings are rounded to; None where that was not declared.
    range
        Least and largest reading that the instrument gives; None at an end that is open.
    zero
        The reading of nothing, about which a gain acts.
    """

    sd: float | str | None = None
    step: float | None = None
    range: tuple[float | None, float | None] = (None, None)
    zero: float = 0.0

    @classmethod
    def of(cls, given: object) -> Noise:
        """Read what is known of the noise as a person writes it: a dict with some of "sd", "step", "range", "zero".

        Raises
        ------
        ParameterError
            If it is nothing like that.
        """
        if isinstance(given, Noise):
            return given
        if not isinstance(given, Mapping) or given.keys() - {"sd", "step", "range", "zero"}:
            meant = f"; was {{'sd': {given}}} meant?" if isinstance(given, int | float) else ""
            raise ParameterError("noise", given, f'a dict with some of "sd", "step", "range", "zero"{meant}')
        ends = given.get("range", (None, None))
        if not isinstance(ends, Sequence) or isinstance(ends, str) or len(ends) != 2:
            raise ParameterError('noise["range"]', ends, "(low, high), low < high")
        return cls(given.get("sd"), given.get("step"), (ends[0], ends[1]), given.get("zero", 0.0))

    def __post_init__(self) -> None:
        if isinstance(self.sd, int | float) and not 0 < self.sd < np.inf:
            raise ParameterError('noise["sd"]', self.sd, "a number greater than 0, or the name of a column")
        if self.step is not None and not 0 < self.step < np.inf:
            raise ParameterError('noise["step"]', self.step, "greater than 0")
        low, high = self.range
        if low is not None and high is not None and not low < high:
            raise ParameterError('noise["range"]', self.range, "(low, high), low < high")


@dataclass(frozen=True)
class Law:
    """The law of a system that moves: where each run starts, how fast each state changes, what is read.

    Parameters
    ----------
    states
        Where each state starts in every run: the name of a parameter, or a number.
    rates
        Rate of each state from states, parameters and columns.
    observe
        The reading from states, parameters and columns; None: the first state.
    hold
        What a column is between two rows: as in the row before, or on the straight line to the next.
    max_step_s
        Longest step of the integration, in the unit of time; None: as the law asks.
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
        if not self.states:
            raise ParameterError("states", dict(self.states), "one state or more, each with where it starts")
        if self.hold not in ("previous", "linear"):
            raise ParameterError("hold", self.hold, "'previous' or 'linear'")
        if self.max_step_s is not None and not 0 < self.max_step_s < np.inf:
            raise ParameterError("max_step_s", self.max_step_s, "greater than 0")


@dataclass(frozen=True)
class Extra:
    """An effect of a person's own: a further parameter that `simulate` or `rates` finds in p.

    `null` is its value where the effect is absent; `says` is a sentence with {value} in it.
    """

    prior: Marginal
    null: float
    says: str


@dataclass(frozen=True, eq=False)
class Simulator:
    """A simulator of readings and what is known of its parameters: one of `simulate` and `law`.

    Parameters
    ----------
    reading, unit
        The column that is predicted, and its unit.
    parameters
        Prior of each parameter, as in FILE.py: (low, high), ("log", low, high), ("normal", mean, sd), or a prior.
    simulate
        Predicts the readings of the whole table.
    law
        Or the law of motion, which is integrated between the rows of each run.
    time, time_unit
        The column of time, if there is one, and its unit.
    run
        The column that says to which run a row belongs, if there is one.
    per_run
        Parameters with a value of their own in every run.
    controls
        Columns that a person can set.
    noise
        What is known of the noise; a dict with some of "sd", "step", "range", "zero" does.
    extra
        Effects of a person's own, by name.
    vectorized
        Whether `simulate` takes parameters (n_samples, 1) and returns (n_samples, n_points).
    source, fingerprint
        The file it was read from, and the fingerprint of its text.
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
    extra: Mapping[str, Extra] = field(default_factory=dict)
    vectorized: bool = False
    source: str = ""
    fingerprint: str = ""

    def __post_init__(self) -> None:
        if (self.simulate is None) == (self.law is None):
            found = "neither" if self.simulate is None else "both"
            raise ParameterError(
                "simulate, rates", found, "one of them: def simulate(p, data), or states and def rates(s, p, u)"
            )
        require_text("reading", self.reading, "the name of the column that is predicted")
        require_kind("unit", self.unit, str, "a text")
        for name, column in (("time", self.time), ("run", self.run)):
            if column is not None:
                require_text(name, column, "the name of a column, or None")
        if self.simulate is not None:
            way = "a function simulate(parameters, columns); of a file: read_simulator('FILE.py') of probewise.systems"
            require_callable("simulate", self.simulate, way)
        else:
            require_kind("law", self.law, Law, "a law of motion: Law(states, rates)")
        require_mapping("parameters", self.parameters, "the prior of each by name: {'tau_s': ('log', 1, 1000)}")
        if not self.parameters:
            raise ParameterError("parameters", {}, "one parameter or more, each with its prior")
        object.__setattr__(self, "parameters", {n: marginal_of(n, prior) for n, prior in self.parameters.items()})
        object.__setattr__(self, "per_run", require_texts("per_run", self.per_run, "names of parameters"))
        object.__setattr__(self, "controls", require_texts("controls", self.controls, "names of columns"))
        object.__setattr__(self, "noise", Noise.of(self.noise))
        require_mapping("extra", self.extra, "effects by name: {'drag': Extra(prior, null, says)}")
        for name in self.per_run:
            if name not in self.parameters:
                raise ParameterError("per_run", name, f"a parameter: {', '.join(self.parameters)}")
        if self.per_run and self.run is None:
            raise ParameterError(
                "per_run", list(self.per_run), 'nothing, or run = "..." with the column that names the runs'
            )
        if self.law is not None:
            if self.time is None:
                raise ParameterError("time", None, "the column of time, which rates are integrated over")
            for state, start in self.law.states.items():
                if isinstance(start, str) and start not in self.parameters:
                    raise ParameterError(
                        f"states[{state!r}]", start, f"a number or a parameter: {', '.join(self.parameters)}"
                    )
        for name, effect in self.extra.items():
            require_kind(f"extra[{name!r}]", effect, Extra, "an Extra(prior, null, says), of probewise.systems")
            if name in self.parameters:
                raise ParameterError("extra", name, "names that no parameter has")


def table_for(simulator: Simulator, data: RunTable | Mapping[str, Any]) -> RunTable:
    """Take a table, or columns by name (a dict of arrays, a DataFrame), with the time and the runs of a simulator."""
    require_simulator(simulator)
    return data if isinstance(data, RunTable) else RunTable(data, simulator.time, simulator.run)


def require_simulator(simulator: object) -> None:
    """Raise ParameterError unless `simulator` is a Simulator, saying how to come by one."""
    allowed = "a Simulator(reading, unit, parameters, simulate=...), or read_simulator('FILE.py'), of probewise.systems"
    require_kind("simulator", simulator, Simulator, f"{allowed}; then comes the table")


def marginal_of(name: str, given: object) -> Marginal:
    """Read a prior as a person writes it: (low, high), ("log", low, high), ("normal", mean, sd), or a prior.

    Raises
    ------
    ParameterError
        If it is nothing of these, or has no mass.
    """
    allowed = '(low, high), ("log", low, high), ("normal", mean, sd), or a prior of probewise.priors'
    if all(hasattr(given, each) for each in ("from_unit", "to_unit", "log_prob")):
        return given  # type: ignore[return-value]
    if not isinstance(given, Sequence) or isinstance(given, str) or not given:
        raise ParameterError(f"parameters[{name!r}]", given, allowed)
    kinds: dict[object, Callable[[float, float], Marginal]] = {"log": LogUniform, "normal": Normal, "uniform": Uniform}
    kind, numbers = (given[0], given[1:]) if isinstance(given[0], str) else ("uniform", given)
    if kind not in kinds or len(numbers) != 2 or not all(_is_number(n) for n in numbers):
        raise ParameterError(f"parameters[{name!r}]", given, allowed)
    try:
        return kinds[kind](float(numbers[0]), float(numbers[1]))
    except ParameterError as error:
        raise ParameterError(f"parameters[{name!r}]", given, f"{error.allowed}: a prior with mass") from error


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
