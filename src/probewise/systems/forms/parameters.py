"""Forms on the parameters: parameters that vary instead of being constant, and a user's own effects."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import unit_of_name
from probewise.effects.effect import Act, in_words
from probewise.priors import LogUniform, Marginal
from probewise.sensor import Stage
from probewise.systems.forms.modulations import (
    Modulation,
    column_proportional_modulation,
    modulated_form,
    modulations_over_rows,
)
from probewise.systems.forms.reference import ActInTime, Form, ReferenceFit, flag
from probewise.systems.table import RunTable

_AS_FACTOR = "as_factor"  # name of the parameter that is 0 for the linear variant, and 1 for the one by a factor
_FAR = 0.3  # change of a parameter by its own size, as large as the misfit asks for, at which the variants differ
_MOST_NATS = 50.0  # largest logarithm of a factor
_N_VALUES = 9
_UNSEEN = 1e-7  # of the noise


_KINDS = {"drift": "drifts", "step": "steps", "per_run": "differs"}
_QUARTILES = np.array([0.25, 0.75])


def forms_on_parameters(about: ReferenceFit) -> Iterator[Form]:
    """Yield a form for each way in which a parameter may vary: drift, step, one value per run, with a column."""
    simulator, table = about.system.simulator, about.table
    values = about.system.parameters(about.theta, table)
    over = {_KINDS[kind]: how for kind, how in modulations_over_rows(about).items()}
    for name, prior in simulator.parameters.items():
        guess = 1e-4 * (float(np.abs(values[name]).max()) or float(np.ptp(prior.from_unit(_QUARTILES))))

        def varied(form: str, how: Modulation, size: float, name: str = name) -> Iterator[Form]:
            act = _parameter_shifter(name, how)
            if how.between_rows is not None:
                act = ActInTime(act, how.between_rows(name))
            own = (form, Stage.PARAMETER, how, act, size, name, unit_of_name(name))
            return modulated_form(about, *own)

        for kind, how in over.items():
            if kind != "differs" or name not in simulator.per_run:
                yield from varied(f"{kind}:{name}", how, guess / (about.duration if kind == "drifts" else 1.0))
        for column in about.varying_columns:
            how = column_proportional_modulation(column, table)
            for form in varied(f"depends:{name}:{column}", how, guess / float(np.nanstd(table.covariates[column]))):
                yield _linear_or_by_factor(about, form, name, how) if isinstance(prior, LogUniform) else form


def _linear_or_by_factor(about: ReferenceFit, form: Form, name: str, how: Modulation) -> Form:
    """Return a form of a parameter with two variants: it changes linearly, or by a factor, exponentially.

    A parameter with a log prior has no sign, and what changes it, as the temperature changes a rate, often multiplies
    it. `a` is the slope where the modulation is 0 (a column's mean) in both. The second variant is offered where the
    misfit may ask for a change that is not small beside the parameter; otherwise they are the same.
    """

    def act(value: dict[str, FloatArray], theta: FloatArray, table: RunTable) -> dict[str, FloatArray]:
        change, before = how.at_rows(theta, table), value[name]
        if np.all(theta[:, 1] < 0.5):
            return {**value, name: before + change}
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = np.exp(np.clip(change / before, -_MOST_NATS, _MOST_NATS))
        return {**value, name: np.where(theta[:, 1:2] > 0.5, before * factor, before + change)}

    def says(mean: FloatArray, sd: FloatArray) -> str:
        by_factor = ", and in proportion to itself (exponentially)" if mean[1] > 0.5 else ""
        return form.says(mean, sd) + by_factor

    def variant(as_factor: bool) -> Form:
        value, prior = flag(as_factor)
        priors: dict[str, Marginal] = {**form.marginals, _AS_FACTOR: prior}
        bank = np.insert(form.entries, 1, value, axis=2)
        return replace(form, parameters=priors, units=(*form.units, "1"), act=act, entries=bank, says=says)

    linear = variant(False)
    there = about.system.parameters(about.theta, about.table)[name]
    most = float(np.abs(how.at_rows(form.entries[0, :1], about.table)).max()) * max(about.misfit, 1.0)
    return linear if most < _FAR * float(np.abs(there).min()) else replace(linear, alternatives=(variant(True),))


def _parameter_shifter(name: str, how: Modulation) -> Act:
    return lambda value, theta, table: {**value, name: value[name] + how.at_rows(theta, table)}


PARAMETER_WORDS = {
    "drifts": "a drift of {0}",
    "steps": "a jump of {0}",
    "differs": "{0} that differs from run to run",
    "depends": "{0} that depends on {1}",
}
"""A noun phrase for each form here, with places for its targets, to follow "the model leaves out"."""


def forms_of_extras(about: ReferenceFit) -> Iterator[Form]:
    """Yield a form for each extra effect of a file that changes the readings somewhere in its prior."""
    for name, extra in about.system.simulator.extra.items():
        values = np.asarray(extra.prior.from_unit((np.arange(_N_VALUES) + 0.5) / _N_VALUES))
        values = values[values != extra.null]

        def act(value: Any, theta: FloatArray, table: RunTable, name: str = name) -> dict[str, FloatArray]:
            return {**value, name: theta[:, :1]}

        rms = about.rms_change_in_sds(Stage.PARAMETER, act, values[:, None])
        seen = np.isfinite(rms) & (rms > _UNSEEN)
        if seen.any():
            says, along = in_words(extra.says.replace("{value}", "{0}")), ("level", "time", "row")
            own = (name, Stage.PARAMETER, {"value": (extra.prior, "")}, along, act, says, values[seen][:, None, None])
            yield from about.form(*own, absent={0: extra.null})
