"""From parameters to noise-free readings: effects on inputs, parameters, rates and readings; laws are integrated.

SciPy's eighth-order method integrates all samples and runs together. Dry friction and bounds change the law at events;
a gap between rows that contains an event is integrated again, for one sample and run at a time, with event location.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from probewise._arrays import FloatArray, IntArray
from probewise.errors import NotConvergedError
from probewise.proof.systems.form import Form, FormWithParameters, Instants
from probewise.proof.systems.kind import SystemKind, SystemTable

_RTOL, _ATOL = 1e-8, 1e-10
_CHECKS = np.array([0.25, 0.5, 0.75, 1.0])  # shares of a gap at which events are checked
_REST = 1e-9  # share of a state's scale below which it is at rest
_MOST_CALLS = 600  # limit of evaluations between two rows; a step has twelve
_MOST_EVENTS = 200  # limit of events between two rows
_CLOSE = 1e-7  # share of a gap: closer events are merged


def solve_law(
    kind: SystemKind,
    rows: SystemTable,
    parameters: Mapping[str, FloatArray],
    columns: Mapping[str, FloatArray],
    effects: Sequence[FormWithParameters],
) -> dict[str, FloatArray]:
    """Solve a law: return every state by name at every row, (n_samples, n_points).

    `parameters`: by name, (n_samples or 1, 1 or n_points); `columns`: inputs after their effects, (n_samples or 1,
    n_points), including time; `effects`: forms on parameters and rates, and those that delay a column.
    """
    return _Integration(kind, rows, parameters, columns, effects).solve()


@dataclass(frozen=True, eq=False)
class _Integration:
    """The solution of a law for all samples and runs; parameters as of `solve_law`."""

    kind: SystemKind
    table: SystemTable
    parameters: Mapping[str, FloatArray]
    columns: Mapping[str, FloatArray]
    effects: Sequence[FormWithParameters]

    @cached_property
    def rows_by_position_and_run(self) -> IntArray:
        """Index of the row at each position in each run, (n_positions, n_runs); short runs repeat their last row."""
        longest = max(len(own) for own in self.table.rows_by_run)
        filled = [np.append(own, np.full(longest - len(own), own[-1])) for own in self.table.rows_by_run]
        return np.stack(filled, axis=1)

    @cached_property
    def n_samples(self) -> int:
        arrays = [*self.parameters.values(), *self.columns.values()]
        arrays += [np.atleast_2d(v) for _, numbers in self.effects for v in numbers.values()]
        return max(len(v) for v in arrays)

    @cached_property
    def _rows_by_run_number(self) -> dict[int, IntArray]:
        return {int(self.table.run[own[0]]): own for own in self.table.rows_by_run}

    @cached_property
    def delays(self) -> dict[str, FloatArray]:
        """Delay of each column that is delayed, by name, (n_samples or 1, 1)."""
        return {form.late: numbers["tau_s"] for form, numbers in self.effects if form.late}

    @cached_property
    def used_columns(self) -> tuple[str, ...]:
        """Names of the columns that the law or an effect uses."""
        uses = (column for form, _ in self.effects for column in form.uses)
        return tuple(dict.fromkeys((*self.kind.drives, *uses)))

    def initial_states(self) -> FloatArray:
        """Return the states at the first row of each run, (n_states, n_samples, n_runs)."""
        law = self.kind.law
        assert law is not None
        out = []
        for given in law.start.values():
            at = (
                self._at_first_rows(self.parameters[given]) if isinstance(given, str) else np.full((1, 1), float(given))
            )
            out.append(np.broadcast_to(at, (self.n_samples, self.rows_by_position_and_run.shape[1])))
        return np.array(out)

    def _at_first_rows(self, values: FloatArray) -> FloatArray:
        return values if values.shape[1] == 1 else values[:, self.rows_by_position_and_run[0]]

    def rate_inputs_in_gap(self, k: int, runs: Any = slice(None)) -> Callable[[float], tuple[dict[str, Any], Instants]]:
        """Return a function from a share of the gap after position k to the parameters by name and `Instants` there."""
        here, there = self.rows_by_position_and_run[k, runs], self.rows_by_position_and_run[k + 1, runs]
        first = self.rows_by_position_and_run[0, runs]
        law, time = self.kind.law, self.table.time
        assert law is not None
        assert time is not None
        t, printed = self.columns[time], self.table.t
        ends = {}
        for name in self.used_columns:
            if name in self.delays:
                continue
            values = self.columns[name]
            holds = name in self.kind.drives and not law.linear
            ends[name] = (values[:, here], 0.0 if holds else values[:, there] - values[:, here])
        run = self.table.run[here]
        base = {name: v if v.shape[1] == 1 else v[:, here] for name, v in self.parameters.items()}
        varying = [(form, numbers) for form, numbers in self.effects if form.side == "parameter"]

        def at(share: float) -> tuple[dict[str, Any], Instants]:
            u: dict[str, Any] = {name: low + share * rise for name, (low, rise) in ends.items()}
            u[time] = t[:, here] + share * (t[:, there] - t[:, here])
            now_t = (printed[here] + share * (printed[there] - printed[here]))[None, :]
            for name, tau in self.delays.items():
                u[name] = self._delayed_column(name, now_t - tau, run)
            now = Instants(now_t, now_t - printed[first], u, run, np.zeros(1))
            p: dict[str, Any] = dict(base)
            for form, numbers in varying:
                p[form.target] = p[form.target] + form.act(now, numbers)
            return p, now

        return at

    def _delayed_column(self, name: str, t: FloatArray, run: IntArray) -> FloatArray:
        """Return a column at times `t`, (n_samples, n_runs), held or linear as the law says; constant before a run."""
        law = self.kind.law
        assert law is not None
        column = self.columns[name]
        n_samples, shared = max(len(t), len(column)), len(column) == 1
        t, column = (np.broadcast_to(each, (n_samples, each.shape[1])) for each in (t, column))
        out = np.empty(t.shape)
        for j, number in enumerate(run):
            own = self._rows_by_run_number[int(number)]
            times = self.table.t[own]
            if law.linear and shared:
                out[:, j] = np.interp(t[:, j], times, column[0, own])
            elif law.linear:
                out[:, j] = [np.interp(at, times, values) for at, values in zip(t[:, j], column[:, own], strict=True)]
            else:
                before = np.clip(np.searchsorted(times, t[:, j] + 1e-12, side="right") - 1, 0, None)
                out[:, j] = column[np.arange(n_samples), own[before]]
        return out

    def rates(self, s: dict[str, Any], p: Mapping[str, Any], now: Instants) -> dict[str, Any]:
        """Return the rate of each state by name, with the effects on rates except dry friction and bounds."""
        law = self.kind.law
        assert law is not None
        out = law.rates(s, p, now.u)
        for form, numbers in self.effects:
            if form.side == "rate" and not (form.sticks or form.stops):
                out[form.target] = out[form.target] + form.act(s, now, numbers)
        return out

    def discontinuity_shares(self, k: int) -> list[float]:
        """Return sorted shares of the gap after position k: 0, the discontinuities of any sample or run, and 1."""
        here, there = self.rows_by_position_and_run[k], self.rows_by_position_and_run[k + 1]
        begin, gap = self.table.t[here], self.table.t[there] - self.table.t[here]
        moments = [form.breaks(numbers) for form, numbers in self.effects if form.breaks is not None]
        if self.delays:
            for tau in self.delays.values():
                moments.append((self.table.t[:, None] + np.ravel(tau)).ravel())
        if not moments:
            return [0.0, 1.0]
        joined = np.concatenate([np.ravel(m) for m in moments])
        shares = (joined[:, None] - begin)[:, gap > 0] / gap[gap > 0]
        inside = np.unique(np.round(shares[(shares > 1e-9) & (shares < 1 - 1e-9)], 9))
        return [0.0, *inside.tolist(), 1.0]

    def solve(self) -> dict[str, FloatArray]:
        """Return every state by name at every row, (n_samples, n_points)."""
        law = self.kind.law
        assert law is not None
        names, n_positions = list(law.start), len(self.rows_by_position_and_run)
        s = self.clipped_to_bounds(self.initial_states().copy(), names)
        kept = np.empty((*s.shape, n_positions))
        kept[..., 0] = s
        for k in range(n_positions - 1):
            s = self._integrate_gap(s, k, names)
            kept[..., k + 1] = s
        return self._states_at_rows(names, kept)

    def _integrate_gap(self, s: FloatArray, k: int, names: list[str]) -> FloatArray:
        """Integrate states, (n_states, n_samples, n_runs), from position k of all runs to the next position.

        A gap of a sample and run in which friction or a bound changes its mode is integrated again with events.
        """
        time = self.table.time
        assert time is not None
        t = self.columns[time]
        gap, at, hard = (
            t[:, self.rows_by_position_and_run[k + 1]] - t[:, self.rows_by_position_and_run[k]],
            self.rate_inputs_in_gap(k),
            self.friction_and_bound_forms,
        )

        def free_rates(share: float, y: FloatArray) -> dict[str, Any]:
            p, now = at(share)
            return self.rates(dict(zip(names, y, strict=True)), p, now)

        edges, begun = self.discontinuity_shares(k), s
        again = np.zeros(s.shape[1:], dtype=bool)
        for low, high in _intervals_between(edges):
            # Slightly inside: a discontinuity at an end belongs to the other side.
            hair = 1e-8 if len(edges) > 2 else 0.0
            begin, end = low + hair, high - hair
            at_begin = free_rates(begin, s) if hard else {}
            modes = [_stick_or_bound_mode(f, size, s[names.index(f.target)], at_begin[f.target]) for f, size in hard]

            n_calls = 0

            def slope(share: float, flat: FloatArray, modes: Any = modes, shape: Any = s.shape) -> FloatArray:
                nonlocal n_calls
                n_calls += 1
                if n_calls > _MOST_CALLS:
                    raise NotConvergedError(
                        f"the law of the {self.kind.name} runs away, or is too stiff, between two rows"
                    )
                found = free_rates(share, flat.reshape(shape))
                for (form, size), mode in zip(hard, modes, strict=True):
                    found[form.target] = np.where(
                        mode == 0, 0.0, found[form.target] - (size * mode if form.sticks else 0.0)
                    )
                return np.stack([np.broadcast_to(found[name] * gap, shape[1:]) for name in names]).ravel()

            solved = solve_ivp(
                slope,
                (begin, end),
                s.ravel(),
                method="DOP853",
                rtol=_RTOL,
                atol=_ATOL,
                first_step=end - begin,
                t_eval=np.minimum(begin + (end - begin) * _CHECKS, end) if hard else None,
            )
            if not solved.success:
                raise NotConvergedError(f"the law of the {self.kind.name} cannot be solved: {solved.message}")
            for x, y in zip(solved.t, solved.y.T, strict=True) if hard else ():
                own = y.reshape(s.shape)
                rates = free_rates(x, own)
                for (form, size), mode in zip(hard, modes, strict=True):
                    again |= _mode_ended_mask(form, size, mode, own[names.index(form.target)], rates[form.target])
            s = solved.y[:, -1].reshape(s.shape)
        for i, j in np.argwhere(again):
            s[:, i, j] = self._integration_of_sample(int(i)).integrate_gap_with_events(begun[:, i, j], k, int(j), names)
        return s

    @property
    def friction_and_bound_forms(self) -> list[tuple[Any, FloatArray]]:
        """Pairs of a form of dry friction or bound and its strength or level, (n_samples or 1, 1)."""
        return [(f, np.atleast_2d(n["a" if f.sticks else "level"])) for f, n in self.effects if f.sticks or f.stops]

    def _states_at_rows(self, names: list[str], kept: FloatArray) -> dict[str, FloatArray]:
        out = {}
        for name, values in zip(names, kept, strict=True):
            found = np.empty((self.n_samples, len(self.table)))
            for j, own in enumerate(self.table.rows_by_run):
                found[:, own] = values[:, j, : len(own)]
            out[name] = found
        return out

    def _integration_of_sample(self, i: int) -> _Integration:
        def values_of_sample(v: Any) -> Any:
            v = np.atleast_2d(v)
            return v[i : i + 1] if len(v) > 1 else v

        return _Integration(
            self.kind,
            self.table,
            {name: values_of_sample(v) for name, v in self.parameters.items()},
            {name: values_of_sample(v) for name, v in self.columns.items()},
            [(form, {name: values_of_sample(v) for name, v in numbers.items()}) for form, numbers in self.effects],
        )

    def clipped_to_bounds(self, s: FloatArray, names: list[str]) -> FloatArray:
        """Return the initial states clipped to their upper bounds, in place."""
        for form, size in self.friction_and_bound_forms:
            if form.stops:
                k = names.index(form.target)
                s[k] = np.minimum(s[k], size)
        return s

    def integrate_gap_with_events(self, s: FloatArray, k: int, j: int, names: list[str]) -> FloatArray:
        """Integrate one sample's states, (n_states,), in run j from position k to the next, locating mode changes."""
        time = self.table.time
        assert time is not None
        t = self.columns[time]
        gap = float(t[0, self.rows_by_position_and_run[k + 1, j]] - t[0, self.rows_by_position_and_run[k, j]])
        at = self.rate_inputs_in_gap(k, slice(j, j + 1))
        hard = [(form, float(size[0, 0])) for form, size in self.friction_and_bound_forms]

        def free_rates(share: float, y: FloatArray) -> dict[str, float]:
            p, now = at(share)
            found = self.rates(dict(zip(names, y, strict=True)), p, now)
            return {name: float(np.ravel(v)[0]) for name, v in found.items()}

        edges = self.discontinuity_shares(k)
        for low, high in _intervals_between(edges):
            share, forced = low, dict[int, int]()
            for _ in range(_MOST_EVENTS):
                rates = free_rates(share, s)
                modes = [
                    forced.get(m, int(_stick_or_bound_mode(f, size, s[names.index(f.target)], rates[f.target])))
                    for m, (f, size) in enumerate(hard)
                ]

                def slope(x: float, y: FloatArray, modes: Any = modes) -> FloatArray:
                    found = free_rates(x, y)
                    for (form, size), mode in zip(hard, modes, strict=True):
                        found[form.target] = (
                            0.0 if mode == 0 else found[form.target] - (size * mode if form.sticks else 0.0)
                        )
                    return gap * np.array([found[name] for name in names])

                solved = solve_ivp(
                    slope,
                    (share, high),
                    s,
                    method="DOP853",
                    rtol=_RTOL,
                    atol=_ATOL,
                    first_step=high - share,
                    events=[
                        _event_of_mode_end(f, size, mode, names, free_rates)
                        for (f, size), mode in zip(hard, modes, strict=True)
                    ],
                )
                s, share = solved.y[:, -1].copy(), float(solved.t[-1])
                if solved.status != 1 or share >= high:
                    break
                forced = _modes_after_events(hard, modes, solved.t_events or [], s, names, partial(free_rates, share))
            else:
                raise NotConvergedError(f"the law of the {self.kind.name} sticks and slips without end")
        return s


def _modes_after_events(
    hard: Sequence[tuple[Form, float]],
    modes: Sequence[int],
    events: Sequence[FloatArray],
    s: FloatArray,
    names: list[str],
    free_rates: Callable[[FloatArray], dict[str, float]],
) -> dict[int, int]:
    """Set states that came to rest or a bound exactly there; return modes of forms that broke loose, by index."""
    forced: dict[int, int] = {}
    for m, ((f, size), found, mode) in enumerate(zip(hard, events, modes, strict=True)):
        if found.size and mode != 0:  # at rest, or at the bound
            s[names.index(f.target)] = 0.0 if f.sticks else size
        elif found.size:  # breaks loose
            forced[m] = int(np.sign(free_rates(s)[f.target])) if f.sticks else 1
    return forced


def _intervals_between(edges: Sequence[float]) -> Iterator[tuple[float, float]]:
    """Yield pairs of successive edges that are more than 1e-7 apart."""
    return ((low, high) for low, high in pairwise(edges) if high - low > _CLOSE)


def _stick_or_bound_mode(form: Form, size: Any, value: Any, rate: Any) -> Any:
    """Return the mode: for friction, the direction of motion, 0 if it sticks; for a bound, 1 if free, 0 if held."""
    if form.sticks:
        return np.where(value != 0, np.sign(value), np.where(np.abs(rate) > size, np.sign(rate), 0.0))
    return np.where((value >= size) & (rate > 0), 0, 1)


def _mode_ended_mask(form: Form, size: Any, mode: Any, value: Any, rate: Any) -> Any:
    """Return where a mode has ended: motion reversed, the force exceeds the friction, the bound is passed or left."""
    if form.sticks:
        return np.where(mode == 0, np.abs(rate) > size, value * mode < 0)
    return np.where(mode == 0, rate < 0, value > size)


def _event_of_mode_end(form: Form, size: float, mode: int, names: list[str], free_rates: Any) -> Any:
    """Return SciPy's event function of a mode's end: coming to rest, breaking loose, reaching or leaving a bound."""
    i = names.index(form.target)
    if form.sticks:
        if mode == 0:
            found, direction = (lambda x, y: abs(free_rates(x, y)[form.target]) - size), 1.0
        else:
            found, direction = (lambda x, y: y[i] + mode * _REST), -float(mode)  # it may start from 0
    elif mode == 0:
        found, direction = (lambda x, y: free_rates(x, y)[form.target]), -1.0
    else:
        found, direction = (lambda x, y: y[i] - size), 1.0
    found.terminal, found.direction = True, direction  # type: ignore[attr-defined]
    return found


@dataclass(frozen=True, eq=False)
class NoiseFreeResult:
    """Noise-free readings, (n_samples, n_points), and states by name of the same shape ({} for a static system)."""

    readings: FloatArray
    states: Mapping[str, FloatArray]


def simulate_noise_free(
    kind: SystemKind,
    rows: SystemTable,
    parameters: Mapping[str, FloatArray],
    effects: Sequence[FormWithParameters] = (),
) -> NoiseFreeResult:
    """Simulate a system without noise, at one set of parameters per sample.

    `rows`: the table of the rows to simulate; `parameters`: by name, (n_samples or 1, 1 or n_points) each; `effects`:
    forms, each with its parameters by name, (n_samples or 1, 1).
    """
    placed = [(form, {name: np.atleast_2d(v) for name, v in numbers.items()}) for form, numbers in effects]
    columns = {name: values[None, :] for name, values in rows.columns.items()}
    for form, numbers in placed:
        if form.side == "input" and not (form.late and kind.law is not None):
            columns = form.act(columns, rows, numbers)
    inner = [
        (form, n) for form, n in placed if form.side in ("parameter", "rate") or (form.late and kind.law is not None)
    ]
    n_samples = max(
        len(v) for v in (*parameters.values(), *columns.values(), *(v for _, n in placed for v in n.values()))
    )
    if kind.law is not None:
        states = solve_law(kind, rows, parameters, columns, inner)
        readings = np.asarray(kind.law.read(states, parameters, columns))
    else:
        states, p = {}, dict(parameters)
        now = Instants.at_rows(rows)
        for form, numbers in inner:
            p[form.target] = p[form.target] + form.act(now, numbers)
        readings = np.asarray(kind.formula(p, columns))
    readings = np.array(np.broadcast_to(readings, (n_samples, len(rows))))
    return NoiseFreeResult(apply_reading_effects(readings, rows, placed), states)


def apply_reading_effects(readings: FloatArray, rows: SystemTable, effects: Sequence[FormWithParameters]) -> FloatArray:
    """Return readings, (n_samples, n_points), with the effects of side "reading" applied in ascending `Form.order`."""
    for form, numbers in sorted((e for e in effects if e[0].side == "reading"), key=lambda e: e[0].order):
        readings = form.act(readings, rows, numbers)
    return readings
