"""A user's simulator over a table as an `Apparatus`: effects, covariates, held-out and next runs, words."""

from __future__ import annotations

import itertools
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from probewise._arrays import LAST_DIGITS, TINY, FloatArray, IntArray
from probewise.diagnosis.apparatus import MOST_ADVISED_READINGS, Apparatus, Candidate, PriorOdds, Words
from probewise.diagnosis.evidence import LEAST_ROWS, N_BLOCKS, Parts
from probewise.diagnosis.fit import Fit, Model, Null
from probewise.diagnosis.locate import Covariate
from probewise.diagnosis.words import join_names
from probewise.effects import Effect, Extent, LightEffect, NoiseEffect, noise
from probewise.effects.effect import TWICE
from probewise.recordings.plan import Plan, Recording
from probewise.systems import RunTable, Simulator, System
from probewise.systems.forms import (
    ReferenceFit,
    bind_forms,
    bind_proposals,
    has_value_per_run,
    jumps_at_row,
    names_in_definitions,
)
from probewise.systems.forms.modulations import time_since_start_of_run
from probewise.systems.table import covariate_of_column, unused_name

_LEAST_ROWS = 4
_MOST_RUNS = 4  # recorded runs to start from
_SPELT = {
    1 / 60_000: "ms millisecond milliseconds",
    1 / 60: "s sec second seconds",
    1.0: "min minute minutes",
    60.0: "h hr hour hours",
    1440.0: "d day days",
    10_080.0: "week weeks",
    43_830.0: "month months",
    525_960.0: "a yr year years",
}
_MINUTES = {unit: minutes for minutes, units in _SPELT.items() for unit in units.split()}
_A_READING = 1 / 60  # minutes, where no time tells how long one takes
_BREAK = 0.5  # minutes, before a run


def candidate_runs(table: RunTable, simulator: Simulator) -> list[Candidate]:
    """List the runs that could be recorded: recorded runs again, reversed, slower, or with a control moved otherwise.

    At most four recorded runs are taken, those that differ in their controls; without any, runs can only be repeated. A
    function of the time may hold for constant controls alone, as a step response does, and what is the same throughout
    each of several runs, such as a start, may have to be: only a control that varies in a recorded run does so again,
    or any control of a law's only run.
    """
    out, run = list[Candidate](), table.run or unused_name("run", table.columns)
    reading, settable = simulator.reading, [name for name in simulator.controls if name in table.covariates]
    ends = {k: (float(np.nanmin(table.covariates[k])), float(np.nanmax(table.covariates[k]))) for k in settable}
    varies = {name for name in settable for rows in table.rows_by_scan() if np.ptp(table.covariates[name][rows]) > 0}
    one_run = len(table.scan_names) == 1 and (simulator.law is not None or table.time is None)
    free = set(settable) if one_run else varies
    for rows in _rows_of_distinct_runs(table, settable):
        name = table.scan_names[int(table.scan[rows[0]])]
        kept = rows[:: -(-len(rows) // MOST_ADVISED_READINGS)]
        of = f"run {name}" if table.run is not None else "the rows"
        for kind, words, columns, slower in _variations_of_run(table, kept, ends, free, of):
            called = unused_name(f"{name} {kind}", table.scan_names)
            changed: dict[str, Any] = {**columns, run: np.full(len(kept), called)}
            if reading in table.columns:
                changed[reading] = np.full(len(kept), np.nan)
            if table.time is not None:
                time = table.time_s[kept]
                begin = time[0] if table.time_begins_anew else _next_start_time(table)
                changed[table.time] = _without_rounding_errors(begin + slower * (time - time[0]))
            taken, like = table.take(kept), {called: table.like.get(name, name)}  # parameters per run as in that run
            made = replace(taken, columns={**taken.columns, **changed}, run=run, like=like, first_row=len(table))
            unit = _minutes_of_time_unit(made, simulator.time_unit)
            minutes = len(made) * _A_READING if unit is None else float(np.ptp(made.time_s)) * unit
            out.append(Candidate(kind, words, cast(Plan, made), _BREAK + minutes))
    return out


def _variations_of_run(
    table: RunTable, rows: IntArray, ends: Mapping[str, tuple[float, float]], free: Container[str], of: str
) -> Iterator[tuple[str, str, Mapping[str, FloatArray], float]]:
    """Yield kind, words, the columns that are set, and how many times as long the run takes."""
    own = {name: table.covariates[name][rows] for name in ends}
    yield "again", f"take {of} again", {}, 1.0
    if not ends:
        return
    if any(np.ptp(values) > 0 for values in own.values()):
        words = f"take {of} with {join_names(list(ends))} in reverse order"
        yield "reversed", words, {k: v[::-1] for k, v in own.items()}, 1.0
    if table.has_varying_time:
        yield "slow", f"take {of} again, twice as slowly", {}, 2.0
    share = np.linspace(0.0, 1.0, len(rows))
    for name, (low, high) in ends.items():
        middle, span = 0.5 * (low + high), high - low
        shapes = {
            "up": ("swept from {low} to {high}", low + span * share),
            "down": ("swept from {high} to {low}", high + (low - high) * share),
            "up and down": ("swept from {low} to {high} and back", low + span * (1 - np.abs(2 * share - 1))),
            "steps": ("switched between {low} and {high}, twice", np.where(4 * share % 2 < 1, low, high)),
            "low": ("held at {low}", np.full(len(rows), low)),
            "middle": ("held at {middle}", np.full(len(rows), middle)),
            "high": ("held at {high}", np.full(len(rows), high)),
        }
        for kind, (said, values) in shapes.items():
            if np.ptp(values) > 0 and name not in free:
                continue
            if low < high:  # to a thousandth of the range or finer, so that they can be set; its ends stay
                rounded = np.round(values, int(np.ceil(3 - np.log10(span))))
                values = np.where((values == low) | (values == high), values, rounded)
            text = said.format(low=f"{low:.4g}", high=f"{high:.4g}", middle=f"{middle:.4g}")
            again = "" if name in free else "a new run like "
            yield f"{name} {kind}", f"take {again}{of} with {name} {text}", {name: values}, 1.0


def _without_rounding_errors(times: FloatArray) -> FloatArray:
    """Return times to twelve digits, as a person would write them."""
    return np.array([float(f"{time:.12g}") for time in times])


def _next_start_time(table: RunTable) -> float:
    """Return the time at which a run after a table starts: the median pause between runs later, or ten rows."""
    by_run = [table.time_s[rows] for rows in table.rows_by_scan()]
    between = [later[0] - earlier[-1] for earlier, later in itertools.pairwise(by_run)]
    gaps = np.concatenate([np.diff(time) for time in by_run])
    gap = float(np.median(gaps[gaps > 0])) if (gaps > 0).any() else 1.0
    apart = [pause for pause in between if pause > 0]
    return float(table.time_s.max()) + (float(np.median(apart)) if apart else 10 * gap)


def _rows_of_distinct_runs(table: RunTable, controls: Sequence[str]) -> list[IntArray]:
    """Return the row numbers of the first four runs, of four rows or more, that differ in their controls."""
    seen: dict[tuple[object, ...], IntArray] = {}
    size = {name: float(np.nanmax(np.abs(table.covariates[name]))) or 1.0 for name in controls}
    for rows in table.rows_by_scan():
        if len(rows) >= _LEAST_ROWS:
            own = tuple(np.round(table.covariates[name][rows] / size[name], 9).tobytes() for name in controls)
            seen.setdefault(own or (int(table.scan[rows[0]]),), rows)
    return list(seen.values())[:_MOST_RUNS]


def _minutes_of_time_unit(table: RunTable, time_unit: str) -> float | None:
    return None if table.time is None else _MINUTES.get(time_unit.strip().rstrip(".").lower())


ON_NOISE: tuple[LightEffect, ...] = (
    noise.signal_dependent_noise, noise.correlated_noise, noise.random_walk, noise.noise_per_run, noise.outliers,
    noise.dropouts, noise.quantisation, noise.drifting_noise,
)  # fmt: skip
_ALONG_ROWS = (noise.correlated_noise, noise.random_walk, noise.drifting_noise)
CALLS_OF_A_SEARCH = 8_000  # with what judging and sampling ask beyond it, some 10,000 in a diagnosis
_MOST_MULTIPLIED = 10  # factors of products, time included: 45 products; more would dilute the prior of each

# Of a term in a rate that is another state by definition, such as that of a position; of a jump at a row of a table
# that an input sorts; and of a curve of a column that drives the simulator, what is wrong with which has names of its
# physics (a bend, a dead zone). A slip may look like the first, a ramp may be recorded in order: so all stay possible,
# and their handicap is below the three nats that tell aliases apart.
_UNLIKELY = 0.1


@dataclass(frozen=True, eq=False)
class SimulatorApparatus(Apparatus):
    """The `Apparatus` of a simulator over a table; a first fit sets the scales of its effects."""

    about: ReferenceFit  # the system, its table, the first fit, and the sd of a reading
    left_out: tuple[NoiseEffect, ...] = ()  # the effects of readings that were left out: lost, or where the meter stops

    @property
    def system(self) -> System:
        """The simulator over the runs of the table."""
        return self.about.system

    @property
    def rows_are_in_order(self) -> bool:
        return self.about.rows_are_in_order

    @property
    def controls(self) -> tuple[str, ...]:
        return self.system.simulator.controls

    @property
    def takes_one_measurement_at_a_time(self) -> bool:
        # Without a column of runs a file is one run: a second one in next.csv would begin where the first ended, not
        # from `states` as it is planned, and a lag or a backlash would reach from one into the other.
        return self.system.simulator.run is None

    @property
    def words(self) -> Words:
        own, caller = self.system.simulator, self.system.caller
        facts = [("simulator", own.source or "given in Python")]
        if caller is not None:
            how = "for all samples at once" if caller.broadcasts else "for one sample after the other"
            facts.append(("calls of simulate", f"{caller.n_calls:,}, {how}"))
        covariates = {
            "time": own.time or "time",
            "row": "row number (from 0)",
            "level": f"predicted {own.reading}",
            "previous": f"change of predicted {own.reading} between rows",
        }
        return Words(
            null="the simulator",
            find_signal="record where the reading changes",
            settles_nothing="no rows like those of this table tell them apart",
            run="run",
            next_plan="next.csv",
            model="repaired.json",
            no_cure="more rows, or a run with other settings or in another order",
            covariates=covariates,
            own_names=frozenset({own.reading, *self.about.table.columns, *own.parameters, *self.about.states}),
            units={"time": own.time_unit, "level": "{reading}", "previous": "{reading}"},
            nothing_held_out="Nothing could be held out: that takes two runs of eight readings or more, or a single "
            "run with about 40.",
            facts=tuple(facts),
            tells_duration=_minutes_of_time_unit(self.about.table, own.time_unit) is not None,
        )

    def effects(self, recording: Recording, null: Null | None) -> dict[str, Effect]:
        extent = Extent.of(recording)
        kinds = [kind for kind in ON_NOISE if self.rows_are_in_order or kind not in _ALONG_ROWS]
        if recording.censored.any():  # a walk has no likelihood of readings at an end of the range
            kinds.remove(noise.random_walk)
        beside = (*(kind.for_extent(extent) for kind in kinds), *self.left_out)
        return bind_forms(self.about) | {effect.name: effect for effect in beside if effect is not None}

    def proposed_formulas(self) -> dict[str, Effect]:
        return bind_proposals(self.about)

    def user_effect_names(self, effects: Mapping[str, Effect]) -> frozenset[str]:
        return frozenset(effects.keys() & self.system.simulator.extra.keys())

    @property
    def evaluations_of_a_search(self) -> int:
        """Limit on the evaluations of a law's rates, of all samples and runs at once, in a search."""
        # At 15 to 20 microseconds each: about as many predictions of a long table as of a short one.
        return max(6_000 * len(self.about.table), 1_500_000)

    def refit_budget_share_spent(self) -> float:
        caller = self.system.caller
        if caller is None:
            return self.system.integrations.n_evaluations / self.evaluations_of_a_search
        # A simulate that knows no runs is called for one recording after the other.
        n_each = len(self.system.runs) if self.system.simulator.run is None else 1
        return 0.0 if caller.broadcasts else caller.n_calls / (n_each * CALLS_OF_A_SEARCH)

    def is_refit_budget_spent(self, share: float = 1.0) -> bool:
        over = self.refit_budget_share_spent() >= share
        counts = self.system.caller or self.system.integrations
        counts.cut_short |= over
        return over

    def prior_odds(self, effects: Mapping[str, Effect]) -> PriorOdds:
        curves = {f"curve:{name.removeprefix('input_gain:')}" for name in effects if name.startswith("input_gain:")}
        jumps = {name for name, form in effects.items() if jumps_at_row(form) and form.covariates[0] != "row"}
        return replace(
            PriorOdds.for_effects(effects),
            twice=TWICE,
            unlikely=names_in_definitions(self.about, effects) | jumps | curves,
            unlikely_weight=_UNLIKELY,
        )

    def covariates_and_predicted_slope(self, found: Fit, recording: Recording) -> tuple[list[Covariate], FloatArray]:
        table = cast(RunTable, recording.plan)
        usable = np.flatnonzero(recording.usable)
        by_row = self.covariate_values_by_name(found.model.predict(found.z[None, :])[0])
        pooled = {name: values[usable] for name, values in by_row.items() if name != "run"}
        if not self.rows_are_in_order:
            pooled["previous"] = np.zeros(len(usable))
            pooled.pop("row", None)
        out = []
        for name, values in pooled.items():
            there = np.flatnonzero(np.isfinite(values))
            if there.size > 1 and np.ptp(values[there]) > LAST_DIGITS * max(TINY, float(np.abs(values[there]).max())):
                out.append(Covariate(name, values[there], there))
        if len(table.scan_names) > 1:
            out.append(Covariate("run", table.scan[usable].astype(np.float64), np.arange(len(usable)), groups=True))
        return out, pooled["previous"]

    def multiplied_covariates(self, covariates: Sequence[Covariate]) -> list[Covariate]:
        # Columns with few values are settings or numbers of groups, whose product with another is the rarer mistake.
        columns = {"time", *map(covariate_of_column, self.about.table.covariates)}
        varied = [c for c in covariates if c.name in columns]
        chosen = sorted(varied, key=lambda c: -len(np.unique(c.values)))[:_MOST_MULTIPLIED]
        return [c for c in varied if c in chosen]

    def covariate_values_by_name(self, predicted: FloatArray) -> dict[str, FloatArray]:
        """Return every covariate by name at each row, (n_points,), for predictions (n_points,); the run is last."""
        table = self.about.table
        out = {"time": table.time_s} if table.has_varying_time else {"row": table.row_number}
        out |= {"level": predicted}
        out |= {covariate_of_column(name): v for name, v in self.system.simulator.inputs(table.covariates).items()}
        out |= {f"state:{name}": v for name, v in self.about.states.items()}
        out["previous"] = np.zeros(len(table))
        for rows in table.rows_by_scan():
            out["previous"][rows[1:]] = np.diff(predicted[rows])
        out["run"] = table.scan.astype(np.float64)
        return out

    def held_out_parts(self, recording: Recording) -> Parts:
        table, usable = cast(RunTable, recording.plan), recording.usable
        run = table.scan[usable]
        if np.sum(np.bincount(run) >= LEAST_ROWS) > 1:
            return run, table.scan_names
        n = int(usable.sum())
        part = np.minimum(np.arange(n) * N_BLOCKS // max(n, 1), N_BLOCKS - 1)
        return part, tuple(f"part {k + 1} of {N_BLOCKS}" for k in range(N_BLOCKS))

    def what_comes_next(self, recording: Recording) -> Parts | None:
        """Return the last fifth of the usable readings of each run as the one part to hold out; None without a time."""
        table = cast(RunTable, recording.plan)
        if not table.has_varying_time:
            return None
        run = table.scan[recording.usable]
        part = np.full(len(run), -1)
        for own in (np.flatnonzero(run == k) for k in np.unique(run)):
            part[own[len(own) - len(own) // N_BLOCKS :]] = 0
        return part, ("the last fifth",)

    def coordinates_of_new_run(self, model: Model) -> IntArray:
        names, of_run = list(self.system.marginals), {*self.system.nuisance_names}
        parameters = [k for k, name in enumerate(names) if name in of_run]
        values = [np.arange(model.n_params)[model.coordinate_slice(n)] for n in model.names if has_value_per_run(n)]
        return np.concatenate([np.array(parameters, dtype=np.int64), *values])

    def settings_of(self, plan: Plan) -> FloatArray:
        table = cast(RunTable, plan)
        columns = self.system.simulator.inputs(table.covariates).values()
        return np.asarray(np.nan_to_num(np.stack([*columns, time_since_start_of_run(table)], axis=1)))

    def candidate_measurements(
        self, plan: Plan, *, strides: Sequence[int] = (1,), level: FloatArray | None = None
    ) -> list[Candidate]:
        return candidate_runs(cast(RunTable, plan), self.system.simulator)

    def plan_of_alternatives(self, candidates: Sequence[Candidate], after: Plan) -> Plan:
        tables = [cast(RunTable, candidate.plan) for candidate in candidates]
        columns = {name: np.concatenate([table.columns[name] for table in tables]) for name in tables[0].columns}
        like = {name: other for table in tables for name, other in table.like.items()}
        return cast(Plan, replace(tables[0], columns=columns, like=like))

    def plan_of_sequence(self, candidates: Sequence[Candidate], after: Plan) -> Plan:
        recorded, out = cast(RunTable, after), list[Candidate]()
        for candidate in candidates:
            table = cast(RunTable, candidate.plan)
            if table.time is not None and not recorded.time_begins_anew and out:
                later = float(out[-1].plan.time_s[-1]) + _next_start_time(recorded) - float(recorded.time_s.max())
                table = table.with_columns(
                    {table.time: _without_rounding_errors(table.time_s - table.time_s[0] + later)}
                )
            out.append(replace(candidate, plan=cast(Plan, table)))
        return self.plan_of_alternatives(out, after)
