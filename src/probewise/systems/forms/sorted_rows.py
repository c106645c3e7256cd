"""Tables sorted by an input: a jump at a row is a jump where the input passes a value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.systems.forms.about import ReferenceFit
from probewise.systems.forms.form import Form
from probewise.systems.forms.inputs import driving_columns
from probewise.systems.table import RunTable, covariate_of_column


def sorting_column(about: ReferenceFit) -> str | None:
    """Return the name of a column that drives the simulator and rises or falls along all rows; None if none does.

    Where a time was recorded, there is none: rows are in its order, whatever they are sorted by besides. A column that
    drives nothing, such as a number of the reading, may be that order itself.
    """
    table = about.table
    if table.has_varying_time:
        return None
    changes = {name: np.diff(values) for name, values in table.covariates.items() if np.ptp(values) > 0}
    ordered = {name for name, change in changes.items() if np.all(change >= 0) or np.all(change <= 0)}
    return next((name for name in driving_columns(about) if name in ordered), None) if ordered else None


def jump_in_sorted_rows(form: Form, table: RunTable, column: str) -> Form:
    """Return a form with a jump at a row as one that shows in the column, and says where that is; others as given."""
    if form.change_points is None or not form.change_points.by_row:
        return form
    values = table.covariates[column]

    def says(mean: FloatArray, sd: FloatArray) -> str:
        before = int(np.clip(np.floor(mean[-1]), 0, len(values) - 1))
        return (
            f"{form.says(mean, sd)}; rows are sorted by {column}, so it may be where {column} passes "
            f"{values[before]:.4g} instead"
        )

    return replace(form, covariates=(covariate_of_column(column), *form.covariates), says=says)


def names_of_jumps_in_sorted_rows(effects: Mapping[str, Any]) -> frozenset[str]:
    """Return the names of the effects that `jump_in_sorted_rows` has changed."""
    return frozenset(
        name
        for name, effect in effects.items()
        if isinstance(effect, Form)
        and effect.change_points is not None
        and effect.change_points.by_row
        and effect.covariates[0] != "row"
    )
