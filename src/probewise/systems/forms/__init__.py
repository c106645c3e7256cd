"""Forms: generic effects that a simulator may leave out, each bound to a column, parameter, state or the reading.

All are bound to a fit, or those of a stored model to its recording, without a new fit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from probewise.effects import AGAIN, PROPOSAL, name_without_copy_suffix
from probewise.effects.effect import Effect, StepEffect, WaveEffect
from probewise.errors import require
from probewise.priors import LogUniform
from probewise.systems.forms.formulas import formula_forms
from probewise.systems.forms.inputs import forms_on_inputs, forms_on_rates, sorting_column
from probewise.systems.forms.modulations import forms_of_extras, forms_on_parameters
from probewise.systems.forms.readings import forms_on_readings
from probewise.systems.forms.reference import ReferenceFit, StoredFit
from probewise.systems.simulator import Simulator
from probewise.systems.system import System
from probewise.systems.table import covariate_of_column

__all__ = ["WORDS", "ReferenceFit", "StoredFit", "bind_forms", "bind_proposals", "sorting_column"]

WORDS: Mapping[str, str] = MappingProxyType(
    {
        "offset_step": "a jump of all readings",
        "gain_step": "a jump of the readings' gain",
        "offset_per_run": "an offset that differs from run to run",
        "gain_per_run": "a gain that differs from run to run",
        "delay": "a delay of the readings",
        "settling": "readings that settle after the start",
        "interference": "a wave in the readings",
        "sensitivity": "readings that depend on {0}",
        "curve": "readings that follow a curve of {0}",
        "friction": "dry friction of {0}",
        "clock_drift": "a clock that runs fast or slow",
        "input_offset": "an offset of {0}",
        "input_gain": "a wrong scale of {0}",
        "input_delay": "a late effect of {0}",
        "input_saturation": "a limit of {0}",
        "dead_zone": "a dead zone of {0}",
        "periodic_error": "a periodic error of {0}",
        "backlash": "backlash (play) of {0}",
        "drifts": "a drift of {0}",
        "steps": "a jump of {0}",
        "differs": "{0} that differs from run to run",
        "depends": "{0} that depends on {1}",
        "damping": "damping of {0}",
        "drag": "drag on {0}",
        "forcing": "a constant force on {0}",
        "periodic_forcing": "a periodic force on {0}",
        "cubic": "a cubic term of {1} in the rate of {0}",
        "quadratic": "a quadratic term of {1} in the rate of {0}",
        "coupling": "a coupling of {1} to {0}",
        "limit": "a bound of {0}",
    }
)
"""A noun phrase for each form, with places for its targets, to follow "the model leaves out"."""

_WITH_VALUE_PER_RUN = ("offset_per_run", "gain_per_run", "differs", "noise_per_run")
_IN_RATES = "rate", "damping", "drag", "friction", "forcing", "periodic_forcing", "cubic", "quadratic", "coupling"
_IN_ORDER = frozenset({"offset_step", "gain_step", "steps", "hysteresis", "backlash", "lag", "delay", "input_delay"})


def bind_forms(about: ReferenceFit) -> dict[str, Effect]:
    """Return every form that could be detectable near this fit, by name; each wave twice, as two may act."""
    named = [*forms_on_readings(about), *forms_on_inputs(about), *forms_on_parameters(about), *forms_on_rates(about)]
    if not about.rows_are_in_order:
        named = [form for form in named if form.name.split(":")[0] not in _IN_ORDER]
    if (column := sorting_column(about)) is not None:
        along = covariate_of_column(column)
        named = [replace(f, covariates=(along, *f.covariates)) if jumps_at_row(f) else f for f in named]
    found = [*named, *forms_of_extras(about)]
    waves = [_second_wave(form) for form in found if isinstance(form, WaveEffect)]
    return _by_name(about, [*found, *waves])


def bind_proposals(about: ReferenceFit) -> dict[str, Effect]:
    """Return every formula that could be detectable near this fit, by name."""
    return _by_name(about, formula_forms(about))


def _by_name(about: ReferenceFit, forms: Iterable[Effect]) -> dict[str, Effect]:
    """Return forms by name; a pickled one finds its functions again by that, bound to what is stored of the fit."""

    def restorable(form: Effect) -> Effect:
        source = partial(_form_again, form.name, about.system.simulator, about.stored)
        variants = tuple(restorable(other) for other in form.alternatives)
        return replace(form, alternatives=variants, binding=replace(form.binding, source=source))

    return {form.name: restorable(form) for form in forms}


def _form_again(name: str, simulator: Simulator, known: StoredFit) -> Effect:
    return rebind_forms([name], simulator, known)[name]


def _second_wave(form: Effect) -> Effect:
    """Return a second wave; of a column it is the shorter, for two that are near its range are together a curve."""
    again, period = replace(form, name=form.name + AGAIN), form.marginals.get("period")
    if not isinstance(period, LogUniform):
        return again
    shorter = replace(period, high=max(0.5 * period.high, 1.1 * period.low))
    entries = form.entries[form.entries[:, 0, 1] < shorter.high]
    return replace(again, parameters={**form.marginals, "period": shorter}, entries=entries)


def jumps_at_row(effect: Any) -> bool:
    """Return whether an effect has a change point that is counted in rows."""
    return isinstance(effect, StepEffect) and effect.change_points.by_row


def names_in_definitions(about: ReferenceFit, names: Iterable[str]) -> frozenset[str]:
    """Return those names of effects and formulas in the rate of a state that is another state by definition."""
    out = set()
    for name in names:
        kind, *target = name_without_copy_suffix(name).removeprefix(PROPOSAL).split(":")
        if kind in _IN_RATES and target[0] in about.states_with_rates_by_definition:
            out.add(name)
    return frozenset(out)


def rebind_forms(
    names: Iterable[str], simulator: Simulator, known: StoredFit, *, more_runs: Iterable[str] = ()
) -> dict[str, Effect]:
    """Bind the forms of these names to a recording again; return them by name, without names of other effects.

    `known` is the recording with the predictions of the fit to which they were bound; for `more_runs` outside it, forms
    with one value per run also get a value. Raises ParameterError if a proposal cannot be rebound.
    """
    wanted = list(dict.fromkeys(names))
    found = _bind_wanted_forms(wanted, simulator, known)
    table, more = known.table, list(more_runs)
    if more and table.run is not None:  # the last row again under the name of each
        rows = np.append(np.arange(len(table)), np.full(len(more), len(table) - 1))
        names_of_runs = np.array([*(table.scan_names[k] for k in table.scan.tolist()), *more])
        longer = replace(table, columns={n: v[rows] for n, v in table.columns.items()} | {table.run: names_of_runs})
        states = {name: values[rows] for name, values in known.states.items()}
        beyond = replace(known, table=longer, predicted=known.predicted[rows], states=states)
        found |= _bind_wanted_forms(list(filter(has_value_per_run, wanted)), simulator, beyond)
    for name in wanted:
        is_bound = name in found or not name.startswith(PROPOSAL)
        require(is_bound, "effects", name, "a term that this version knows; diagnose again with it")
    return {name: found[name] for name in wanted if name in found}


def _bind_wanted_forms(wanted: list[str], simulator: Simulator, known: StoredFit) -> dict[str, Effect]:
    if not wanted:
        return {}
    system = System(simulator, known.table.scan_names)
    about = ReferenceFit(system, known.table, np.zeros(system.n_params), known.sd, known=known)
    found = bind_forms(about)
    if any(name.startswith(PROPOSAL) for name in wanted):
        found |= bind_proposals(about)
    return {name: found[name] for name in wanted if name in found}


def has_value_per_run(name: str) -> bool:
    """Return whether the effect of this name has one value per run."""
    return name.partition(":")[0] in _WITH_VALUE_PER_RUN
