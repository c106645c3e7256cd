"""Forms on the parameters: parameters that vary instead of being constant."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from probewise.sensor import Stage
from probewise.systems.forms import modulations
from probewise.systems.forms.about import ReferenceFit
from probewise.systems.forms.form import Act, Form
from probewise.systems.forms.modulations import Modulation
from probewise.systems.forms.readings import modulated_form


def forms_on_parameters(about: ReferenceFit) -> Iterator[Form]:
    """Yield a form for each way in which a parameter may vary: drift, step, one value per run, with a column."""
    system, table = about.system, about.table
    own = system.simulator
    values = system.parameters(about.theta, table)
    over: dict[str, Modulation] = {}
    if table.has_varying_time:
        over["drifts"] = modulations.linear_drift_modulation(table, about.time_unit)
    over["steps"] = modulations.change_point_step_modulation(table, about.time_unit, gated=False)
    columns = [c for c, v in table.covariates.items() if c not in (own.reading, own.noise.sd) and np.nanstd(v) > 0]
    for name in own.parameters:
        guess = 1e-4 * (float(np.abs(values[name]).max()) or 1.0)
        each = dict(over)
        if name not in own.per_run and about.can_fit_value_per_run:
            each["differs"] = modulations.value_per_run_modulation(table)
        for kind, how in each.items():
            size = guess / (about.duration if kind == "drifts" else 1.0)
            yield from modulated_form(
                about,
                f"{kind}:{name}",
                stage=Stage.PARAMETER,
                how=how,
                act=_parameter_shifter(name, how),
                guess=size,
                what=name,
                unit="",
            )
        for column in columns:
            how = modulations.column_proportional_modulation(column, table)
            size = guess / float(np.nanstd(table.covariates[column]))
            yield from modulated_form(
                about,
                f"depends:{name}:{column}",
                stage=Stage.PARAMETER,
                how=how,
                act=_parameter_shifter(name, how),
                guess=size,
                what=name,
                unit="",
            )


def _parameter_shifter(name: str, how: Modulation) -> Act:
    return lambda value, theta, table: {**value, name: value[name] + how.at_rows(theta, table)}


WORDS = {
    "drifts": "a drift of {0}",
    "steps": "a jump of {0}",
    "differs": "{0} that differs from run to run",
    "depends": "{0} that depends on {1}",
}
"""A noun phrase for each form here, with places for its targets, to follow "the model leaves out"."""
