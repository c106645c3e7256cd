"""A law with what effects add to it, and its readings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ShapeError
from probewise.systems.calls import call_on_read_only, read_only_views
from probewise.systems.simulator import Law

Term = Callable[[Mapping[str, Any], Mapping[str, Any], Mapping[str, Any]], Any]
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
class Jump:
    """A jump of a parameter by `size` after the time `at`, as printed, (n_samples, 1) each."""

    parameter: str
    size: FloatArray
    at: FloatArray


@dataclass(frozen=True, eq=False)
class LawWithEffects:
    """A law with the contributions of effects: additional terms of rates, dry friction, bounds, inputs between rows.

    `friction` is, by state, the size of the force against its motion, (n_samples, 1): a state at rest sticks until the
    other terms of its rate exceed it. Between the rows columns act after `dead_times`, parameters have `drifts`, slopes
    in time as printed, by name, (n_samples, 1) each, and `jumps`; the law's `hold` alone determines the rest.
    """

    law: Law
    terms: tuple[tuple[str, Term], ...] = ()
    friction: Mapping[str, FloatArray] = field(default_factory=dict)
    limits: tuple[Limit, ...] = ()
    dead_times: Mapping[str, FloatArray] = field(default_factory=dict)
    drifts: Mapping[str, FloatArray] = field(default_factory=dict)
    jumps: tuple[Jump, ...] = ()

    def with_term(self, state: str, term: Term) -> LawWithEffects:
        """Return the law with a term added to the rate of a state."""
        return replace(self, terms=(*self.terms, (state, term)))

    def with_limit(self, limit: Limit) -> LawWithEffects:
        """Return the law with a bound of a state added."""
        return replace(self, limits=(*self.limits, limit))

    def with_jump(self, jump: Jump) -> LawWithEffects:
        """Return the law with a jump of a parameter added."""
        return replace(self, jumps=(*self.jumps, jump))

    def with_friction(self, state: str, size: FloatArray) -> LawWithEffects:
        """Return the law with dry friction of this size, (n_samples, 1), added to a state."""
        return replace(self, friction=_with_added(self.friction, state, size))

    def with_dead_time(self, column: str, dead_time: FloatArray) -> LawWithEffects:
        """Return the law with a column that acts after a dead time, (n_samples, 1); two of one column add up."""
        return replace(self, dead_times=_with_added(self.dead_times, column, dead_time))

    def with_drift(self, parameter: str, slope: FloatArray) -> LawWithEffects:
        """Return the law with a drift of a parameter, a slope in time, (n_samples, 1); two of one add up."""
        return replace(self, drifts=_with_added(self.drifts, parameter, slope))

    def directions_of_motion(self, s: Mapping[str, Any], p: Mapping[str, Any], u: Mapping[str, Any]) -> dict[str, Any]:
        """Return, by state with friction, the direction of motion in the next step: 1, -1, or 0 if it sticks."""
        if not self.friction:
            return {}
        if all((s[state] != 0).all() for state in self.friction):
            return {state: np.sign(s[state]) for state in self.friction}
        free = self.rates(s, p, u, {})
        return {
            state: np.where(
                s[state] != 0, np.sign(s[state]), np.where(np.abs(free[state]) > size, np.sign(free[state]), 0.0)
            )
            for state, size in self.friction.items()
        }

    def rates(
        self, s: Mapping[str, Any], p: Mapping[str, Any], u: Mapping[str, Any], ways: Mapping[str, Any]
    ) -> Mapping[str, Any]:
        """Return the rates by state, from states, parameters and columns, with bounds, and friction against `ways`.

        `p` and `u` are read-only, as an interpolator of `LawInputs` returns them; so are the states `s` afterwards.
        """
        for values in s.values():
            values.setflags(False)  # of writing; a keyword would double the time
        given: Mapping[str, Any] = call_on_read_only(self.law.rates, s, p, u)
        if not (self.terms or self.friction or self.limits):
            return given
        out = {state: given[state] for state in self.law.states}
        for state, term in self.terms:
            out[state] = out[state] + term(s, p, u)
        for state, way in ways.items():
            out[state] = np.where(way == 0, 0.0, out[state] - self.friction[state] * way)
        for limit in self.limits:
            rate, at = out[limit.state], s[limit.state]
            stopped = (at >= limit.level) & (rate > 0) if limit.upper else (at <= limit.level) & (rate < 0)
            out[limit.state] = np.where(stopped, 0.0, rate)
            for other, share in limit.spilt.items():
                out[other] = out[other] + share * np.where(stopped, rate, 0.0)
        return out

    def clip_and_stop_states(self, ways: Mapping[str, Any], after: dict[str, Any]) -> dict[str, Any]:
        """Return the states after a step: clipped to their bounds, and 0 where they reversed against friction."""
        for state, way in ways.items():
            after[state] = np.where(way * after[state] < 0, 0.0, after[state])
        for limit in self.limits:
            bound, before = np.minimum if limit.upper else np.maximum, after[limit.state]
            after[limit.state] = bound(before, limit.level)
            for other, share in limit.spilt.items():
                after[other] = after[other] + share * (before - after[limit.state])
        return after


def _with_added(known: Mapping[str, FloatArray], name: str, value: FloatArray) -> dict[str, FloatArray]:
    return {**known, name: known[name] + value if name in known else value}


def readings_of_states(
    law: Law, states: Mapping[str, FloatArray], parameters: Mapping[str, Any], columns: Mapping[str, Any]
) -> FloatArray:
    """Return a law's readings, (n_samples, n_points), from its states at every row, each of that shape."""
    first = next(iter(states.values()))
    if law.observe is None:
        return first
    with np.errstate(all="ignore"):
        given = map(read_only_views, (states, parameters, columns))
        out = np.asarray(call_on_read_only(law.observe, *given), dtype=np.float64)
    try:
        return np.array(np.broadcast_to(out, first.shape))
    except ValueError:
        allowed = f"{first.shape} or one that broadcasts to it: a number for each sample and row"
        raise ShapeError(f"observe returns an array of shape {out.shape}; allowed: {allowed}") from None
