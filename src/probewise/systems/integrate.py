"""Integrate a law between the rows of each run, for all samples and runs at once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.systems.calls import number_of_samples
from probewise.systems.law import LawInputs, LawWithEffects, StepInputs, StepPart, of_columns, values_at_rows
from probewise.systems.simulator import Columns, Law, Values
from probewise.systems.step import FOURTH_ORDER, N_LONGER, RODAS, Rosenbrock, RungeKutta, Steps

_MANY_COLUMNS = 64  # of the states' arrays, from which steps to be split are taken out of the others


def integrate_states(
    motion: LawWithEffects | Law, steps: Steps, parameters: Values, columns: Columns
) -> dict[str, FloatArray]:
    """Integrate a law step by step; return every state at every row, by name, (n_samples, n_points).

    Parameters are (n_samples, 1), or (n_samples, n_points) if they vary by row; columns (n_points,), or
    (n_samples, n_points) if an effect changes them; as recorded, of those that `motion` delays.
    """
    motion, known = LawWithEffects(motion) if isinstance(motion, Law) else motion, {*steps.n_before.tolist()}
    kept = [s for k, s in enumerate(states_by_step(motion, steps, parameters, columns)) if k in known]
    return dict(zip(motion.law.states, np.stack(kept, axis=2)[:, :, steps.place, steps.table.scan], strict=True))


def states_by_step(
    motion: LawWithEffects, steps: Steps, parameters: Values, columns: Columns
) -> Iterator[FloatArray]:
    """Integrate the law: yield all states, (n_states, n_samples, n_runs), at the start and after each step."""
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
    elif method is FOURTH_ORDER or not motion.may_halt:
        n_stages = len(method.b)
    else:
        n_stages = N_LONGER * len(FOURTH_ORDER.b)
    return n_stages + n_stages // 2 if motion.friction else n_stages


def initial_states(motion: LawWithEffects, steps: Steps, parameters: Values, n_samples: int) -> FloatArray:
    """Return the states in which the runs start, within their bounds, (n_states, n_samples, n_runs)."""
    starts, first = motion.law.states.values(), steps.rows[:1]
    start = np.empty((len(starts), n_samples, first.shape[1]))
    for state, at in zip(start, starts, strict=True):
        state[:] = values_at_rows(parameters[at], first)[:, 0] if isinstance(at, str) else float(at)
    return motion.clip_and_stop_states({}, start)


@dataclass(frozen=True, eq=False)
class Stepper:
    """Steps of a law, by a Runge-Kutta or a Rosenbrock method, with its inputs `between` two rows.

    States are (n_states, n_samples, n_columns). In the methods `begin` and `length` are shares of the gap: numbers, or
    one for each column.
    """

    motion: LawWithEffects
    method: RungeKutta | Rosenbrock
    between: StepInputs

    def step(self, s: FloatArray, begin: Any, length: Any) -> FloatArray:
        """Return the states after a step; it is split where friction brings a state to rest or lets it go.

        A motion that may come to a halt within a step takes one of eighth order as several of fourth order.
        """
        motion = self.motion
        if motion.may_halt and self.method is not FOURTH_ORDER and self.method is not RODAS:
            shorter, part = replace(self, method=FOURTH_ORDER), length / N_LONGER
            for k in range(N_LONGER):
                s = shorter.step(s, begin + k * part, part)
            return s
        ways = motion.directions_of_motion(s, self.between(begin))
        after = self._step_without_split(s, begin, length, ways)
        for state, way in ways.items():
            after, ways = self._split_at_transitions(state, way, s, after, begin, length, ways)
        return motion.clip_and_stop_states(ways, after)

    def _split_at_transitions(
        self, state: int, way: Any, s: FloatArray, after: FloatArray, begin: Any, length: Any, ways: dict[int, Any]
    ) -> tuple[FloatArray, dict[int, Any]]:
        """Split steps from `s` to `after` where friction brings a state to rest or lets it go.

        The state begins them in the direction `way`; `ways` are the directions of all states that `after` results from.
        Returns the states after the steps, and the directions of motion at their end.
        """
        motion, between, at_rest = self.motion, self.between, way == 0

        def margin_to_transition(at: FloatArray, share: Any) -> Any:
            """Return the margin, negative after the transition, until the state comes to rest or breaks loose."""
            moving = way * at[state]
            if not at_rest.any():
                return moving
            return np.where(at_rest, motion.friction_of[state] - np.abs(motion.rates(at, between(share))[state]), moving)

        last = margin_to_transition(after, begin + length)
        ends = last < 0
        if not ends.any():
            return after, ways
        n_columns, some = ends.shape[1], np.flatnonzero(ends.any(axis=0))
        if n_columns > _MANY_COLUMNS and 2 * len(some) <= n_columns:
            few, ends_of = replace(self, between=self.between.of_columns(some)), {k: v[:, some] for k, v in ways.items()}
            begin, length = of_columns(begin, some), of_columns(length, some)
            own = few._split_at_transitions(
                state, way[:, some], s[:, :, some], after[:, :, some], begin, length, ends_of
            )
            out, ways = after.copy(), {k: v.copy() for k, v in ways.items()}
            out[:, :, some] = own[0]
            for k, new in own[1].items():
                ways[k][:, some] = new
            return out, ways
        first = margin_to_transition(s, begin)
        until = np.where(ends, _zero_of_straight_line(0.0, first, 1.0, last), 1.0)
        left = margin_to_transition(self._step_without_split(s, begin, until * length, ways), begin + until * length)
        closer = np.where(
            left > 0, _zero_of_straight_line(until, left, 1.0, last), _zero_of_straight_line(0.0, first, until, left)
        )
        until = np.where(ends, closer, 1.0)
        there = self._step_without_split(s, begin, until * length, ways)
        there[state] = np.where(ends, 0.0, there[state])
        anew = motion.directions_of_motion(there, between(begin + until * length))
        free = motion.rates(after, between(begin + length))[state]
        anew[state] = np.where(ends & at_rest, np.sign(free), anew[state])
        return self._step_without_split(there, begin + until * length, (1 - until) * length, anew), anew

    def _step_without_split(self, s: FloatArray, begin: Any, length: Any, ways: dict[int, Any]) -> FloatArray:
        """Return the states after one step of the method, with friction against the fixed directions `ways`."""
        rates = self.motion.rates
        gap = self.between.gap
        return self.method.advance(lambda at, given: rates(at, given, ways), self.between, s, begin, length, gap)


def step_in_part(
    motion: LawWithEffects, method: RungeKutta | Rosenbrock, part: StepPart, s: FloatArray
) -> FloatArray:
    """Return the states, (n_states, n_samples, n_columns), after a part of some steps; other columns stay as they are."""
    columns, inputs, begin, length = part
    stepper = Stepper(motion, method, inputs)
    if columns is None:
        return stepper.step(s, begin, length)
    out = s.copy()
    out[:, :, columns] = stepper.step(s[:, :, columns], begin, length)
    return out


def _zero_of_straight_line(low: Any, at_low: Any, high: Any, at_high: Any) -> Any:
    """Return where a straight line through (low, at_low) and (high, at_high) is 0; `low` if it does not fall."""
    apart = at_low - at_high
    return low + (high - low) * np.where(apart > 0, at_low / np.where(apart > 0, apart, 1.0), 0.0)
