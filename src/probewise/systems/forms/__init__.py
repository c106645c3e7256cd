"""Forms: generic effects that a simulator may leave out, each bound to a column, parameter, state or the reading."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from probewise.effects import AGAIN
from probewise.systems.forms import inputs, parameters, rates, readings
from probewise.systems.forms.about import ReferenceFit
from probewise.systems.forms.extras import forms_of_extras
from probewise.systems.forms.form import Form
from probewise.systems.forms.inputs import driving_columns, forms_on_inputs
from probewise.systems.forms.parameters import forms_on_parameters
from probewise.systems.forms.rates import forms_on_rates
from probewise.systems.forms.readings import forms_on_readings
from probewise.systems.forms.sorted_rows import jump_in_sorted_rows, sorting_column

__all__ = ["WORDS", "Form", "ReferenceFit", "bind_forms", "driving_columns"]

WORDS: Mapping[str, str] = MappingProxyType(readings.WORDS | inputs.WORDS | parameters.WORDS | rates.WORDS)
"""A noun phrase for each form, with places for its targets."""


_IN_ORDER = frozenset({"offset_step", "gain_step", "steps", "hysteresis", "backlash", "lag", "delay", "input_delay"})


def bind_forms(about: ReferenceFit) -> dict[str, Form]:
    """Return every form that could be detectable near this fit, by name; each wave twice, as two may act."""
    named = [*forms_on_readings(about), *forms_on_inputs(about), *forms_on_parameters(about), *forms_on_rates(about)]
    if not about.rows_are_in_order:
        named = [form for form in named if form.name.split(":")[0] not in _IN_ORDER]
    if (column := sorting_column(about)) is not None:
        named = [jump_in_sorted_rows(form, about.table, column) for form in named]
    found = [*named, *forms_of_extras(about)]
    waves = [replace(form, name=form.name + AGAIN) for form in found if form.joined is not None]
    return {form.name: form for form in [*found, *waves]}
