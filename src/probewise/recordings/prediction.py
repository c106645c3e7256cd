"""Predicted readings of a plan or recording, and their file."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, read_only_floats, require_finite
from probewise._display import ShowsItself, data_frame
from probewise._kinds import checked_path
from probewise._writing import write_text_atomically
from probewise.errors import FileError, ParameterError, ShapeError
from probewise.recordings.files import plan_columns, plan_values
from probewise.recordings.plan import Plan
from probewise.recordings.table import csv_text, number_text, read_table


@dataclass(frozen=True, eq=False)
class Prediction(ShowsItself):
    """Predictive mean and sd of each row's reading; all arrays have shape (n_points,).

    `sd` includes noise and parameter uncertainty. `log_density` is the natural log of the marginal predictive density
    of that row's reading, per unit of the reading; NaN where it is missing or out of range, and everywhere for a plan.
    `readings` are the scored readings, NaN where there is none.
    """

    plan: Plan
    mean: FloatArray
    sd: FloatArray
    log_density: FloatArray
    readings: FloatArray = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        if not np.size(self.readings):
            object.__setattr__(self, "readings", np.full(len(self.plan), np.nan))
        for name in ("readings", "mean", "sd", "log_density"):
            values = read_only_floats(getattr(self, name))
            if values.shape != (len(self.plan),):
                raise ShapeError(f"{name} has shape {values.shape}; allowed: ({len(self.plan)},), one per row")
            object.__setattr__(self, name, values)
        require_finite("mean", self.mean)
        require_finite("sd", self.sd)
        if np.isinf(self.log_density).any():
            raise ParameterError("log_density", math.inf, "finite numbers, or NaN without a reading")
        if np.any(self.sd <= 0):
            raise ParameterError("sd", float(self.sd.min()), "greater than 0")

    def __len__(self) -> int:
        return len(self.plan)

    def to_frame(self) -> Any:
        """Return a pandas DataFrame with the columns of the prediction's CSV file, a row per reading."""
        predicted = {name: getattr(self, name) for name in ("mean", "sd", "log_density")}
        return data_frame({**plan_values(self.plan), **predicted})

    def summary(self) -> str:
        """Summarise: number of predictions; for recorded readings, chi-square and log density per reading."""
        return prediction_summary(self.readings, self.mean, self.sd, self.log_density)


def prediction_summary(readings: FloatArray, mean: FloatArray, sd: FloatArray, log_density: FloatArray) -> str:
    """Summarise predictions in a line or two, as `Prediction.summary` does; all arguments have shape (n_points,)."""
    lines = [f"{len(mean)} readings predicted"]
    scored = np.isfinite(log_density) & np.isfinite(readings)
    if scored.any():
        n_left = int(len(mean) - scored.sum())
        left_out = f" ({n_left} missing or out of range, left out)" if n_left else ""
        z = (readings[scored] - mean[scored]) / sd[scored]
        lines.append(
            f"of {int(scored.sum())} recorded{left_out}: chi-square per reading {float(np.mean(z**2)):.3f}, "
            f"log density per reading {float(log_density[scored].mean()):.3f}"
        )
    return "\n".join(lines)


def write_prediction(prediction: Prediction, path: str | os.PathLike[str]) -> None:
    """Write a CSV file of the plan's rows in order, with `mean`, `sd` and `log_density`, in full precision."""
    columns = plan_columns(prediction.plan)
    for name in ("mean", "sd", "log_density"):
        columns[name] = [number_text(value) for value in getattr(prediction, name)]
    write_text_atomically(path, csv_text(columns))


def read_prediction_columns(path: str | os.PathLike[str]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return `mean`, `sd` and `log_density` from a file of predictions, (n_points,) each; an empty density becomes NaN.

    Raises FileError if the file is missing, a cell is not a valid number, or an sd is not above 0.
    """
    table = read_table(checked_path("path", path), wanted=("mean", "sd", "log_density"))
    table.require_columns("mean", "sd", "log_density")
    mean, sd = table.column_of_numbers("mean"), table.column_of_numbers("sd")
    if np.any(sd <= 0):
        k = int(np.argmax(sd <= 0))
        raise FileError(path, f"{sd[k]:g}", "greater than 0", row=table.rows[k], column="sd")
    return mean, sd, table.column_of_numbers("log_density", missing=True)
