"""A law with what effects add to it, its readings, and its parameters and columns between the rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import FloatArray, IntArray, floats
from probewise.errors import ShapeError
from probewise.systems.calls import call_on_read_only, call_on_views
from probewise.systems.simulator import Columns, Law, Values
from probewise.systems.step import Steps

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
