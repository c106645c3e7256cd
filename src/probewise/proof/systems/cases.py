"""Draw a case: a system, its concealed effects, a recording, and held-out runs; write it as a user would provide it."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import NotConvergedError
from probewise.proof.sensors.cases import Stratum, stratum_in_wheel
from probewise.proof.sensors.sizing import amplitude_of_size
from probewise.proof.systems.fit import (
    AddedForm,
    LeastSquaresFit,
    ModelWithForms,
    project_out,
)
from probewise.proof.systems.form import Form, FormWithParameters, TrueSystem, parameter_arrays
from probewise.proof.systems.forms import ADDED_FAMILIES, FAMILIES, family_of, forms_of
from probewise.proof.systems.kind import SystemKind, SystemTable, design_runs
from probewise.proof.systems.kinds import FORMULAS, LAWS
from probewise.proof.systems.noise import OTHER_NOISE, SystemNoise, noise_of_size
from probewise.proof.systems.rivals import TELLING_NATS, residual_covariates_of, rivals_with_nats, vocabulary_name
from probewise.proof.systems.simulate import simulate_noise_free
from probewise.proof.systems.unlisted import OUT_OF_VOCABULARY, forms_out_of_vocabulary
from probewise.recordings import write_text_atomically
from probewise.recordings.table import csv_text

SYSTEMS_WHEEL: tuple[Stratum, ...] = (
    *[Stratum("clean")] * 6,
    *[Stratum("clean", other_noise=True)] * 4,
    Stratum("single", 6.0),
    *[Stratum("single", 8.0)] * 2,
    *[Stratum("single", 12.0)] * 2,
    Stratum("single", 20.0),
    *[Stratum("pair", 12.0)] * 2,
    *[Stratum("outside", 20.0)] * 2,
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
_RUN_AWAY = 1e3  # times the largest reading: larger ones count as divergence


@dataclass(frozen=True, eq=False)
class DrawnSystem:
    """A system with true parameters, without effects.

    `kind`, `table`: the system, and the table of all its rows, including those of the two held-out runs; `shared`,
    `by_run`: true parameters by name; those per run as arrays over all runs of `table`, held-out runs last.
    """

    kind: SystemKind
    table: SystemTable
    shared: Mapping[str, float]
    by_run: Mapping[str, FloatArray]

    @cached_property
    def diagnosed_row_numbers(self) -> IntArray:
        """Indices in `table` of the rows that are not held out."""
        return np.flatnonzero(self.table.run < self.table.n_runs - 2)

    @cached_property
    def diagnosed_table(self) -> SystemTable:
        """The table of the rows that are not held out."""
        return self.table.select_rows(self.diagnosed_row_numbers)

    @cached_property
    def nominal_model(self) -> ModelWithForms:
        """The model without effects, over the rows that are not held out."""
        return ModelWithForms(self.kind, self.diagnosed_table)

    @cached_property
    def true_coordinates(self) -> FloatArray:
        """Coordinates of the true parameters in `nominal_model`, (n_coordinates,)."""
        return self.nominal_model.coordinates_of(self.shared, self.by_run)

    @cached_property
    def fit_without_effects(self) -> LeastSquaresFit:
        """The nominal model at the true parameters, as a fit with chi-square 0: its readings and their derivatives."""
        readings, slopes = self.nominal_model.predict_with_slopes(self.true_coordinates)
        return LeastSquaresFit(self.true_coordinates, readings, slopes, 0.0)

    @cached_property
    def true_system(self) -> TrueSystem:
        """The system at its true parameters with readings and states, over the rows that are not held out."""
        parameters = self.nominal_model.parameters_at(self.true_coordinates[None, :])
        trace = simulate_noise_free(self.kind, self.diagnosed_table, parameters)
        return TrueSystem(
            self.kind,
            self.diagnosed_table,
            parameters,
            trace.readings[0],
            {name: v[0] for name, v in trace.states.items()},
        )

    def simulate_all_rows(self, effects: Sequence[FormWithParameters]) -> FloatArray:
        """Return noise-free readings with these effects at all rows of `table`, (n_points,); not finite if diverged."""
        return self._simulate(self.table, effects)

    def simulate_diagnosed_rows(self, effects: Sequence[FormWithParameters]) -> FloatArray:
        """Return noise-free readings with these effects at the rows that are not held out, (n_points,).

        Raises NotConvergedError if a reading is not finite.
        """
        readings = self._simulate(self.diagnosed_table, effects)
        if not np.isfinite(readings).all():
            raise NotConvergedError(f"the {self.kind.name} runs away")
        return readings

    def _simulate(self, table: SystemTable, effects: Sequence[FormWithParameters]) -> FloatArray:
        model = ModelWithForms(self.kind, table)
        with np.errstate(all="ignore"):
            at = model.coordinates_of(self.shared, self.by_run)
            found = simulate_noise_free(self.kind, table, model.parameters_at(at[None, :]), effects)
        return np.asarray(found.readings[0])

    def size_of_effects(self, effects: Sequence[FormWithParameters]) -> float:
        """Return lambda: the norm of the effects' change after a full refit of the nominal model, in noise sds."""
        return math.sqrt(
            self.nominal_model.fit(self.simulate_diagnosed_rows(effects), self.true_coordinates).chi_square
        )


@dataclass(frozen=True, eq=False)
class SystemEffect:
    """A concealed effect: form, parameters, size lambda, covariates, and rivals by name with their loss in nats."""

    form: Form
    values: Mapping[str, float]
    size_lambda: float
    rivals: Mapping[str, float]
    covariates: tuple[str, ...]

    @property
    def name(self) -> str:
        """The effect's name, with its target."""
        return vocabulary_name(self.form)

    @property
    def in_vocabulary(self) -> bool:
        """Whether the effect is one that a diagnosis can name."""
        return not self.form.shape

    @property
    def aliases(self) -> dict[str, float]:
        """The rivals that no diagnosis can tell from it: loss below TELLING_NATS, by name."""
        return {name: nats for name, nats in self.rivals.items() if nats < TELLING_NATS}

    @property
    def form_with_parameters(self) -> FormWithParameters:
        """The pair of the form and its parameters by name, (1, 1) each."""
        return self.form, parameter_arrays([self.values])

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters and constants by name; `values` lists those of all runs, held-out runs last."""
        values = [v for name, v in self.values.items() if name.startswith("values[")]
        own = {name: v for name, v in self.values.items() if not name.startswith("values[")}
        return {**own, **({"values": values} if values else {}), **self.form.also_in_truth}


@dataclass(frozen=True, eq=False)
class SystemCase:
    """One case of a challenge on systems.

    `seed`, `number`, `stratum`: identification of the case; `effects`: its concealed effects; `noise_text`: the line on
    noise in the simulator file; may be empty; `labels`: names of the runs, as in the table; `noise_free`, `readings`:
    readings with the effects, without and with noise, at all rows, (n_points,); `cosine`: cosine of a pair after the
    refit; None: no pair.
    """

    seed: int
    number: int
    stratum: Stratum
    drawn: DrawnSystem
    effects: tuple[SystemEffect, ...]
    noise: SystemNoise
    noise_text: str
    labels: tuple[str, ...]
    noise_free: FloatArray
    readings: FloatArray
    cosine: float | None = None


def draw_system(kind: SystemKind, *, rng: np.random.Generator) -> DrawnSystem:
    """Draw a system of this kind: the table of all runs and the true parameters."""
    rows = design_runs(kind, rng=rng)
    each = [kind.draw_run(rng) for _ in range(rows.n_runs)]
    return DrawnSystem(
        kind, rows, kind.draw(rng), {name: np.array([own[name] for own in each]) for name in kind.per_run}
    )


def draw_system_case(seed: int, number: int) -> SystemCase:
    """Draw case `number` of a challenge on systems; it depends on the seed and the number alone.

    Raises NotConvergedError if in none of 16 systems the effects can have the requested size (a pair: cosine in +-0.5).
    """
    stratum, n_earlier = system_stratum_of(number)
    drawing, noising = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,))).spawn(2)
    shuffled = [*np.random.default_rng(np.random.SeedSequence(seed)).permutation(FAMILIES), *ADDED_FAMILIES]
    failure = NotConvergedError("nothing was tried")
    for attempt in range(_ATTEMPTS):
        family = str(shuffled[(n_earlier + (attempt // 8)) % len(shuffled)])
        drawn = draw_system(KINDS[int(drawing.integers(len(KINDS)))], rng=drawing)
        try:
            effects, cosine = _draw_effects(stratum, n_earlier, family, drawn, drawing)
            everywhere = drawn.simulate_all_rows([effect.form_with_parameters for effect in effects])
            if not np.abs(everywhere).max() < _RUN_AWAY * np.abs(drawn.fit_without_effects.readings).max():
                raise NotConvergedError("the held-out runs diverge")
        except NotConvergedError as error:
            failure = error
            continue
        break
    else:
        raise failure
    kind = drawn.kind
    name = OTHER_NOISE[n_earlier % len(OTHER_NOISE)] if stratum.other_noise else "white"
    if name == "noise_per_run" and kind.run is None:
        name = "correlated_noise"  # the table has no column of runs
    diagnosed = everywhere[drawn.diagnosed_row_numbers]
    noise = noise_of_size(name, 12.0, diagnosed, drawn.diagnosed_table, kind.sd, rng=noising)
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
        seed,
        number,
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
    stratum: Stratum, n_earlier: int, family: str, drawn: DrawnSystem, rng: np.random.Generator
) -> tuple[tuple[SystemEffect, ...], float | None]:
    """Draw the effects of a stratum once; return them and the cosine of a pair (None: no pair)."""
    if stratum.kind == "clean":
        return (), None
    forms = forms_of(drawn.true_system)
    if stratum.kind in ("outside", "single"):
        if stratum.kind == "outside":
            family = OUT_OF_VOCABULARY[n_earlier % len(OUT_OF_VOCABULARY)]
            strange = forms_out_of_vocabulary(drawn.true_system, rng)
            own = [f for f in strange if f.name.removeprefix("strange_").split(":")[0] == family]
        else:
            own = [f for f in forms if family_of(f) == family]
        one = _draw_effect_of_size(_draw_form(own, family, rng), stratum.size, drawn, rng)
        return (_effect_with_rivals(one, forms, drawn, ()),), None
    names = rng.choice(FAMILIES, 2, replace=False)
    both = [_draw_form([f for f in forms if family_of(f) == name], str(name), rng) for name in names]
    first, second = (_draw_effect_of_size(form, stratum.size, drawn, rng) for form in both)
    cosine = _cosine_of_effects(drawn, first, second)
    if abs(cosine) >= _APART:
        raise NotConvergedError(f"{first.name} and {second.name} are alike: cosine {cosine:.2f}")
    pair = (first, second), (second, first)
    return tuple(_effect_with_rivals(one, forms, drawn, (other,)) for one, other in pair), cosine


def _draw_form(forms: Sequence[Form], name: str, rng: np.random.Generator) -> Form:
    """Draw one of these forms; if there is none, raise NotConvergedError with the effect's `name` in the message."""
    if not forms:
        raise NotConvergedError(f"this system has no target for {name}")
    return forms[int(rng.integers(len(forms)))]


def _draw_effect_of_size(form: Form, wanted: float, drawn: DrawnSystem, rng: np.random.Generator) -> SystemEffect:
    """Return an effect of this form with lambda `wanted`, other parameters drawn, without rivals and covariates."""
    more = form.draw(rng)
    sign = -1.0 if form.signed and rng.random() < 0.5 else 1.0

    def at_amplitude(amplitude: float) -> list[FormWithParameters]:
        return [(form, parameter_arrays([form.of_amplitude(sign * amplitude, more)]))]

    change = (
        drawn.simulate_diagnosed_rows(at_amplitude(form.first)) - drawn.fit_without_effects.readings
    ) / drawn.kind.sd
    seen = float(np.linalg.norm(project_out(change, drawn.fit_without_effects.slopes)))
    if not seen > 1e-6:
        raise NotConvergedError(f"{form.name} does not show in the {drawn.kind.name}")
    first = min(form.first * min(max(wanted / seen, 1e-4), 1e4), form.limit)
    amplitude = amplitude_of_size(
        lambda a: drawn.size_of_effects(at_amplitude(a)),
        wanted,
        first=first,
        limit=form.limit,
        tolerance=_TOLERANCE,
        acceptable=0.01,
        max_calls=14,
    )
    return SystemEffect(
        form, form.of_amplitude(sign * amplitude, more), drawn.size_of_effects(at_amplitude(amplitude)), {}, ()
    )


def _form_with_true_step_time_in_bank(form: Form, values: Mapping[str, float]) -> Form:
    """Add the true time (or row) of the concealed step to a step form's template bank; return other forms unchanged."""
    at = next((name for name in ("at_s", "at_row") if name in values and name in form.bank[0][0]), None)
    return form if at is None else replace(form, bank=[*form.bank, [{**form.bank[0][0], at: values[at]}]])


def _cosine_of_effects(drawn: DrawnSystem, one: SystemEffect, other: SystemEffect) -> float:
    plain, changes = drawn.fit_without_effects, []
    for effect in (one, other):
        change = drawn.simulate_diagnosed_rows([effect.form_with_parameters]) - plain.readings
        changes.append(project_out(change, plain.slopes))
    a, b = changes
    return float(a @ b / np.sqrt((a @ a) * (b @ b)))


def _effect_with_rivals(
    effect: SystemEffect, forms: Sequence[Form], drawn: DrawnSystem, others: Sequence[SystemEffect]
) -> SystemEffect:
    """Return the effect with its rivals and covariates, found in a model that has the other concealed effects."""
    target = drawn.simulate_diagnosed_rows([e.form_with_parameters for e in (effect, *others)])
    beside = [AddedForm(e.form, e.values) for e in others]
    model = ModelWithForms(drawn.kind, drawn.diagnosed_table, beside)
    start = model.coordinates_of(drawn.shared, drawn.by_run)
    fitted = model.fit(target, start)
    rivals = rivals_with_nats(
        drawn.true_system,
        [_form_with_true_step_time_in_bank(form, effect.values) for form in forms],
        target,
        fitted,
        model,
        frozenset({effect.name, *(e.name for e in others)}),
    )
    left = (target - fitted.readings) / drawn.kind.sd
    return replace(effect, rivals=rivals, covariates=residual_covariates_of(effect.form, left, drawn.true_system))


def write_system_case(case: SystemCase, directory: str | os.PathLike[str]) -> tuple[Path, Path, Path, Path]:
    """Write simulator.py, table.csv, table_test.csv and truth.json into a directory; return the paths in this order."""
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    seen = case.drawn.diagnosed_row_numbers
    later = np.setdiff1d(np.arange(len(case.drawn.table)), seen)
    texts = {
        "simulator.py": simulator_file_text(case),
        "table.csv": table_text(case, seen),
        "table_test.csv": table_text(case, later),
        "truth.json": json.dumps(truth_json(case), indent=1, allow_nan=False) + "\n",
    }
    for name, text in texts.items():
        write_text_atomically(directory / name, text)
    simulator, table, test, truth = (directory / name for name in texts)
    return simulator, table, test, truth


def simulator_file_text(case: SystemCase) -> str:
    """Return the text of simulator.py: the nominal model as a user would provide it, with the line on noise."""
    return case.drawn.kind.text.replace("{noise}\n", f"{case.noise_text}\n" if case.noise_text else "")


def table_text(case: SystemCase, rows: IntArray) -> str:
    """Return the rows with these indices, readings last, as CSV text with a header."""
    kind, laid = case.drawn.kind, case.drawn.table
    decimals = {**kind.decimals, **{c.name: c.decimals for c in kind.logged}, kind.reading: kind.reading_decimals}
    columns: dict[str, list[str]] = {}
    if kind.run is not None:
        columns[kind.run] = [case.labels[k] for k in laid.run[rows]]
    names = [n for n in (kind.time, *kind.drives) if n is not None]
    values = {**laid.columns, kind.reading: case.readings}
    for name in (*names, *(n for n in laid.columns if n not in names), kind.reading):
        columns[name] = [f"{value:.{decimals[name]}f}" for value in values[name][rows].tolist()]
    return csv_text(dict(columns))


def truth_json(case: SystemCase) -> dict[str, Any]:
    """Return a dict for truth.json: effects, their aliases ("rivals"), parameters, noise, noise-free readings."""
    seen = case.drawn.diagnosed_row_numbers
    later = np.setdiff1d(np.arange(len(case.drawn.table)), seen)
    pair = len(case.effects) == 2
    effects = [_effect_json(effect) for effect in case.effects]
    if case.noise.name not in ("white", "quantised", "t4"):
        effects.append(
            {
                "name": case.noise.name,
                "side": "noise",
                "parameters": dict(case.noise.parameters),
                "lambda": case.noise.size_lambda,
            }
        )
    return {
        "effects": effects,
        "rivals": [] if pair or not case.effects else _alias_name_and_nats_rows(case.effects[0]),
        "rivals_of": {effect.name: _alias_name_and_nats_rows(effect) for effect in case.effects} if pair else {},
        "covariates": list(case.effects[0].covariates) if len(case.effects) == 1 else [],
        "parameters": dict(case.drawn.shared),
        "noise_sd": case.drawn.kind.sd,
        "noise_free": case.noise_free[seen].tolist(),
        "noise_free_test": case.noise_free[later].tolist(),
        "system": case.drawn.kind.name,
        "stratum": {"kind": case.stratum.kind, "size": case.stratum.size},
        "noise": case.noise.name,
        "seed": case.seed,
        "number": case.number,
    }


def _effect_json(effect: SystemEffect) -> dict[str, Any]:
    own = {"name": effect.name, "side": effect.form.side, "parameters": effect.parameters, "lambda": effect.size_lambda}
    outside = {"side": "strange", "on_the_list": False, "formula": effect.form.shape}
    return own if effect.in_vocabulary else own | outside


def _alias_name_and_nats_rows(effect: SystemEffect) -> list[list[Any]]:
    return [[name, round(nats, 3)] for name, nats in effect.aliases.items()]
