"""Draw a case: a system, its concealed effects, a recording, and held-out runs; write it as a user would provide it.

The kinds of noise, most of them not white, come first.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TypeAlias

import numpy as np
from scipy.optimize import brentq

from probewise._arrays import FloatArray, IntArray
from probewise.errors import NotConvergedError
from probewise.proof.sensors import CLEAR, FAINT, GROSS, SMALL, Stratum, amplitude_of_size, stratum_in_wheel
from probewise.proof.systems import forms
from probewise.proof.systems.kinds import FORMULAS, LAWS, SystemKind, SystemTable, design_runs, draw_values
from probewise.proof.systems.simulate import simulate_noise_free
from probewise.recordings import write_text_atomically
from probewise.recordings.table import csv_text

OTHER_NOISE = (
    *("correlated_noise", "outliers", "signal_dependent_noise", "t4", "random_walk", "quantised", "noise_per_run"),
    "dropouts",
)
"""Kinds of noise of a clean recording, besides white; "t4" and "quantised" are not in the vocabulary."""


Noisy: TypeAlias = Callable[[FloatArray, SystemTable, np.random.Generator], FloatArray]
"""Readings with noise, (n_points,), from noise-free ones, table and a generator."""


@dataclass(frozen=True, eq=False)
class SystemNoise:
    """A noise model of a case: "white" or one of OTHER_NOISE, how it is drawn, and the step to which it rounds."""

    name: str
    draw: Noisy
    step: float | None = None


def make_noise(
    name: str, readings: FloatArray, rows: SystemTable, sd: float, *, rng: np.random.Generator
) -> SystemNoise:
    """Return the noise `name`, as detectable as an effect of lambda 12, or at its largest strength if none suffices.

    "white", "outliers", "dropouts", "t4" and "quantised" have a fixed strength.
    """

    def white(y: FloatArray, rows: SystemTable, rng: np.random.Generator) -> FloatArray:
        return rng.standard_normal(len(y))

    in_sds: Noisy = white
    match name:
        case "correlated_noise":
            rho = math.sqrt(1 - math.exp(-(CLEAR**2) / (len(rows) - len(rows.rows_by_run))))

            def correlated(y: FloatArray, rows: SystemTable, rng: np.random.Generator) -> FloatArray:
                """Draw AR(1) noise of sd 1, which starts afresh in each run."""
                out = rng.standard_normal(len(rows))
                for run in rows.rows_by_run:
                    for before, row in pairwise(run):
                        out[row] = rho * out[before] + math.sqrt(1 - rho**2) * out[row]
                return out

            in_sds = correlated
        case "random_walk":
            # Eigenvalues of the covariance of n steps of a centred unit-step walk, without that of the mean.
            count = np.arange(1.0, len(rows) + 1)
            walk = np.minimum(count[:, None], count)
            centered = walk - walk.mean(axis=0) - walk.mean(axis=1)[:, None] + walk.mean()
            spectrum = np.maximum(np.linalg.eigvalsh(centered)[1:], 0.0)
            q = _strength(lambda a: 1 + a**2 * spectrum, 1e-4, 1.0)
            in_sds = lambda y, rows, rng: white(y, rows, rng) + q * np.cumsum(white(y, rows, rng))
        case "signal_dependent_noise":
            low, span = float(readings.min()), float(np.ptp(readings))
            variance: Callable[..., FloatArray] = lambda y, ratio: 1 + ratio * np.clip((y - low) / span, 0, None)
            ratio = _strength(lambda a: variance(readings, a), 1e-3, 1e4)
            in_sds = lambda y, rows, rng: np.sqrt(variance(y, ratio)) * white(y, rows, rng)
        case "noise_per_run":
            logs = rng.standard_normal(rows.n_runs)
            power = _strength(lambda a: np.exp(2 * a * logs)[rows.run], 1e-2, 3.0)
            in_sds = lambda y, rows, rng: np.exp(power * logs)[rows.run] * white(y, rows, rng)
        case "outliers":
            wide: Noisy = lambda y, rows, rng: np.where(rng.random(len(y)) < 0.03, 7.0 * white(y, rows, rng), 0.0)
            in_sds = lambda y, rows, rng: white(y, rows, rng) + wide(y, rows, rng)
        case "dropouts":
            lost = lambda y, rows, rng: np.where(rng.random(len(y)) < 0.02, 0.0, y + sd * white(y, rows, rng))
            return SystemNoise(name, lost)
        case "t4":  # its scale is the sd of the normal that matches its centre
            in_sds = lambda y, rows, rng: rng.standard_t(4.0, len(y))
    step = None
    if name == "quantised":  # to that of 1, 2 and 5 times powers of ten which is nearest on a logarithmic scale
        power = 10.0 ** math.floor(math.log10(2.0 * sd))
        step = min((m * power for m in (1.0, 2.0, 5.0, 10.0)), key=lambda m: abs(math.log(m / (2.0 * sd))))
    return SystemNoise(name, lambda y, rows, rng: y + sd * in_sds(y, rows, rng), step)


def _strength(variances: Callable[[float], FloatArray], low: float, high: float) -> float:
    """Return the strength, `high` at most, at which noise of these variances has lambda 12 against their mean.

    Lambda is the root of twice the expected gain in log likelihood.
    """

    def beyond(log_strength: float) -> float:
        each = variances(math.exp(log_strength))
        gain = len(each) * math.log(each.mean()) - float(np.log(each).sum())
        return math.sqrt(max(gain, 0.0)) - CLEAR

    if beyond(math.log(high)) <= 0:
        return high
    return float(np.exp(brentq(beyond, math.log(low), math.log(high), xtol=1e-4)))


SYSTEMS_WHEEL: tuple[Stratum, ...] = (
    *[Stratum("clean")] * 6,
    *[Stratum("clean", other_noise=True)] * 4,
    Stratum("single", FAINT),
    *[Stratum("single", SMALL)] * 2,
    *[Stratum("single", CLEAR)] * 2,
    Stratum("single", GROSS),
    *[Stratum("pair", CLEAR)] * 2,
    *[Stratum("outside", GROSS)] * 2,
)
"""Twenty cycles are 400 cases."""

_STRIDE = 7  # coprime to the length of the cycle, so that successive cases differ in kind


def system_stratum_of(number: int) -> tuple[Stratum, int]:
    """Return the stratum of case `number`, and how many earlier cases have its kind and `other_noise`, at any size."""
    return stratum_in_wheel(number, SYSTEMS_WHEEL, _STRIDE, lambda stratum: (stratum.kind, stratum.other_noise))


KINDS: tuple[SystemKind, ...] = (*FORMULAS, *LAWS)
"""Every kind of system."""

_ATTEMPTS = 16
_APART = 0.5  # upper bound on the cosine of a pair
_TOLERANCE = 0.008  # relative tolerance of a size
_SHOWS = 1e-3  # least share of an effect's change that the nominal model does not absorb
_RUN_AWAY = 1e3  # times the largest reading: larger ones count as divergence


@dataclass(frozen=True, eq=False)
class DrawnSystem:
    """A system with true parameters, without effects.

    `table` has all rows, those of the two held-out runs included. True parameters are by name, those of `by_run` as
    arrays over all runs of the table, held-out runs last.
    """

    kind: SystemKind
    table: SystemTable
    shared: Mapping[str, float]
    by_run: Mapping[str, FloatArray]

    @cached_property
    def diagnosed_row_numbers(self) -> IntArray:
        """Indices in `table` of the rows that are not held out."""
        return np.flatnonzero(self.table.run < self.table.n_runs - 2)

    @property
    def held_out_row_numbers(self) -> IntArray:
        """Indices in `table` of the rows of the last two runs."""
        return np.flatnonzero(self.table.run >= self.table.n_runs - 2)

    @cached_property
    def diagnosed_table(self) -> SystemTable:
        """The table of the rows that are not held out."""
        return self.table.select_rows(self.diagnosed_row_numbers)

    @cached_property
    def true_system(self) -> forms.SimulatedSystem:
        """The system at its true parameters with readings and states, over the rows that are not held out."""
        return self._simulate(self.diagnosed_table, ())

    def simulate_all_rows(self, effects: Sequence[forms.SystemEffect]) -> FloatArray:
        """Return noise-free readings with these effects at all rows of `table`, (n_points,); not finite if diverged."""
        with np.errstate(all="ignore"):
            return self._simulate(self.table, effects).readings

    def simulate_diagnosed_rows(self, effects: Sequence[forms.SystemEffect]) -> FloatArray:
        """Return noise-free readings with these effects at the rows that are not held out, (n_points,).

        Raises NotConvergedError if a reading is not finite.
        """
        with np.errstate(all="ignore"):
            readings = self._simulate(self.diagnosed_table, effects).readings
        if not np.isfinite(readings).all():
            raise NotConvergedError(f"the {self.kind.name} runs away")
        return readings

    def _simulate(self, table: SystemTable, effects: Sequence[forms.SystemEffect]) -> forms.SimulatedSystem:
        own = {**self.shared, **{name: values[table.run] for name, values in self.by_run.items()}}
        return simulate_noise_free(self.kind, table, {name: own[name] for name in self.kind.parameters}, effects)


AfterRefit: TypeAlias = Callable[[DrawnSystem, FloatArray], FloatArray]
"""Residuals of noise-free readings, (n_points,), in sds, after a refit, whose own error must not be counted."""


@dataclass(frozen=True, eq=False)
class SystemCase:
    """One case of a challenge on systems."""

    stratum: Stratum
    drawn: DrawnSystem
    effects: tuple[forms.SystemEffect, ...]  # concealed
    noise: SystemNoise
    noise_text: str  # the line on noise in the simulator file; may be empty
    labels: tuple[str, ...]  # names of the runs, as in the table
    noise_free: FloatArray  # readings with the effects at all rows, (n_points,)
    readings: FloatArray  # with noise
    cosine: float | None = None  # of a pair after the refit


def draw_system(kind: SystemKind, *, rng: np.random.Generator) -> DrawnSystem:
    """Draw a system of this kind: the table of all runs and the true parameters."""
    rows = design_runs(kind, rng=rng)
    each = [draw_values(kind.of_run, rng) for _ in range(rows.n_runs)]
    by_run = {name: np.array([own[name] for own in each]) for name in kind.per_run}
    return DrawnSystem(kind, rows, draw_values(kind.shared, rng), by_run)


def draw_system_case(seed: int, number: int, *, after_refit: AfterRefit) -> SystemCase:
    """Draw case `number` of a challenge on systems; it depends on the seed and the number alone.

    Raises NotConvergedError if in none of 16 systems the effects can have the requested size (a pair: cosine in +-0.5).
    """
    stratum, n_earlier = system_stratum_of(number)
    drawing, noising = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,))).spawn(2)
    shuffled = [*np.random.default_rng(np.random.SeedSequence(seed)).permutation(forms.FAMILIES), *forms.ADDED_FAMILIES]
    for attempt in range(_ATTEMPTS):
        family = str(shuffled[(n_earlier + (attempt // 8)) % len(shuffled)])
        drawn = draw_system(KINDS[int(drawing.integers(len(KINDS)))], rng=drawing)
        try:
            effects, cosine = _draw_effects(stratum, n_earlier, family, drawn, after_refit, drawing)
            everywhere = drawn.simulate_all_rows(effects)
            if not np.abs(everywhere).max() < _RUN_AWAY * np.abs(drawn.true_system.readings).max():
                raise NotConvergedError("the held-out runs diverge")
            break
        except NotConvergedError:
            if attempt == _ATTEMPTS - 1:
                raise
    kind = drawn.kind
    name = OTHER_NOISE[n_earlier % len(OTHER_NOISE)] if stratum.other_noise else "white"
    if name == "noise_per_run" and kind.run is None:
        name = "correlated_noise"  # the table has no column of runs
    diagnosed = everywhere[drawn.diagnosed_row_numbers]
    noise = make_noise(name, diagnosed, drawn.diagnosed_table, kind.sd, rng=noising)
    readings = noise.draw(everywhere, drawn.table, noising)
    knows = str(noising.choice(["sd", "nothing", "step"], p=[0.6, 0.25, 0.15]))
    step = noise.step
    if step is None and knows == "step" and name == "white":
        step = 10.0 ** math.floor(math.log10(kind.sd))
    said = {"sd": kind.sd} if knows != "nothing" else {}
    if step is not None:
        readings, said = np.round(readings / step) * step, {**said, "step": step}
    stated = ", ".join(f'"{key}": {value:g}' for key, value in said.items())
    plain = bool(noising.random() < 0.5)
    return SystemCase(
        stratum=stratum,
        drawn=drawn,
        effects=effects,
        noise=noise,
        noise_text=f"noise = {{{stated}}}" if said else "",
        labels=tuple(str(k + 1) if plain else f"{kind.run}{k + 1:02d}" for k in range(drawn.table.n_runs)),
        noise_free=everywhere,
        readings=np.round(readings, kind.reading_decimals),
        cosine=cosine,
    )


def _draw_effects(
    stratum: Stratum, n_earlier: int, family: str, drawn: DrawnSystem, after_refit: AfterRefit, rng: np.random.Generator
) -> tuple[tuple[forms.SystemEffect, ...], float | None]:
    """Draw the effects of a stratum once; return them and the cosine of a pair (None: no pair)."""
    if stratum.kind == "clean":
        return (), None
    known, name_of, families = forms.forms_of(drawn.true_system), forms.family_of, [family]
    if stratum.kind == "outside":
        families = [forms.OUT_OF_VOCABULARY[n_earlier % len(forms.OUT_OF_VOCABULARY)]]
        known = list(forms.forms_out_of_vocabulary(drawn.true_system, rng))
        name_of = lambda form: form.name.removeprefix("strange_").split(":")[0]
    elif stratum.kind == "pair":
        families = [str(name) for name in rng.choice(forms.FAMILIES, 2, replace=False)]
    chosen = []
    for family in families:
        if not (own := [form for form in known if name_of(form) == family]):
            raise NotConvergedError(f"this system has no target for {family}")
        chosen.append(own[int(rng.integers(len(own)))])
    effects = tuple(draw_effect_of_size(form, stratum.size, drawn, after_refit, rng) for form in chosen)
    left = [after_refit(drawn, drawn.simulate_diagnosed_rows([e])) for e in effects]
    cosine = None
    if len(effects) == 2:
        cosine = float(left[0] @ left[1] / np.sqrt((left[0] @ left[0]) * (left[1] @ left[1])))
        if abs(cosine) >= _APART:
            raise NotConvergedError(f"{effects[0].name} and {effects[1].name} are alike: cosine {cosine:.2f}")
    return tuple(
        replace(effect, covariates=_residual_covariates(effect.form, residuals, drawn.true_system))
        for effect, residuals in zip(effects, left, strict=True)
    ), cosine


def draw_effect_of_size(
    form: forms.Form, wanted: float, drawn: DrawnSystem, after_refit: AfterRefit, rng: np.random.Generator
) -> forms.SystemEffect:
    """Return an effect of this form with lambda `wanted`, other parameters drawn, without covariates.

    Lambda is the norm of its change after a full refit of the model without effects, in noise sds. Raises
    NotConvergedError if no amplitude within the form's limit has it.
    """
    more = form.draw(rng)
    sign = -1.0 if form.signed and rng.random() < 0.5 else 1.0

    def readings_at(amplitude: float) -> FloatArray:
        return drawn.simulate_diagnosed_rows([forms.SystemEffect(form, form.of_amplitude(sign * amplitude, more))])

    def size_at(amplitude: float) -> float:
        return float(np.linalg.norm(after_refit(drawn, readings_at(amplitude))))

    whole = float(np.linalg.norm(readings_at(form.first) - drawn.true_system.readings)) / drawn.kind.sd
    seen = size_at(form.first)
    if not seen > _SHOWS * whole:
        raise NotConvergedError(f"{form.name} does not show in the {drawn.kind.name}")
    first = min(form.first * min(max(wanted / seen, 1e-4), 1e4), form.limit)
    amplitude = amplitude_of_size(
        size_at, wanted, first=first, limit=form.limit, tolerance=_TOLERANCE, acceptable=0.01, max_calls=14
    )
    return forms.SystemEffect(form, form.of_amplitude(sign * amplitude, more), size_at(amplitude))


_BINS = 20
_AS_PLAIN = 0.9  # share of the best covariate's explained variance that counts as equal
_PLAIN = 0.25  # least explained share of the sum of squares


def _residual_covariates(form: forms.Form, residuals: FloatArray, true: forms.SimulatedSystem) -> tuple[str, ...]:
    """Return names that a diagnosis may rank first: the form's covariates, then others that explain about as much.

    `residuals`: those of the effect after the refit, (n_points,).
    """
    rows, change, n_points = true.table, np.zeros(len(true.table)), len(true.table)
    for own in rows.rows_by_run:
        change[own[1:]] = np.diff(true.readings[own])
    pooled = {name: values for name, values in rows.columns.items() if name != rows.time}
    pooled |= {"level": true.readings, "previous": change}
    pooled |= {f"state:{name}": values for name, values in true.states.items()}
    if rows.time is not None:
        pooled["time"] = rows.t
    groups = {}
    for name, values in pooled.items():
        edges = np.unique(np.quantile(values, np.linspace(0, 1, _BINS + 1)))
        groups[name] = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, max(len(edges) - 2, 0))
    if len(rows.rows_by_run) > 1:
        groups["run"] = rows.run
    shares = {}
    for name, group in groups.items():  # of the sum of squares, by the groups' means, minus what white noise gives
        n, of_group = np.bincount(group), np.bincount(group, residuals)
        explained = float(np.sum(of_group[n > 0] ** 2 / n[n > 0]))
        shares[name] = explained / float(residuals @ residuals) - np.count_nonzero(n) / n_points
    best = max(shares.values())
    plain = [name for name, share in shares.items() if share >= _AS_PLAIN * best and share > _PLAIN]
    return tuple(dict.fromkeys((*form.covariates, *sorted(plain, key=lambda name: -shares[name]))))


def write_system_case(case: SystemCase, directory: str | os.PathLike[str]) -> tuple[Path, Path, Path]:
    """Write simulator.py, table.csv and table_test.csv into a directory; return the paths in this order."""
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    simulator, table, test = (directory / name for name in ("simulator.py", "table.csv", "table_test.csv"))
    write_text_atomically(simulator, simulator_file_text(case))
    write_text_atomically(table, table_text(case, case.drawn.diagnosed_row_numbers))
    write_text_atomically(test, table_text(case, case.drawn.held_out_row_numbers))
    return simulator, table, test


def simulator_file_text(case: SystemCase) -> str:
    """Return the text of simulator.py: the nominal model as a user would provide it, with the line on noise."""
    return case.drawn.kind.text.replace("{noise}\n", f"{case.noise_text}\n" if case.noise_text else "")


def table_text(case: SystemCase, rows: IntArray) -> str:
    """Return the rows with these indices, readings last, as CSV text with a header."""
    kind, laid = case.drawn.kind, case.drawn.table
    columns: dict[str, Sequence[str]] = {}
    if kind.run is not None:
        columns[kind.run] = [case.labels[k] for k in laid.run[rows]]
    values = {**laid.columns, kind.reading: case.readings}
    first = [name for name in (kind.time, *kind.drives) if name is not None]
    for name in dict.fromkeys((*first, *values)):
        columns[name] = [f"{value:.{kind.column_decimals[name]}f}" for value in values[name][rows].tolist()]
    return csv_text(columns)
