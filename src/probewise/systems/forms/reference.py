"""The reference fit to which forms are bound: how its readings respond to a form sets the form's prior."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from probewise._arrays import ROUNDING, TINY, BoolArray, FloatArray, distinct_values, varies
from probewise._words import value_with_sd
from probewise.effects.effect import (
    ROWS_OF_A_SIDE,
    Act,
    Declared,
    Effect,
    Fixed,
    Say,
    in_words,
    sizes_inside,
)
from probewise.priors import LogUniform, Uniform
from probewise.sensor import Stage
from probewise.systems.calls import call_on_views
from probewise.systems.integrate import integrate_states
from probewise.systems.simulator import Simulator
from probewise.systems.system import System, columns_without_reading
from probewise.systems.table import RunTable

_BY_CHANCE = 1e-4  # probability below which sorted readings are no chance
_LOWER_PART = 0.4  # of a range: a ceiling may cut off more of it than a floor
_LEAST_CUT = 0.003  # of a range, that is cut off at least by what is looked for
_N_LEVELS = 10  # of either
_ROWS_OF_A_RUN = 3  # least rows per run on average
UNSEEN = 1e-7  # of the noise sd: a smaller change of the readings counts as none
_GROWTH = (1.0, 1e9, 1e18, 1e27, 1e36)  # of an amplitude, until the readings change
_NUDGE = 1e-3  # of a state's range
_NUDGE_OF_COLUMN = 1e-4  # of its spread or values: the step that tests whether it drives the readings
_N_COMPARED = 64  # states and parameters at which a rate is compared with another state
N_SIZES = 9  # in the bank of a form of one size
_LEAST, _MOST = 0.05, 1e4  # rms change in noise sds between which sizes without an amplitude are searched


def flag(number: int, odds: float = 1.0) -> tuple[float, Fixed]:
    """Return the value of a parameter that distinguishes variants of a form, 0, 1 or 2 to 1e-9, and its prior."""
    value = number - 0.5 * ROUNDING if number else 0.5 * ROUNDING
    return value, Fixed(value - 0.5 * ROUNDING, value + 0.5 * ROUNDING, odds)


def period_with_sd(frequency: float, sd: float, time_unit: str) -> str:
    """Return the period of a frequency, per `time_unit`, with its sd to first order, as `value_with_sd` does."""
    return value_with_sd(1 / frequency, sd / frequency**2, time_unit)


def chance_of_sorted_readings(simulator: Simulator, table: RunTable) -> float:
    """Return the probability that readings in rows of equal columns are in order by chance; 1 if they are in none.

    It is 1 too where a time was recorded, where equal rows are apart, and where readings rise or fall along all rows.
    """
    readings = table.columns.get(simulator.reading, np.array(""))
    if table.has_varying_time or readings.dtype != np.float64:
        return 1.0
    codes = [  # a number for each cell, the same for cells that are equal but for rounding
        np.where(np.isfinite(values), np.searchsorted(distinct_values(values), values, side="right"), 0)
        if values.dtype == np.float64
        else np.unique(values, return_inverse=True)[1]
        for values in simulator.inputs(table.columns).values()
    ]
    group = np.unique(np.stack([*codes, np.zeros(len(table), dtype=np.int64)]), axis=1, return_inverse=True)[1].ravel()
    there = np.flatnonzero(np.isfinite(readings))
    n_changes = np.count_nonzero(np.diff(group[there]))
    if n_changes >= np.unique(group[there]).size:  # equal rows are apart: by a jump or a drift
        return 1.0
    sizes = np.bincount(group[there])
    ties = np.unique(np.stack([group[there], readings[there]]), axis=1, return_counts=True)[1]
    log_chance = np.log(2.0) - np.sum(gammaln(sizes + 1)) + np.sum(gammaln(ties + 1))
    whole = np.diff(readings[there])
    along = whole[np.diff(group[there]) == 0]  # equal rows are beside each other
    is_sorted = any(np.all(sign * along >= 0) and not np.all(sign * whole >= 0) for sign in (1.0, -1.0))
    return float(min(np.exp(log_chance), 1.0)) if is_sorted else 1.0


def rows_are_in_order(simulator: Simulator, table: RunTable) -> bool:
    """Return whether the order of rows may be that of recording: readings in equal rows are not sorted."""
    return chance_of_sorted_readings(simulator, table) > _BY_CHANCE


def note_on_row_order(simulator: Simulator, table: RunTable) -> tuple[str, ...]:
    """Return a note where rows are in no order of recording; else ()."""
    chance = chance_of_sorted_readings(simulator, table)
    if chance > _BY_CHANCE:
        return ()
    sorted_ = f"wherever the other columns are equal, {simulator.reading} is sorted, by chance once in "
    unasked = "nothing is asked that needs their order, such as a jump at a row, hysteresis or correlated noise"
    return (f"rows are in no order of recording: {sorted_}{1 / max(chance, TINY):.0e} tables; {unasked}",)


@dataclass(frozen=True, eq=False)
class Clipping:
    """A quantity that ends at a level, of this prior: a ceiling above `least_ceiling`, otherwise a floor.

    `tried` are the levels of the template bank, (n_levels,); at `nowhere` it is a ceiling without effect.
    """

    prior: Uniform
    least_ceiling: float
    tried: FloatArray
    nowhere: float

    def act(self, values: FloatArray, theta: FloatArray, table: RunTable) -> FloatArray:
        """Return values, (n_points,) or (n_samples, n_points), clipped at the level theta[:, :1]."""
        level = theta[:, :1]
        return np.where(level > self.least_ceiling, np.minimum(values, level), np.maximum(values, level))

    def says(self, what: str, unit: str = "") -> Say:
        """Return the sentence of a quantity."""
        ceiling, floor = (in_words(f"{what} {way} no further than {{0}}", unit) for way in ("rises", "falls"))
        return lambda mean, sd: (ceiling if mean[0] > self.least_ceiling else floor)(mean, sd)


def clipping_between(values: FloatArray) -> Clipping | None:
    """Return the clipping of some values at a level within their range, NaN aside; None if that is empty."""
    known = values[np.isfinite(values)]
    if not known.size or np.ptp(known) == 0:
        return None
    low, high = float(known.min()), float(known.max())
    span = high - low
    ceilings = high - span * np.geomspace(_LEAST_CUT, 0.97 * (1 - _LOWER_PART), _N_LEVELS)  # densest at the ends
    tried = np.append(ceilings, low + span * np.geomspace(_LEAST_CUT, 0.97 * _LOWER_PART, _N_LEVELS))
    return Clipping(Uniform(low, high), low + _LOWER_PART * span, tried, high + span)


_VALUES_OF_A_SIDE = 3  # at least, on either side of a switch


def switch_points(values: FloatArray) -> FloatArray:
    """Return the distinct values between which a switch has five rows and three values on either side, (n_points,)."""
    ordered, distinct = np.sort(values[np.isfinite(values)]), distinct_values(values)
    below = np.searchsorted(ordered, distinct, side="right")
    values_below = np.arange(1, len(distinct) + 1)
    least_rows = np.minimum(below, len(ordered) - below) >= ROWS_OF_A_SIDE
    least_values = np.minimum(values_below, len(distinct) - values_below) >= _VALUES_OF_A_SIDE
    at = np.flatnonzero(least_rows & least_values)
    return distinct[at[0] : at[-1] + 2] if at.size else distinct[:0]


@dataclass(frozen=True, eq=False)
class StoredFit:
    """The part of a reference fit that rebinding needs: its table, and predicted readings and states, (n_points,) each.

    `sd` is the noise sd of a reading, by which outlying readings are told where a bend gets its ends. `held` are the
    columns that the model holds constant from row to row.
    """

    table: RunTable
    predicted: FloatArray
    sd: float
    states: Mapping[str, FloatArray] = field(default_factory=dict)
    held: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ReferenceFit:
    """The fit to which forms are bound: standard-normal coordinates `z` (n_params,), and the noise sd of a reading.

    A form of typical size changes its readings by one sd (rms), so that no quantity needs a declared range. `misfit` is
    the rms of the fit's residuals in sds: amplitudes may be larger by this factor. Where the fit is `known` by what was
    stored of it, nothing is simulated, every form counts as visible, and amplitudes of priors are arbitrary.
    """

    system: System
    table: RunTable
    z: FloatArray
    sd: float
    misfit: float = field(default=1.0, kw_only=True)
    known: StoredFit | None = field(default=None, kw_only=True)

    @cached_property
    def rows_are_in_order(self) -> bool:
        """Whether the order of the table's rows may be that of recording."""
        return rows_are_in_order(self.system.simulator, self.table)

    @cached_property
    def theta(self) -> FloatArray:
        """Parameters of the fit, (1, n_params)."""
        return self.system.theta(self.z[None, :])

    @cached_property
    def predicted(self) -> FloatArray:
        """Readings that the fit predicts, (n_points,), without noise and effects."""
        chain = self.system.chain(self.table, ())
        return chain.predict(self.theta, self.table)[0] if self.known is None else self.known.predicted

    @cached_property
    def _parameters_and_columns(self) -> tuple[dict[str, FloatArray], dict[str, NDArray[Any]]]:
        columns = columns_without_reading(self.system.simulator, self.table)
        return self.system.parameters(self.theta, self.table), columns

    @cached_property
    def states(self) -> Mapping[str, FloatArray]:
        """Each state at the rows, (n_points,), by name; none without a law."""
        law = self.system.simulator.law
        if self.known is not None or law is None:
            return {} if self.known is None else self.known.states
        found = integrate_states(law, self.system.steps(self.table), *self._parameters_and_columns)
        return {state: values[0] for state, values in found.items()}

    def _rates(self, *given: Mapping[str, Any]) -> Mapping[str, Any]:
        law = self.system.simulator.law
        assert law is not None
        with np.errstate(all="ignore"):
            rates: Mapping[str, Any] = call_on_views(law.rates, *given)
        return rates

    @cached_property
    def states_with_rates_by_definition(self) -> frozenset[str]:
        """States whose rate is another state whatever the parameters and columns, as that of an angle is the speed.

        Rates are compared at parameters drawn from their priors, states anywhere within twice the fit's range and rows.
        """
        if self.system.simulator.law is None or len(self.states) < 2:
            return frozenset()
        n, rng = _N_COMPARED, np.random.default_rng(0)
        rows, z = rng.integers(len(self.table), size=n), rng.standard_normal((n, self.theta.shape[1]))
        by_row = self.system.parameters(self.system.theta(z), self.table)
        p = {name: np.broadcast_to(v, (n, len(self.table)))[np.arange(n), rows][:, None] for name, v in by_row.items()}
        u = {name: values[rows][:, None] for name, values in self._parameters_and_columns[1].items()}
        spans = {name: 2 * np.abs(values).max() or 1.0 for name, values in self.states.items()}
        s = {name: span * rng.uniform(-1, 1, (n, 1)) for name, span in spans.items()}
        try:
            rates = self._rates(s, p, u)
        except Exception:  # a user's function may refuse states that no reading asks for
            return frozenset()
        pairs = ((state, s[other]) for state, other in permutations(s, 2))
        return frozenset(name for name, other in pairs if np.array_equal(np.broadcast_to(rates[name], (n, 1)), other))

    def state_drives_rate(self, state: str, other: str) -> bool:
        """Return whether the rate of the state `other` depends on `state` at some row of the table."""
        if self.system.simulator.law is None or self.known is not None:  # it matters to priors only
            return False
        there = {name: values[None, :] for name, values in self.states.items()}
        nudged = there | {state: there[state] + _NUDGE * np.ptp(there[state])}
        apart = np.subtract(*(self._rates(s, *self._parameters_and_columns)[other] for s in (nudged, there)))
        return bool(np.any(np.abs(apart) > 0))

    @cached_property
    def varying_columns(self) -> dict[str, FloatArray]:
        """Columns of numbers that vary, (n_points,), by name, except the reading and its declared sd."""
        columns = self.system.simulator.inputs(self.table.covariates)
        return {name: values for name, values in columns.items() if varies(values)}

    @cached_property
    def driving_columns(self) -> tuple[str, ...]:
        """Names of the columns, except time, that the simulated readings depend on."""

        def drives(name: str, values: FloatArray) -> bool:
            def shifted(value: Any, theta: FloatArray, table: RunTable) -> Any:
                return {**value, name: value[name] + theta}

            def scaled(value: Any, theta: FloatArray, table: RunTable) -> Any:
                return {**value, name: value[name] * (1 + theta)}

            tried = (shifted, _NUDGE_OF_COLUMN * float(np.nanstd(values))), (scaled, _NUDGE_OF_COLUMN)
            changes = [self.rms_change_in_sds(Stage.INPUT, act, np.array([[size]])) for act, size in tried]
            return max(float(change[0]) for change in changes) > 0

        return tuple(name for name, values in self.varying_columns.items() if drives(name, values))

    @cached_property
    def stored(self) -> StoredFit:
        """The part of this fit from which its forms can be bound again."""
        held = (name for name in self.driving_columns if self.is_held_between_rows(name))
        return self.known or StoredFit(self.table, self.predicted, self.sd, self.states, tuple(held))

    @cached_property
    def has_reading(self) -> BoolArray:
        """Mask of the rows with a reading, (n_points,); of all rows, where none has one."""
        there = np.isfinite(self.table.columns[self.system.simulator.reading])
        return there if there.any() else np.ones_like(there)

    @property
    def can_fit_value_per_run(self) -> bool:
        """Whether there are several runs, with at least three rows each on average."""
        n_runs = len(self.table.scan_names)
        return n_runs > 1 and (self.known is not None or len(self.table) >= _ROWS_OF_A_RUN * n_runs)

    @property
    def time_unit(self) -> str:
        """Unit of time."""
        return self.system.simulator.time_unit

    @property
    def reading_unit(self) -> str:
        """Unit of a reading."""
        return self.system.simulator.unit

    @property
    def duration(self) -> float:
        """Range of the times of the rows, in the unit of time; 1 if no time passes."""
        return float(np.ptp(self.table.time_s)) or 1.0

    def is_held_between_rows(self, column: str) -> bool:
        """Return whether the model holds a column until the next row, so that a value acts on later readings only."""
        if self.known is not None:
            return column in self.known.held
        law = self.system.simulator.law
        if law is not None and law.hold == "linear":
            return False
        rows = max(self.table.rows_by_scan(), key=len)
        there = np.zeros(len(self.table))
        there[rows[len(rows) // 2]] = _NUDGE * float(np.nanstd(self.table.covariates[column]))
        change = self.change_of_readings(
            Stage.INPUT, lambda value, theta, table: {**value, column: value[column] + theta * there}, np.ones((1, 1))
        )[0]
        return bool(np.any(change[rows] != 0) and not np.any(change[there > 0]))

    def rms_change_in_sds(self, stage: Stage, act: Act, settings: FloatArray) -> FloatArray:
        """Return the rms change of the readings by `act` in noise sds, (n_settings,); not finite if they diverge."""
        if self.known is not None:
            return np.ones(len(settings))
        with np.errstate(over="ignore", invalid="ignore"):  # a setting may carry a law away: it is not finite
            return np.asarray(np.sqrt(np.mean(self.change_of_readings(stage, act, settings) ** 2, axis=1)) / self.sd)

    def change_of_readings(self, stage: Stage, act: Act, settings: FloatArray) -> FloatArray:
        """Return the readings' change, (n_settings, n_points), by `act` with parameters (n_settings, n_params)."""
        priors = dict.fromkeys(map(str, range(settings.shape[1])), Uniform(0.0, 1.0))  # it is not used
        trial = Effect("trial", stage, priors, (), (), act, settings, lambda mean, sd: "", amplitudes=())
        chain = replace(self.system.chain(self.table, ()), effects=(trial,))
        theta = np.concatenate([np.repeat(self.theta, len(settings), axis=0), settings], axis=1)
        return np.asarray(chain.predict(theta, self.table) - self.predicted)

    def _typical_amplitude(self, form: Effect, guess: float) -> float:
        """Find the amplitude at which the readings change by one sd (median over entries); 0 if they do not change."""
        settings, amplitudes = form.entries.reshape(-1, form.entries.shape[-1]), list(form.amplitudes)
        settings = settings[:: max(len(settings) // 16, 1)].copy()
        settings[:, amplitudes] *= guess
        # In the unit of a column or a time a term may be minute. What is added to a reading, or to its gain, is
        # proportional at any amplitude; elsewhere a larger one could act where a small one does not.
        for times in _GROWTH if form.stage in (Stage.OFFSET, Stage.GAIN) else (1.0,):
            larger = settings.copy()
            larger[:, amplitudes] *= times
            rms = self.rms_change_in_sds(form.stage, form.apply, larger)
            rms = rms[np.isfinite(rms)]
            if rms.size and rms.max() > UNSEEN:
                return times * guess / float(np.median(rms[rms > UNSEEN]))
        return 0.0

    def form(
        self,
        name: str,
        stage: Stage,
        parameters: Declared,
        covariates: tuple[str, ...],
        act: Act,
        says: Say,
        entries: FloatArray | None = None,
        *,
        guess: float | None = None,
        typical: float | None = None,
        kind: type[Effect] = Effect,
        **more: Any,
    ) -> Iterator[Effect]:
        """Yield `Effect.declared` of amplitudes of a typical size; none if it is without effect.

        Unless that is given, it is found from `guess`, by default a noise sd: an amplitude so small that the readings
        change in proportion.
        """
        form = kind.declared(name, stage, parameters, covariates, act, says, entries, **more)
        if not form.amplitudes:
            yield form
            return
        if typical is None:
            typical = self._typical_amplitude(form, self.sd if guess is None else guess)
        if np.isfinite(typical) and typical > 0:
            yield form.of_typical_size(typical, misfit=self.misfit)

    def sized(
        self, name: str, stage: Stage, size: tuple[str, str], covariates: tuple[str, ...], act: Act, says: Say,
        tried: FloatArray, **more: Any,
    ) -> Iterator[Effect]:  # fmt: skip
        """Yield a form of one size, of this name and unit, without a sign; none if none of those `tried` is plausible.

        Its prior is log-uniform over those that change the readings by 0.05 to 10,000 sds (rms), the latter times a
        misfit above 1; if one alone does, up to the next.
        """
        prior = self.log_uniform_size_prior(stage, act, tried)
        if prior is not None:
            entries, (parameter, unit) = sizes_inside(prior, N_SIZES, 1.2)[:, None, None], size
            own = (name, stage, {parameter: (prior, unit)}, covariates, act, says, entries)
            yield from self.form(*own, absent={0: 0.0}, **more)

    def log_uniform_size_prior(self, stage: Stage, act: Act, tried: FloatArray) -> LogUniform | None:
        """Return the prior of `sized`; None if no size is plausible."""
        rms = self.rms_change_in_sds(stage, act, tried[:, None])
        there = np.flatnonzero(np.isfinite(rms) & (rms > _LEAST) & (rms < _MOST * max(self.misfit, 1.0)))
        if not there.size:
            return None
        first, last = int(there[0]), int(there[-1])
        low, high = float(tried[first]), float(tried[last if last > first else min(last + 1, len(tried) - 1)])
        return LogUniform(low, high) if low < high else None
