"""Integrate a law between the rows of each run, for all samples and runs at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.systems.calls import number_of_samples
from probewise.systems.law import LawInputs, LawWithEffects, StepInputs, StepPart, of_columns, values_at_rows
from probewise.systems.simulator import Columns, Law, Values
from probewise.systems.step import FOURTH_ORDER, N_LONGER, Rosenbrock, RungeKutta, Steps, Terms

_MANY_COLUMNS = 64  # of the states' arrays, from which steps to be split are taken out of the others


def integrate_states(
    motion: LawWithEffects | Law, steps: Steps, parameters: Values, columns: Columns
) -> dict[str, FloatArray]:
    """Integrate a law step by step; return every state at every row, by name, (n_samples, n_points).

    Parameters are (n_samples, 1), or (n_samples, n_points) if they vary by row; columns (n_points,), or
    (n_samples, n_points) if an effect changes them; as recorded, of those that `motion` delays.
    """
    motion = LawWithEffects(motion) if isinstance(motion, Law) else motion
    at_row, place = steps.n_steps_before_position, steps.position_by_row
    every = enumerate(states_by_step(motion, steps, parameters, columns))
    known = {*at_row.tolist()}
    kept = [s for number, s in every if number in known]
    return {
        state: np.stack([s[state] for s in kept], axis=1)[:, place, steps.table.scan] for state in motion.law.states
    }


def states_by_step(
    motion: LawWithEffects, steps: Steps, parameters: Values, columns: Columns
) -> Iterator[dict[str, FloatArray]]:
    """Integrate the law: yield all states by name, (n_samples, n_runs) each, at the start and after each step."""
    s = initial_states(motion, steps, parameters, number_of_samples(parameters, columns))
    with np.errstate(all="ignore"):
        given = LawInputs(motion, steps, parameters, columns)
        yield s
        for k, n in enumerate(steps.n_steps.tolist()):
            inputs = given.of_gaps(slice(k, k + 1), 1)
            for i in range(n):
                for part in given.parts_of_steps(inputs, np.array([k]), i / n, 1 / n, whole=True):
                    s = step_in_part(motion, steps.method, part, s)
                yield s


def evaluations_per_step(motion: LawWithEffects, method: RungeKutta | Rosenbrock) -> int:
    """Return about how often a step of a law evaluates its rates, of all samples together.

    Friction asks for the direction of motion, and splits steps in which a state comes to rest or breaks loose: by half
    as much again, where samples of a search do so at different times.
    """
    if isinstance(method, Rosenbrock):
        n_stages = 13 + 2 * len(motion.law.states)  # its linear algebra included
    elif motion.limits or motion.friction:
        n_stages = len(method.b) if method is FOURTH_ORDER else N_LONGER * len(FOURTH_ORDER.b)
    else:
        return len(method.b)
    return n_stages + n_stages // 2 if motion.friction else n_stages


def n_parts_of_steps(motion: LawWithEffects, steps: Steps) -> int:
    """Return about how many steps and parts of steps are taken: a column that is late divides one in each gap."""
    return int(steps.n_steps.sum() + len(steps.n_steps) * bool(motion.dead_times))


def initial_states(motion: LawWithEffects, steps: Steps, parameters: Values, n_samples: int) -> dict[str, FloatArray]:
    """Return the states in which the runs start, within their bounds, by name, (n_samples, n_runs) each."""
    start, first = {}, steps.row_by_position_and_run[:1]
    for state, given in motion.law.states.items():
        at = values_at_rows(parameters[given], first)[:, 0] if isinstance(given, str) else np.full((1, 1), float(given))
        start[state] = np.array(np.broadcast_to(at, (n_samples, first.shape[1])))
    return motion.clip_and_stop_states({}, start)


@dataclass(frozen=True, eq=False)
class Stepper:
    """Steps of a law, by a Runge-Kutta or a Rosenbrock method, with its inputs `between` two rows.

    In the methods `begin` and `length` are shares of the gap: numbers, or one for each column of the states.
    """

    motion: LawWithEffects
    method: RungeKutta | Rosenbrock
    between: StepInputs

    def step(self, s: dict[str, Any], begin: Any, length: Any) -> dict[str, Any]:
        """Return the states after a step; it is split where friction brings a state to rest or lets it go.

        A motion that may come to a halt within a step takes one of eighth order as several of fourth order.
        """
        motion = self.motion
        explicit = isinstance(self.method, RungeKutta)
        if explicit and self.method is not FOURTH_ORDER and (motion.limits or motion.friction):
            shorter, part = replace(self, method=FOURTH_ORDER), length / N_LONGER
            for k in range(N_LONGER):
                s = shorter.step(s, begin + k * part, part)
            return s
        ways = motion.directions_of_motion(s, *self.between(begin))
        after = self._step_without_split(s, begin, length, ways)
        for state, way in ways.items():
            after, ways = self._split_at_transitions(state, way, s, after, begin, length, ways)
        return motion.clip_and_stop_states(ways, after) if ways or motion.limits else after

    def _split_at_transitions(
        self,
        state: str,
        way: Any,
        s: dict[str, Any],
        after: dict[str, Any],
        begin: Any,
        length: Any,
        ways: dict[str, Any],
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Split steps from `s` to `after` where friction brings a state to rest or lets it go.

        The state begins them in the direction `way`; `ways` are the directions of all states that `after` results from.
        Returns the states after the steps, and the directions of motion at their end.
        """
        motion, between, at_rest = self.motion, self.between, way == 0

        def margin_to_transition(at: Values, share: Any) -> Any:
            """Return the margin, negative after the transition, until the state comes to rest or breaks loose."""
            moving = way * at[state]
            if not at_rest.any():
                return moving
            free = motion.rates(at, *between(share), {})[state]
            return np.where(at_rest, motion.friction[state] - np.abs(free), moving)

        last = margin_to_transition(after, begin + length)
        ends = last < 0
        if not ends.any():
            return after, ways
        n_columns, some = ends.shape[1], np.flatnonzero(ends.any(axis=0))
        if n_columns > _MANY_COLUMNS and 2 * len(some) <= n_columns:
            few = replace(self, between=self.between.of_columns(some))
            s, own, ends_of = ({name: v[:, some] for name, v in each.items()} for each in (s, after, ways))
            begin, length = of_columns(begin, some), of_columns(length, some)
            split = few._split_at_transitions(state, way[:, some], s, own, begin, length, ends_of)
            return _with_columns(after, some, split[0]), _with_columns(ways, some, split[1])
        first = margin_to_transition(s, begin)
        until = np.where(ends, _zero_of_straight_line(0.0, first, 1.0, last), 1.0)
        there = self._step_without_split(s, begin, until * length, ways)
        left = margin_to_transition(there, begin + until * length)
        closer = np.where(
            left > 0, _zero_of_straight_line(until, left, 1.0, last), _zero_of_straight_line(0.0, first, until, left)
        )
        until = np.where(ends, closer, 1.0)
        there = self._step_without_split(s, begin, until * length, ways)
        there[state] = np.where(ends, 0.0, there[state])
        anew = motion.directions_of_motion(there, *between(begin + until * length))
        free = motion.rates(after, *between(begin + length), {})[state]
        anew[state] = np.where(ends & at_rest, np.sign(free), anew[state])
        return self._step_without_split(there, begin + until * length, (1 - until) * length, anew), anew

    def _step_without_split(self, s: Values, begin: Any, length: Any, ways: Values) -> dict[str, Any]:
        """Return the states after one step of the method, with friction against the fixed directions `ways`."""
        method = self.method
        if isinstance(method, Rosenbrock):
            return method.advanced(
                lambda at, share: self.motion.rates(at, *self.between(share), ways), s, begin, length, self.between.gap
            )
        width, given = self.between.gap * length, self.between(begin)
        _, *later, end = method.terms
        rates = [self.motion.rates(s, *given, ways)]
        for k, terms in enumerate(later, 1):
            if method.c[k] != method.c[k - 1]:
                given = self.between(begin + method.c[k] * length)
            rates.append(self.motion.rates(_advanced_states(s, width, terms, rates), *given, ways))
        return _advanced_states(s, width, end, rates)


def step_in_part(
    motion: LawWithEffects, method: RungeKutta | Rosenbrock, part: StepPart, s: dict[str, Any]
) -> dict[str, Any]:
    """Return the states, (n_samples, n_columns), after a part of some steps; other columns stay as they are."""
    columns, inputs, begin, length = part
    stepper = Stepper(motion, method, inputs)
    if columns is None:
        return stepper.step(s, begin, length)
    some = {state: values[:, columns] for state, values in s.items()}
    return _with_columns(s, columns, stepper.step(some, begin, length))


def _with_columns(s: Values, columns: IntArray, new: Values) -> dict[str, Any]:
    """Return arrays by state, (n_samples, n_columns), with the values `new` in some of their columns."""
    out = {state: values.copy() for state, values in s.items()}
    for state, values in new.items():
        out[state][:, columns] = values
    return out


def _advanced_states(s: Values, width: Any, terms: Terms, rates: Sequence[Values]) -> dict[str, Any]:
    """Return the states after the time `width` at a constant rate, the weighted sum `terms` of `rates`."""
    (first, weight), *others = terms
    if not others:  # of one stage, as all of fourth order are: one product less
        share = weight * width
        return {state: at + share * rates[first][state] for state, at in s.items()}
    out = {}
    for state, at in s.items():
        rate = weight * rates[first][state]
        for k, w in others:
            rate = rate + w * rates[k][state]
        out[state] = at + width * rate
    return out


def _zero_of_straight_line(low: Any, at_low: Any, high: Any, at_high: Any) -> Any:
    """Return where a straight line through (low, at_low) and (high, at_high) is 0; `low` if it does not fall."""
    apart = at_low - at_high
    return low + (high - low) * np.where(apart > 0, at_low / np.where(apart > 0, apart, 1.0), 0.0)
