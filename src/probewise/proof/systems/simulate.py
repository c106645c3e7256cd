"""From parameters to noise-free readings: effects on inputs, parameters, rates and readings; laws are integrated.

SciPy's eighth-order method integrates all runs together. Dry friction and bounds change the law at events: with them
each run is integrated by itself, and its events are located.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, cast

import numpy as np
from scipy.integrate import solve_ivp

from probewise._arrays import FloatArray, IntArray
from probewise.errors import NotConvergedError
from probewise.proof.systems.forms import Form, Instants, SimulatedSystem, SystemEffect
from probewise.proof.systems.kinds import Law, SystemKind, SystemTable, Values

_RTOL, _ATOL = 1e-8, 1e-10
_REST = 1e-9  # share of a state's scale below which it is at rest
_MOST_CALLS = 600  # limit of evaluations between two rows, or events; a step has twelve
_MOST_EVENTS = 200  # limit of events between two rows
_CLOSE = 1e-7  # share of a gap: closer events are merged
_HAIR = 1e-8  # share of a gap by which an interval keeps away from discontinuities at its ends


def simulate_noise_free(
    kind: SystemKind, rows: SystemTable, parameters: Mapping[str, Any], effects: Sequence[SystemEffect] = ()
) -> SimulatedSystem:
    """Simulate a system without noise.

    `rows`: the table of the rows to simulate; `parameters`: by name, a number or (n_points,) each.
    """
    law, columns, inner = kind.law, dict(rows.columns), []
    for effect in effects:
        if effect.form.side == "input" and not (effect.form.late and law is not None):
            columns = effect.form.act(columns, rows, effect.values)
        elif effect.form.side != "reading":
            inner.append(effect)
    states: Mapping[str, FloatArray] = {}
    if law is not None:
        states = _Integration(kind, rows, parameters, columns, inner).solve()
        readings = law.read(states, parameters, columns)
    else:
        p, now = dict(parameters), Instants.at_rows(rows)
        for effect in inner:
            p[effect.form.target] = p[effect.form.target] + effect.form.act(now, effect.values)
        readings = kind.formula(p, columns)
    readings = np.array(np.broadcast_to(readings, len(rows)), dtype=np.float64)
    for effect in sorted((e for e in effects if e.form.side == "reading"), key=lambda e: e.form.order):
        readings = effect.form.act(readings, rows, effect.values)
    return SimulatedSystem(kind, rows, parameters, readings, states)


class _Integration:
    """The solution of a law for all runs; `columns` are the inputs after their effects, including time.

    `effects`: on parameters and rates, and those that delay a column.
    """

    def __init__(
        self, kind: SystemKind, table: SystemTable, p: Values, columns: Values, effects: Sequence[SystemEffect]
    ) -> None:
        self.law, self.kind, self.table, self.parameters = cast(Law, kind.law), kind, table, p
        self.columns, self.effects, self.names = columns, effects, list(self.law.start)
        # The time by which the law is integrated, (n_points,): with the errors of the clock.
        self.time: FloatArray = columns[cast(str, table.time)]
        # The row at each position in each run, (n_positions, n_runs); short runs repeat their last row.
        longest = max(len(own) for own in table.rows_by_run)
        filled = [np.append(own, np.full(longest - len(own), own[-1])) for own in table.rows_by_run]
        self.rows: IntArray = np.stack(filled, axis=1)
        self.delays = {e.form.late: e.values["tau_s"] for e in effects if e.form.late}
        # Dry friction and bounds, each with its strength or level.
        hard = (e for e in effects if e.form.sticks or e.form.stops)
        self.hard = [(e.form, float(e.values["a" if e.form.sticks else "level"])) for e in hard]

    def solve(self) -> dict[str, FloatArray]:
        first = self.rows[0]
        starts = (self.parameters[each] if isinstance(each, str) else each for each in self.law.start.values())
        s = np.array([np.broadcast_to(np.asarray(v)[first] if np.ndim(v) else v, len(first)) for v in starts])
        for form, level in self.hard:
            if form.stops:
                k = self.names.index(form.target)
                s[k] = np.minimum(s[k], level)
        kept = [s]
        for k in range(len(self.rows) - 1):
            if self.hard:
                s = np.stack([self._through_events(s[:, j], k, j) for j in range(len(first))], axis=1)
            else:
                s = self._through_gap(s, k)
            kept.append(s)
        out = {name: np.empty(len(self.table)) for name in self.names}
        for name, values in zip(self.names, np.stack(kept, axis=2), strict=True):
            for own, of_run in zip(self.table.rows_by_run, values, strict=True):
                out[name][own] = of_run[: len(own)]
        return out

    def _inputs_in_gap(self, k: int, runs: Any = slice(None)) -> Callable[[float], tuple[dict[str, Any], Instants]]:
        """Return a function from a share of the gap after position k to the parameters by name and `Instants` there."""
        first, here, there = (self.rows[at, runs] for at in (0, k, k + 1))
        printed, run = self.table.t, self.table.run[here]
        uses = (column for e in self.effects for column in e.form.uses)
        ends = {}
        for name in dict.fromkeys((*self.kind.drives, *uses)):
            if name not in self.delays:
                values = self.columns[name]
                holds = name in self.kind.drives and not self.law.linear
                ends[name] = (values[here], 0.0 if holds else values[there] - values[here])
        base = {name: v[here] if np.ndim(v) else v for name, v in self.parameters.items()}
        varying = [(e.form, e.values) for e in self.effects if e.form.side == "parameter"]

        def at(share: float) -> tuple[dict[str, Any], Instants]:
            u: dict[str, Any] = {name: low + share * rise for name, (low, rise) in ends.items()}
            u[cast(str, self.table.time)] = self.time[here] + share * (self.time[there] - self.time[here])
            t = printed[here] + share * (printed[there] - printed[here])
            for name, tau in self.delays.items():  # constant before a run
                column, u[name] = self.columns[name], np.empty(len(run))
                for j, number in enumerate(run):
                    own = np.flatnonzero(self.table.run == number)
                    t_own, then = printed[own], t[j] - tau
                    if self.law.linear:
                        u[name][j] = np.interp(then, t_own, column[own])
                    else:
                        last = max(int(np.searchsorted(t_own, then + 1e-12, side="right")) - 1, 0)
                        u[name][j] = column[own[last]]
            now = Instants(t, t - printed[first], u, run, np.zeros(1))
            p = dict(base)
            for form, numbers in varying:
                p[form.target] = p[form.target] + form.act(now, numbers)
            return p, now

        return at

    def _rates(self, s: FloatArray, p: Mapping[str, Any], now: Instants) -> dict[str, Any]:
        by_name = dict(zip(self.names, s, strict=True))
        out = self.law.rates(by_name, p, now.u)
        for e in self.effects:
            if e.form.side == "rate" and not (e.form.sticks or e.form.stops):
                out[e.form.target] = out[e.form.target] + e.form.act(by_name, now, e.values)
        return out

    def _intervals(self, k: int) -> Iterator[tuple[float, float]]:
        """Yield the intervals, as shares of the gap after position k, between the discontinuities of any run."""
        begin, gap = self.table.t[self.rows[k]], self.table.t[self.rows[k + 1]] - self.table.t[self.rows[k]]
        moments = [np.ravel(e.form.breaks(e.values)) for e in self.effects if e.form.breaks is not None]
        moments += [self.table.t + tau for tau in self.delays.values()]
        inside: FloatArray = np.zeros(0)
        if moments:
            shares = (np.concatenate(moments)[:, None] - begin)[:, gap > 0] / gap[gap > 0]
            inside = np.unique(np.round(shares[(shares > 1e-9) & (shares < 1 - 1e-9)], 9))
        return ((a, b) for a, b in pairwise([0.0, *inside.tolist(), 1.0]) if b - a > _CLOSE)

    def _solved(self, slope: Callable[..., Any], begin: float, end: float, s: FloatArray, events: Any = None) -> Any:
        n_calls = 0

        def counted(share: float, y: FloatArray) -> Any:
            nonlocal n_calls
            n_calls += 1
            if n_calls > _MOST_CALLS:
                raise NotConvergedError(f"the law of the {self.kind.name} runs away, or is too stiff, between two rows")
            return slope(share, y)

        settings: Any = {"method": "DOP853", "rtol": _RTOL, "atol": _ATOL, "first_step": end - begin}
        solved = solve_ivp(counted, (begin, end), s, events=events, **settings)
        if not solved.success:
            raise NotConvergedError(f"the law of the {self.kind.name} cannot be solved: {solved.message}")
        return solved

    def _through_gap(self, s: FloatArray, k: int) -> FloatArray:
        gap, at = self.time[self.rows[k + 1]] - self.time[self.rows[k]], self._inputs_in_gap(k)
        intervals = list(self._intervals(k))

        def slope(share: float, flat: FloatArray) -> FloatArray:
            found = self._rates(flat.reshape(s.shape), *at(share))
            return np.stack([np.broadcast_to(found[name] * gap, len(gap)) for name in self.names]).ravel()

        # Slightly inside: a discontinuity at an end belongs to the other side.
        hair, flat = _HAIR if len(intervals) > 1 else 0.0, s.ravel()
        for low, high in intervals:
            flat = self._solved(slope, low + hair, high - hair, flat).y[:, -1]
        return np.asarray(flat.reshape(s.shape))

    def _through_events(self, s: FloatArray, k: int, j: int) -> FloatArray:
        """Integrate the states of run j, (n_states,), from position k to the next, locating events."""
        here, there = self.rows[k : k + 2, j]
        gap, at = self.time[there] - self.time[here], self._inputs_in_gap(k, slice(j, j + 1))
        place = [self.names.index(form.target) for form, _ in self.hard]

        def mode_of(form: Form, size: float, value: float, rate: float) -> int:
            """Return the direction of motion, 0 if it sticks; of a bound, 1 if the state is free, 0 if it is kept."""
            if form.stops:
                return 0 if value >= size and rate > 0 else 1
            return int(np.sign(value)) if value != 0 else int(np.sign(rate)) * (abs(rate) > size)

        def free_rates(share: float, y: FloatArray) -> dict[str, float]:
            return {name: float(np.ravel(v)[0]) for name, v in self._rates(y, *at(share)).items()}

        def end_of_mode(form: Form, size: float, mode: int, i: int) -> Any:

            def rate(x: float, y: FloatArray) -> float:
                return free_rates(x, y)[form.target]

            found: Any
            if mode == 0:
                found, direction = (lambda x, y: abs(rate(x, y)) - size, 1.0) if form.sticks else (rate, -1.0)
            elif form.sticks:
                found, direction = (lambda x, y: y[i] + mode * _REST), -float(mode)  # it may start from 0
            else:
                found, direction = (lambda x, y: y[i] - size), 1.0
            found.terminal, found.direction = True, direction
            return found

        for low, high in self._intervals(k) if gap > 0 else ():
            share, forced = low, dict[int, int]()
            for _ in range(_MOST_EVENTS):
                rates = free_rates(share, s)
                modes = [
                    forced.get(m, mode_of(form, size, s[i], rates[form.target]))
                    for m, ((form, size), i) in enumerate(zip(self.hard, place, strict=True))
                ]

                def slope(x: float, y: FloatArray, modes: list[int] = modes) -> FloatArray:
                    found = free_rates(x, y)
                    for (form, size), mode in zip(self.hard, modes, strict=True):
                        against = size * mode if form.sticks else 0.0
                        found[form.target] = 0.0 if mode == 0 else found[form.target] - against
                    return np.asarray(gap * np.array([found[name] for name in self.names]))

                ends = [end_of_mode(*f, mode, i) for f, mode, i in zip(self.hard, modes, place, strict=True)]
                solved = self._solved(slope, share, high, s, ends)
                s, share = solved.y[:, -1].copy(), float(solved.t[-1])
                if solved.status != 1 or share >= high:
                    break
                forced = {}
                for m, ((form, size), found, mode) in enumerate(zip(self.hard, solved.t_events, modes, strict=True)):
                    if found.size and mode != 0:  # at rest, or at the bound
                        s[place[m]] = 0.0 if form.sticks else size
                    elif found.size:  # breaks loose
                        forced[m] = int(np.sign(free_rates(share, s)[form.target])) if form.sticks else 1
            else:
                raise NotConvergedError(f"the law of the {self.kind.name} sticks and slips without end")
        return s
