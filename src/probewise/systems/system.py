"""A simulator over the runs of a table as a model without effects (null model), and its chain with effects."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from probewise._arrays import FloatArray, IntArray
from probewise.effects import Effect
from probewise.errors import ParameterError, ProbewiseError, require
from probewise.priors import Marginal, Product
from probewise.recordings.plan import masks_of_readings_at_ends
from probewise.sensor import AnyEffect, Stage
from probewise.sensor.stages import effects_with_columns, parameter_names_of_effects
from probewise.systems.calls import Caller, take_samples, user_function_error
from probewise.systems.integrate import (
    Integrations,
    evaluations_per_step,
    integrate_from_known_trajectories,
    integrate_states,
)
from probewise.systems.law import LawWithEffects, Steps, readings_of_states, steps_for_table
from probewise.systems.simulator import Columns, Law, Simulator, Values
from probewise.systems.table import LARGEST_IN_FIT, RunTable, relative_sds_of_column

_N_STARTS = 8
_FEW = 0.5  # share of a table's rows up to which these alone are predicted: below it, that saves time
_N_SETTINGS = 6  # of an effect, from the first of its bank on, that are tried
_N_TRIED = 3  # prior points for the trial calls that determine how a function can be called
_MOST_STEPS_GIVEN = 100_000  # over the longest run by a person's max_step_s: the trial integrations alone take a minute
_MOST_STEPS = 4096  # integration steps over the longest run, in addition to one per row
_CHEAPER = 2.0  # evaluations of the explicit method for one of a linearly implicit one, from which that is taken
_CONVERGING = 4.0  # factor by which halving the step reduces the change at least, if the law is smooth


@dataclass(frozen=True, eq=False)
class System:
    """A null model, without effects: a simulator with one value of each `per_run` parameter for every run.

    Parameters
    ----------
    simulator, runs
        The user's simulator, and the names of the runs.
    max_step, stiff
        Largest integration step, in the unit of time, if there is a law; and whether it is integrated by a linearly
        implicit method.
    caller
        Caller of `simulate`, if there is no law.
    first
        Standard-normal coordinates of an earlier fit, (n_params,), from which fits start.
    integrations
        Counts of a law's evaluations and failures, and its trajectories, from which nearby ones are solved.
    limited
        Whether predictions are limited to the declared range of the instrument.
    slack
        Distance within the range, in the unit of the readings, from which noise may carry a reading to an end. For a
        reading at an end, a prediction within this distance counts as beyond the end.
    differences
        Step of each standard-normal coordinate for differences, (n_params,), or of all.
    parts
        Parts of tables, by table and rows, and what predicts these rows alone (`part_that_predicts`).
    """

    simulator: Simulator
    runs: tuple[str, ...]
    max_step: float = np.inf
    stiff: bool = False
    caller: Caller | None = None
    first: FloatArray | None = None
    integrations: Integrations = field(default_factory=Integrations)
    limited: bool = True
    slack: float = 0.0
    differences: float | FloatArray = 1e-5
    parts: dict[Any, Any] = field(default_factory=dict, repr=False)

    # It has no SSF, and effects are screened about its fit.
    n_gaussians: ClassVar[int] = 0
    effective_n_gaussians: ClassVar[int] = 0
    ssf_in_words: ClassVar[str] = ""
    has_exchangeable_gaussians: ClassVar[bool] = False
    may_be_far_off: ClassVar[bool] = False

    @classmethod
    def of(cls, simulator: Simulator, table: RunTable, *, stiff: bool = False) -> System:
        """Build the system for the runs of a table; find how the simulator can be called, or whether its law works.

        Raises
        ------
        ParameterError
            If a column that the simulator names is missing, the table has no column besides the reading, no reading is
            finite at any trial point of the prior, or another call with the same parameters returns other readings.
        ShapeError
            If `simulate` or `observe` does not return one reading per row.
        FileError
            If `simulate` raises an error at a trial call and no other call gives a finite reading, or a law raises at
            every one.
        """
        declared, taken = simulator.noise.sd, (simulator.reading, simulator.time, simulator.run)
        is_sd = not isinstance(declared, str) or declared in table.covariates
        require(is_sd, 'noise["sd"]', declared, f"a number, or a column of numbers: {', '.join(table.covariates)}")
        settable = ", ".join(name for name in table.columns if name not in taken) or "this table has none"
        for name in simulator.controls:
            allowed = f"a column that the table has and that can be set: {settable}"
            require(name in table.columns and name not in taken, "controls", name, allowed)
        columns, allowed = columns_without_reading(simulator, table), "a column besides the reading, such as the time"
        require(columns, "columns", list(table.columns), f"{allowed} or the number of each row")
        bare = cls(simulator, table.scan_names)
        starts = bare.theta(bare.starts)
        for name, values in zip(bare.marginals, starts.T, strict=True):
            value = float(values[np.argmax(np.abs(values))])  # inf where the prior is wider than floats
            require(abs(value) <= LARGEST_IN_FIT, name, value, f"a prior with magnitudes up to {LARGEST_IN_FIT:g}")
        if simulator.law is not None:
            step = simulator.law.max_step_s or table.median_gap
            longest = max(float(np.ptp(table.time_s[rows])) for rows in table.rows_by_scan())
            allowed = f"{longest / _MOST_STEPS_GIVEN:.1g} or more: {_MOST_STEPS_GIVEN:,} steps over the longest run"
            require(longest <= step * _MOST_STEPS_GIVEN, "max_step_s", step, allowed)
            system = replace(bare, max_step=step, stiff=stiff)
            system._require_working_law(simulator.law, table)
            return system
        assert simulator.simulate is not None
        if simulator.run is None:  # it is called for one recording after the other
            cells = [np.isfinite(values) for values in table.covariates.values()]
            table = table.take(max(table.rows_by_scan(), key=lambda rows: sum(int(c[rows].sum()) for c in cells)))
        columns, samples = columns_without_reading(simulator, table), starts[:_N_TRIED]
        own = (simulator.simulate, bare.parameters(samples, table), columns)
        try:
            caller = Caller.from_trial_calls(*own, per_run=simulator.per_run, broadcasts=simulator.vectorized)
        except ProbewiseError:
            raise
        except Exception as error:
            raise user_function_error("simulate", error, simulator, columns) from error
        return replace(bare, caller=caller)

    def _require_working_law(self, law: Law, table: RunTable) -> None:
        """Raise FileError if a law raises at all points that are tried, ParameterError if no reading is finite."""
        columns, readings, wrong = columns_without_reading(self.simulator, table), list[FloatArray](), None
        for z in self.starts:
            try:
                parameters = self.parameters(self.theta(z[None, :]), table)
                with warnings.catch_warnings():
                    warnings.simplefilter("error", np.exceptions.ComplexWarning)  # of rates that are no real numbers
                    states = integrate_states(law, self.steps(table), parameters, columns)
                readings.append(readings_of_states(law, states, parameters, columns))
            except ProbewiseError:
                raise
            except Exception as error:
                wrong = wrong or error
        if not readings and wrong is not None:
            raise user_function_error("rates", wrong, self.simulator, columns) from wrong
        found = f"not finite at any of the {len(self.starts)} points of the prior that were tried"
        allowed = "finite states and readings: narrower priors or a shorter max_step_s"
        require(np.isfinite(readings).any(), "rates, observe", found, allowed)

    def steps(self, table: RunTable) -> Steps:
        """Return the steps by which the law is integrated over a table."""
        return steps_for_table(table, self.max_step, stiff=self.stiff)

    @cached_property
    def marginals(self) -> dict[str, Marginal]:
        """Prior of each column of theta, by name: shared parameters, then `name[run]` for every run."""
        own = self.simulator
        out = {name: prior for name, prior in own.parameters.items() if name not in own.per_run}
        for name in own.per_run:
            out |= {f"{name}[{run}]": own.parameters[name] for run in self.runs}
        return out

    @cached_property
    def prior(self) -> Product:
        """Prior of all parameters."""
        return Product(self.marginals)

    def parameters(self, theta: FloatArray, table: RunTable) -> dict[str, FloatArray]:
        """Return parameters by name: (n_samples, 1), or (n_samples, n_points) for those per run.

        The user's own effects (`Simulator.extra`) are absent: at their `null`, (1, 1).
        """
        own, at, out = self.simulator, {name: k for k, name in enumerate(self.marginals)}, {}
        for name in own.parameters:
            if name in own.per_run:
                of_run = [at[f"{name}[{table.like.get(run, run)}]"] for run in table.scan_names]
                out[name] = theta[:, of_run][:, table.scan]
            else:
                out[name] = theta[:, at[name] : at[name] + 1]
        return out | {name: np.full((1, 1), extra.null) for name, extra in own.extra.items()}

    @property
    def n_params(self) -> int:
        """Number of parameters, each value per run counted."""
        return len(self.marginals)

    @property
    def nuisance_names(self) -> tuple[str, ...]:
        """Names of the parameters per run, `name[run]`, which apply to this table only."""
        return tuple(name for name in self.marginals if name not in self.simulator.parameters)

    @cached_property
    def starts(self) -> FloatArray:
        """Standard-normal coordinates to fit from, (n_starts, n_params): an earlier fit, or 0 and seven scattered."""
        if self.first is not None:
            return self.first[None, :]
        return np.concatenate([np.zeros((1, self.n_params)), self.scattered_points(_N_STARTS - 1)])

    def scattered_points(self, n: int) -> FloatArray:
        """Return points that cover the prior evenly, as standard-normal coordinates, (n, n_params).

        Roberts's sequence (additive recurrence by the root of x^(d+1) = x + 1) is uniform in any number of dimensions.
        """
        root = 2.0
        for _ in range(32):
            root = (1 + root) ** (1 / (self.n_params + 1))
        spread = (0.5 + np.outer(np.arange(1, n + 1), root ** -np.arange(1.0, self.n_params + 1))) % 1.0
        return np.asarray(ndtri(spread), dtype=np.float64)

    @property
    def least_readings(self) -> int:
        """Least number of readings for a fit: three per shared parameter, one per parameter of a run; at least 12."""
        n_own = len(self.simulator.per_run) * len(self.runs)
        return max(12, 3 * (self.n_params - n_own) + n_own)

    @property
    def predicts_in_bulk(self) -> bool:
        """Whether many samples cost little more than one: for a law, or a `simulate` that broadcasts."""
        return self.caller is None or self.caller.broadcasts

    @property
    def predicts_dearly(self) -> bool:
        """Whether predictions are worth sparing: of a law, and of a `simulate` that is called for each sample."""
        return self.caller is None or not self.caller.broadcasts

    def admits(self, effect: Effect) -> bool:
        """Return whether an effect acts at a stage of this system: False for one on rates without a law."""
        return effect.stage is not Stage.RATE or self.simulator.law is not None

    def part_that_predicts(self, rows: IntArray, table: Any, effects: Sequence[Effect]) -> tuple[Any, IntArray]:
        """Return a part of a table that suffices to predict some of its rows, and their numbers there.

        Few of many rows suffice if neither the simulator nor an effect looks at others: at trial points of the prior,
        and of each effect, these rows alone are then predicted as they are beside the others.
        """
        if self.caller is None or not self.caller.broadcasts or len(rows) > _FEW * len(table):
            return table, rows
        key = table, rows.tobytes(), self.slack
        if key not in self.parts:
            self.parts[key] = table.take(rows), {}
        part, alone = self.parts[key]
        for effect in (None, *effects):
            act = effect and effect.apply
            if act not in alone:
                alone[act] = self._predicts_alone(effect, rows, table, part)
            if not alone[act]:
                return table, rows
        return part, np.arange(len(rows))

    def _predicts_alone(self, effect: Effect | None, rows: IntArray, table: RunTable, part: RunTable) -> bool:
        """Return whether the simulator, or it with an effect, predicts some rows as `part` of a table as in it."""
        trial, theta = replace(self, caller=replace(cast(Caller, self.caller))), self.theta(self.starts)
        if effect is not None:
            settings = effect.entries.reshape(-1, effect.entries.shape[-1])
            settings = settings[:: max(len(settings) // _N_SETTINGS, 1)]
            theta = np.concatenate([np.resize(theta, (len(settings), theta.shape[1])), settings], axis=1)
        chain = trial.chain(table, () if effect is None else (effect,))
        try:
            whole, own = chain.predict(theta, table)[:, rows], chain.predict(theta, part)
        except Exception:  # a function that needs the whole table
            return False
        return bool(np.isfinite(whole).any()) and np.array_equal(whole, own, equal_nan=True)

    def theta(self, z: FloatArray) -> FloatArray:
        """Map standard-normal coordinates, (n_samples, n_params), to parameters of that shape."""
        return self.prior.from_unit_cube(ndtr(z))

    def chain(self, plan: Any, effects: Sequence[Effect], *, n_nodes: int = 0) -> SystemChain:
        """Return the chain of the system with effects, ordered by stage; the table and `n_nodes` are not used."""
        return SystemChain(self, tuple(sorted(effects, key=lambda e: (e.stage, e.name))))


def columns_without_reading(simulator: Simulator, table: RunTable) -> dict[str, NDArray[Any]]:
    """Return the columns passed to `simulate` and `rates`: all except the reading, which they predict."""
    return {name: values for name, values in table.columns_as_given.items() if name != simulator.reading}


@dataclass(frozen=True, eq=False)
class SystemChain:
    """A system with effects, applied in this order: input and clock, parameters, law, reading."""

    system: System
    effects: tuple[AnyEffect, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The system's parameters, then each effect's as "effect.parameter"."""
        return (*self.system.prior.names, *parameter_names_of_effects(self.effects))

    def predict(self, theta: FloatArray, plan: Any) -> FloatArray:
        """Return noise-free readings: theta (n_samples, n_params) -> (n_samples, n_points)."""
        return self.readings_from_simulated_view(self.simulated_view(theta, plan), theta, plan)

    def simulated_view(self, theta: FloatArray, plan: Any) -> FloatArray:
        """Simulate readings without the effects on readings, with all others: (n_samples, n_points)."""
        system = self.system
        columns = self._apply_stage(Stage.INPUT, columns_without_reading(system.simulator, plan), theta, plan)
        parameters = self._apply_stage(Stage.PARAMETER, system.parameters(theta, plan), theta, plan)
        caller, law = system.caller, system.simulator.law
        if caller is None:
            assert law is not None
            try:
                states = self._integrated_states(law, parameters, columns, theta, plan)
                readings = readings_of_states(law, states, parameters, columns)
            except ProbewiseError:
                raise
            except Exception:  # of the law, at some of the samples
                if len(theta) > 1:
                    return np.concatenate([self.simulated_view(one[None, :], plan) for one in theta])
                system.integrations.n_failed += 1
                return np.full((1, len(plan)), np.nan)
        elif system.simulator.run is not None or len(plan.scan_names) == 1:
            readings = caller(parameters, columns)
        else:  # one recording after the other: in `simulate`, written for one, a loop over rows would run on
            readings = np.empty((len(theta), len(plan)))
            for rows in plan.rows_by_scan():
                own = (
                    {name: v[..., rows] if np.shape(v)[-1] == len(plan) else v for name, v in values.items()}
                    for values in (parameters, columns)
                )
                readings[:, rows] = caller(*own)
        return np.array(np.broadcast_to(readings, (len(theta), len(plan))))

    def _integrated_states(
        self, law: Law, parameters: Values, columns: Columns, theta: FloatArray, plan: RunTable
    ) -> dict[str, FloatArray]:
        """Integrate the law with its effects; return every state at the rows, (n_samples, n_points), by name."""

        def law_and_inputs(samples: IntArray) -> tuple[LawWithEffects, dict[str, FloatArray], dict[str, NDArray[Any]]]:
            motion = self._apply_stage(Stage.RATE, LawWithEffects(law), theta[samples], plan)
            return motion, take_samples(parameters, samples), take_samples(columns, samples)

        steps, memory, n_own = self.system.steps(plan), self.system.integrations, self.system.n_params
        of = (self.system.runs, self.effects)
        return integrate_from_known_trajectories(law_and_inputs, steps, memory, effects=of, theta=theta, n_own=n_own)

    def readings_from_simulated_view(self, view: FloatArray, theta: FloatArray, plan: Any) -> FloatArray:
        """Return a result of `simulated_view` with the effects on readings applied, (n_samples, n_points).

        They are limited to the declared range, as by the instrument. Where a reading at an end was recorded, the limit
        is that reading, which may be rounded, and the prediction is moved towards it by `System.slack`. Where the
        recorded reading is within the range, it is not limited, so that one beyond the range counts as a misfit.
        """
        with np.errstate(all="ignore"):  # of readings that ran away: not finite, as they were
            for effect, columns in self._effects_with_theta_columns:
                if Stage.SEEN <= effect.stage <= Stage.SATURATION:
                    view = effect.apply(view, theta[:, columns], plan)
        noise = self.system.simulator.noise
        if not self.system.limited or np.isinf(noise.ends).all():
            return view
        low, high = map(np.array, noise.ends)
        recorded = plan.columns.get(self.system.simulator.reading, np.array(""))
        if recorded.dtype == np.float64:
            at_low, at_high = masks_of_readings_at_ends(recorded, *noise.ends, noise.step)
            slack = self.system.slack * (relative_sds_of_column(plan, noise.sd) if isinstance(noise.sd, str) else 1.0)
            view = view + slack * (1.0 * at_high - 1.0 * at_low)
            within = (low < recorded) & (recorded < high) & ~(at_low | at_high)
            low = np.where(within, -np.inf, np.where(at_low, recorded, low))
            high = np.where(within, np.inf, np.where(at_high, recorded, high))
        # A prediction that ran away stays as it is: not finite.
        return np.where(np.isfinite(view), np.clip(view, low, high), view)

    def _apply_stage(self, stage: Stage, value: Any, theta: FloatArray, plan: Any) -> Any:
        for effect, columns in self._effects_with_theta_columns:
            if effect.stage is stage:
                value = effect.apply(value, theta[:, columns], plan)
        return value

    @cached_property
    def _effects_with_theta_columns(self) -> list[tuple[AnyEffect, slice]]:
        return effects_with_columns(self.effects, self.system.n_params)


STANDS_STILL = 0.02  # noise sds, rms, that predictions may move by when the step of the integration is halved


def with_converged_step(
    system: System,
    table: RunTable,
    theta: FloatArray,
    effects: Sequence[Effect] = (),
    *,
    tolerance: float,
    or_finest: bool = False,
) -> System:
    """Return a system with a step so short that halving it changes predictions by a tolerance (rms) at most.

    Where a linearly implicit method needs less than half the evaluations, the system is `stiff`; one without a law is
    returned as it is. `theta` are parameters of the system and of the `effects` added to its law, (n_samples,
    n_params); samples without finite predictions do not count, unless half the step makes them finite. The `tolerance`
    is in the unit of a reading. With `or_finest`, the finest step within reach is returned, instead of an error, if
    predictions converge but still change by more. Raises ParameterError if they still change with 4,096 more steps than
    rows in the longest run.
    """
    if system.simulator.law is None:
        return system
    found: System | ParameterError
    try:
        found = _halved_until_still(system, table, theta, effects, tolerance=tolerance, or_finest=or_finest)
        cost = _cost_of_integration(found, table)
    except ParameterError as error:
        found, cost = error, math.inf
    stiff = replace(system, max_step=max(system.max_step, table.median_gap), stiff=True)
    if found is not system and not system.stiff and cost > _CHEAPER * _cost_of_integration(stiff, table):
        with contextlib.suppress(ParameterError):  # it is not still either, or not at that cost
            return _halved_until_still(stiff, table, theta, effects, tolerance=tolerance, most=cost / _CHEAPER)
    if isinstance(found, ParameterError):
        raise found
    return found


def _halved_until_still(
    system: System, table: RunTable, theta: FloatArray, effects: Sequence[Effect], *, tolerance: float,
    or_finest: bool = False, most: float = math.inf,
) -> System:  # fmt: skip
    """Return a system with the step halved as `with_converged_step` says, by its own method, at a cost of `most`."""
    now, before = system, np.inf
    coarse = now.chain(table, effects).predict(theta, table)
    while True:
        finer = replace(now, max_step=now.max_step / 2)
        fine = finer.chain(table, effects).predict(theta, table)
        there = np.isfinite(coarse) & np.isfinite(fine)
        ran_away = np.isfinite(fine) & ~np.isfinite(coarse)  # at the longer step alone
        moved = np.inf
        if there.any() and not ran_away.any():
            with np.errstate(over="ignore"):  # of predictions that are about to run away
                moved = float(np.sqrt(np.mean((coarse - fine)[there] ** 2)))
        steps = finer.steps(table)
        is_affordable = steps.n_steps.sum() <= _MOST_STEPS + len(steps.rows)
        if moved <= tolerance or (or_finest and moved < before / _CONVERGING and not is_affordable):
            return now
        if not is_affordable or _cost_of_integration(finer, table) > most:
            raise ParameterError(
                "rates",
                f"readings still change by {moved:.3g} {system.simulator.unit} (rms) when the step of "
                f"{now.max_step:.3g} {system.simulator.time_unit} is halved",
                "a law that some thousand steps integrate; set a shorter max_step_s, or write simulate with your own "
                "integrator",
            )
        now, coarse, before = finer, fine, moved


def _cost_of_integration(system: System, table: RunTable) -> float:
    """Return the number of evaluations of the rates, of all samples and runs together."""
    law, steps = system.simulator.law, system.steps(table)
    assert law is not None
    return float(steps.n_steps.sum() * evaluations_per_step(LawWithEffects(law), steps.method))
