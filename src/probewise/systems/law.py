"""A law with what effects add to it, its readings, its inputs between the rows, and the steps that integrate it.

The classical Runge-Kutta method of fourth order and, for stiff laws, a linearly implicit (Rosenbrock) one of third
order that is L-stable, RODAS3 (Sandu et al., Atmospheric Environment 31, 1997, 3459), in the variables u that need no
product with the Jacobian (Hairer & Wanner, Solving Ordinary Differential Equations II, 1996, equation 7.25).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import ROUNDING, FloatArray, IntArray, floats
from probewise.errors import ShapeError
from probewise.systems.calls import call_on_read_only, call_on_views
from probewise.systems.simulator import Columns, Law, Values
from probewise.systems.table import RunTable

_GAMMA = 0.5
# Of each stage: weights of the earlier ones in its states and on the right-hand side, share of the step at which it is,
# and weight of the rates' change with time.
_STAGES = (
    ((), (), 0.0, 0.5),
    ((0.0,), (4.0,), 0.0, 1.5),
    ((2.0, 0.0), (1.0, -1.0), 1.0, 0.0),
    ((2.0, 0.0, 1.0), (1.0, -1.0, -8 / 3), 1.0, 0.0),
)
# Of a state's size, for the Jacobian by central differences: it is so smooth that all steps can be solved for at once.
_NUDGE = 1e-5
_LEAST_SIZE = 1e-6  # of the largest state's size, for one that is 0 and at rest
_TINY = 1e-150  # where all are
_LATER = 1e-4  # of a step, for the rates' change with time: inputs between rows are constant or straight lines

Rates = Callable[[FloatArray, Any], FloatArray]
"""Rate of each state, (n_states, n_samples, n_columns), from states of that shape and the inputs at some time."""

Between = Callable[[Any], Any]
"""Inputs at a share of the gap between two rows: a number, or one for each column of the states."""

Method = Callable[[Rates, Between, FloatArray, Any, Any, FloatArray], FloatArray]
"""A method that takes a step, as `runge_kutta_step`."""


def rosenbrock_step(
    rates: Rates, between: Between, s: FloatArray, begin: Any, length: Any, gap: FloatArray
) -> FloatArray:
    """Return the states after a step of RODAS3 from `s`, (n_states, n_samples, n_columns).

    It is one linear system for each sample and column, solved four times. `begin` and `length` are shares of the `gap`,
    the time from row to row, (1 or n_samples, n_columns): numbers, or one for each column.
    """
    n, *shape = s.shape
    width = np.broadcast_to(gap * length, shape)
    there = width > 0  # runs that ended stand still
    step = np.where(there, width, 1.0)
    given = between(begin)
    first = rates(s, given)
    size = np.maximum(np.abs(s), np.abs(step * first))
    nudge = _NUDGE * np.maximum(size, np.maximum(_LEAST_SIZE * size.max(axis=0), _TINY))
    matrix = np.empty((n, *s.shape))
    for k in range(n):
        less, more = s.copy(), s.copy()
        less[k] -= nudge[k]
        more[k] += nudge[k]
        matrix[:, k] = (rates(more, given) - rates(less, given)) * (-step / (more[k] - less[k]))
        matrix[k, k] += 1 / _GAMMA
    inverse = _inverse(matrix)
    by_time = (rates(s, between(begin + _LATER * length)) - first) / _LATER  # times the step's length
    u: list[FloatArray] = []
    at = s
    for a, c, share, gamma in _STAGES:
        at = _with_weighted(s, a, u)
        rate = rates(at, between(begin + share * length)) if share else first
        right = _with_weighted(step * (rate + gamma * by_time), c, u)
        u.append(inverse[0, 0] * right if n == 1 else np.einsum("ij...,j...->i...", inverse, right))
    return np.where(there, at + u[-1], s)


def _with_weighted(first: FloatArray, weights: tuple[float, ...], terms: list[FloatArray]) -> FloatArray:
    out = first.copy()
    for weight, term in zip(weights, terms, strict=True):
        out += weight * term
    return out


def _inverse(matrices: FloatArray) -> FloatArray:
    """Return the inverses of matrices, (n, n, ...); NaN where there is none, or an element is not finite."""
    n = len(matrices)
    if n == 1:
        return np.asarray(1.0 / matrices)
    if n == 2:
        (a, b), (c, d) = matrices
        return np.asarray(np.array([[d, -b], [-c, a]]) / (a * d - b * c))
    own = np.moveaxis(matrices, (0, 1), (-2, -1))
    fine = np.isfinite(own).all(axis=(-2, -1), keepdims=True)
    own = np.where(fine, own, np.eye(n))
    try:
        inverse = np.linalg.inv(own)
    except np.linalg.LinAlgError:  # one of them is singular
        inverse = np.linalg.pinv(own)
    return np.moveaxis(np.where(fine, inverse, np.nan), (-2, -1), (0, 1))


def runge_kutta_step(
    rates: Rates, between: Between, s: FloatArray, begin: Any, length: Any, gap: FloatArray
) -> FloatArray:
    """Return the states after a step of the classical method of fourth order, as `rosenbrock_step` does."""
    width, middle = gap * length, between(begin + 0.5 * length)
    first = rates(s, between(begin))
    second = rates(s + 0.5 * width * first, middle)
    third = rates(s + 0.5 * width * second, middle)
    last = rates(s + width * third, between(begin + length))
    return np.asarray(s + width * (1 / 6 * first + 1 / 3 * second + 1 / 3 * third + 1 / 6 * last))


@dataclass(frozen=True, eq=False)
class Steps:
    """Integration steps over the rows of a table, in all its runs together; position k is the k-th row of every run.

    `rows` are the table's rows at each position of each run, (n_places, n_runs), after its end the run's last; `place`
    is the position of each row, (n_points,). From a position to the next is a gap, of time `gaps`, (n_places - 1,
    n_runs), with the same number of steps in all runs, `n_steps`, (n_places - 1,), which the `method` takes.
    `n_before` are the steps from the first row of a run to its row at each position, (n_places,); `gap` is that in
    which each step lies, (n_steps,), and `begin` and `length` are the shares of it at which it begins and that it
    takes, (n_steps * n_runs,), by step, then run.
    """

    table: RunTable
    rows: IntArray
    place: IntArray
    gaps: FloatArray
    n_steps: IntArray
    method: Method
    n_before: IntArray
    gap: IntArray
    begin: FloatArray
    length: FloatArray


@lru_cache(maxsize=16)
def steps_for_table(table: RunTable, max_step: float, *, stiff: bool = False) -> Steps:
    """Return the steps over a table, none longer than `max_step`, in the unit of time.

    The method is linearly implicit if `stiff`, else explicit. Raises ParameterError if time decreases within a run.
    """
    table.require_rising_time()
    by_run, place = table.rows_by_scan(), np.empty(len(table), dtype=np.int64)
    longest = max(map(len, by_run))
    rows = np.stack([np.append(own, np.full(longest - len(own), own[-1])) for own in by_run], axis=1)
    for own in by_run:
        place[own] = np.arange(len(own))
    gaps = np.diff(table.time_s[rows], axis=0)
    n_steps = np.maximum(np.ceil(gaps.max(axis=1, initial=0.0) / max_step - ROUNDING), 1).astype(np.int64)
    n_before, gap = np.append(0, np.cumsum(n_steps)), np.repeat(np.arange(len(n_steps)), n_steps)
    share = (np.arange(len(gap)) - n_before[gap]) / n_steps[gap]
    of_runs = (np.repeat(each, len(by_run)) for each in (share, 1.0 / n_steps[gap]))
    method = rosenbrock_step if stiff else runge_kutta_step
    return Steps(table, rows, place, gaps, n_steps, method, n_before, gap, *of_runs)


_NO_WAYS: Mapping[int, Any] = MappingProxyType({})

Term = Callable[[Values, Values, Values], Any]
"""A term of a state's rate: function of states, parameters and columns; returns (n_samples, n_runs)."""


@dataclass(frozen=True, eq=False)
class Limit:
    """A bound of a state: `level` (n_samples, 1), an upper bound if `upper`, else a lower bound.

    The rate beyond the bound is lost, except for shares that other states take up: `spilt`, by state, (n_samples, 1).
    """

    state: str
    level: FloatArray
    upper: bool = True
    spilt: Mapping[str, FloatArray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class LawWithEffects:
    """A law with the contributions of effects: additional terms of rates, dry friction, and bounds.

    `friction` is, by state, the size of the force against its motion, (n_samples, 1): a state at rest sticks until the
    other terms of its rate exceed it.
    """

    law: Law
    terms: tuple[tuple[str, Term], ...] = ()
    friction: Mapping[str, FloatArray] = field(default_factory=dict)
    limits: tuple[Limit, ...] = ()

    def plus(self, **more: Any) -> LawWithEffects:
        """Return the law with more `terms` or `limits`, or values by name, of which two of one name add up."""
        own: dict[str, Any] = {}
        for what, new in more.items():
            known = getattr(self, what)
            if isinstance(new, tuple):
                own[what] = (*known, *new)
            else:
                own[what] = {**known, **{name: known[name] + v if name in known else v for name, v in new.items()}}
        return replace(self, **own)

    @cached_property
    def friction_of(self) -> dict[int, FloatArray]:
        """The size of the friction by the number of the state."""
        return {[*self.law.states].index(state): size for state, size in self.friction.items()}

    def directions_of_motion(self, s: FloatArray, given: tuple[Values, Values]) -> dict[int, Any]:
        """Return, by number of the state with friction, the direction of its next motion: 1, -1, or 0 if it sticks."""
        ways: dict[int, Any] = {state: np.sign(s[state]) for state in self.friction_of}
        if any((way == 0).any() for way in ways.values()):
            free = self.rates(s, given)
            for state, size in self.friction_of.items():
                breaks_loose = np.where(np.abs(free[state]) > size, np.sign(free[state]), 0.0)
                ways[state] = np.where(s[state] != 0, ways[state], breaks_loose)
        return ways

    def rates(self, s: FloatArray, given: tuple[Values, Values], ways: Mapping[int, Any] = _NO_WAYS) -> FloatArray:
        """Return the rates of states, (n_states, n_samples, n_columns), with bounds, and friction against `ways`.

        `given` are parameters and columns, read-only, as `StepInputs` returns them.
        """
        at: Any = s.view()
        at.setflags(False)  # of writing; a keyword would double the time
        out = np.empty(s.shape)
        by_name, rate = dict(zip(self.law.states, at, strict=True)), dict(zip(self.law.states, out, strict=True))
        found = call_on_read_only(self.law.rates, by_name, *given)
        for state in rate:
            rate[state][:] = found[state]
        for state, term in self.terms:
            rate[state] += term(by_name, *given)
        for number, way in ways.items():
            out[number] = np.where(way == 0, 0.0, out[number] - self.friction_of[number] * way)
        for limit in self.limits:
            own, here = rate[limit.state], by_name[limit.state]
            stopped = (here >= limit.level) & (own > 0) if limit.upper else (here <= limit.level) & (own < 0)
            lost = np.where(stopped, own, 0.0)
            own[stopped] = 0.0
            for other, share in limit.spilt.items():
                rate[other] += share * lost
        return out

    def clip_and_stop_states(self, ways: Mapping[int, Any], after: FloatArray) -> FloatArray:
        """Clip states after a step to their bounds, and set those to 0 that reversed against friction, in place."""
        for number, way in ways.items():
            after[number] = np.where(way * after[number] < 0, 0.0, after[number])
        state = dict(zip(self.law.states, after, strict=True))
        for limit in self.limits:
            bound, before = np.minimum if limit.upper else np.maximum, state[limit.state].copy()
            state[limit.state][:] = bound(before, limit.level)
            for other, share in limit.spilt.items():
                state[other] += share * (before - state[limit.state])
        return after


def readings_of_states(law: Law, states: Values, parameters: Values, columns: Values) -> FloatArray:
    """Return a law's readings, (n_samples, n_points), from its states at every row, each of that shape."""
    first: FloatArray = next(iter(states.values()))
    if law.observe is None:
        return first
    with np.errstate(all="ignore"):
        out = floats(call_on_views(law.observe, states, parameters, columns), "what observe returns")
    try:
        return np.array(np.broadcast_to(out, first.shape))
    except ValueError:
        allowed = f"{first.shape} or one that broadcasts to it: a number for each sample and row"
        raise ShapeError(f"observe returns an array of shape {out.shape}; allowed: {allowed}") from None


@dataclass(frozen=True, eq=False)
class StepInputs:
    """Parameters and columns by name, in that order, read-only: at the start of a gap, and their rise over it if any.

    Over a table arrays are (1 or n_samples, n_places, n_runs), those of a constant (1 or n_samples, 1, 1 or n_runs);
    of some steps (1 or n_samples, n_columns), with a column for each step and run, the runs of a step in turn, or 1.
    `time` is the name of the time, which always rises.
    """

    time: str
    start: tuple[Values, Values]
    rise: tuple[Values, Values]

    @property
    def gap(self) -> Any:
        """Time of the gap by the time column, which an effect on the clock changes, (1 or n_samples, n_columns)."""
        return self.rise[1][self.time]

    def __call__(self, share: Any) -> tuple[Values, Values]:
        """Return parameters and columns, by name, at a share of the gap between rows: read-only arrays."""
        return _at_share(self.start[0], self.rise[0], share), _at_share(self.start[1], self.rise[1], share)

    @classmethod
    def over_table(cls, law: Law, steps: Steps, parameters: Values, columns: Columns) -> StepInputs:
        """Return a law's inputs over the table of its steps, (n_points,) or (n_samples, n_points) each.

        Between the rows they go on as the law's `hold` says, also what an effect makes of them at the rows.
        """
        rows, time, linear = steps.rows, str(steps.table.time), law.hold == "linear"
        p, u, dp, du = ({} for _ in range(4))
        for name, values in parameters.items():
            p[name] = own = values_at_rows(values, rows)
            if own.shape[1] == 1 or not np.ptp(own, axis=1).any():
                p[name] = own[:, :1]
            elif linear:
                dp[name] = np.diff(own, axis=1)
        for name, values in columns.items():
            u[name] = own = values_at_rows(values, rows)
            if name == time or (linear and values.dtype == np.float64):
                du[name] = np.diff(own, axis=1)
        return cls(time, (p, u), (dp, du))

    def of_gaps(self, gaps: IntArray | slice, n_gaps: int) -> StepInputs:
        """Return those over a table in some of its gaps, of several steps one after the other."""

        def in_gaps(values: Any) -> Any:
            if values.shape[1] > 1:
                return values[:, gaps].reshape(len(values), -1)
            constant = values[:, 0]
            return np.tile(constant, (1, n_gaps)) if n_gaps > 1 and constant.shape[1] > 1 else constant

        return self.mapped(in_gaps)

    def mapped(self, chosen: Callable[[Any], Any]) -> StepInputs:
        """Return them with a function applied to every array."""
        p, u, dp, du = ({name: chosen(v) for name, v in each.items()} for each in (*self.start, *self.rise))
        for values in (*p.values(), *u.values()):
            values.setflags(False)
        return StepInputs(self.time, (p, u), (dp, du))

    def of_columns(self, columns: IntArray) -> StepInputs:
        """Return them in some of the columns."""
        return self.mapped(partial(of_columns, columns=columns))


def _at_share(start: Values, rise: Values, share: Any) -> Values:
    if not rise:
        return start
    out = dict(start)
    for name, by in rise.items():
        out[name] = value = out[name] + share * by
        value.setflags(False)  # of writing; a keyword would double the time
    return out


def of_columns(values: Any, columns: IntArray) -> Any:
    """Return some columns of values by column, (n_columns,) or (n, n_columns); a number is that of all columns."""
    return values[..., columns] if np.ndim(values) and values.shape[-1] > 1 else values


def values_at_rows(values: NDArray[Any], rows: IntArray) -> NDArray[Any]:
    """Index values (n_points,) or (n_samples, n_points) by rows (n_places, n_runs); (n, 1) becomes (n, 1, 1)."""
    if values.ndim == 1:
        return np.asarray(values[rows][None])
    return values[:, :, None] if values.shape[1] == 1 else np.asarray(values[:, rows])
