"""The result of a run, as a value and as files: result.json and samples.csv."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

import numpy as np

from probewise.experiment.left_out import left_out_after_step
from probewise.experiment.state import Exploration, require_exploration
from probewise.experiment.stopping_rule import probability_of_length_off
from probewise.nested.weights import weighted_quantiles
from probewise.recordings.table import csv_text_of_rows
from probewise.scene.albedo import Shape
from probewise.scene.any_of import AnyOf
from probewise.scene.shapes import RegularPolygon

FORMAT = "exploration/1"

OFF_MM = 12.0
"""Three times the 4 mm of the stopping rule: a larger error counts as wrong."""

_POLYGONS = {3: "triangle", 4: "square", 5: "pentagon", 6: "hexagon", 8: "octagon"}


@dataclass(frozen=True)
class FoundParameter:
    """A parameter of the shape: its name, which ends in its unit, and its posterior mean, sd and 95 % interval.

    `arm_sd` is the part of the sd that is due to the arm's own error; None if that error is unknown and not included.
    """

    name: str
    mean: float
    sd: float
    interval95: tuple[float, float]
    arm_sd: float | None = None


@dataclass(frozen=True)
class FoundShape:
    """The most probable shape, its probability, and its parameters given that shape."""

    name: str
    probability: float
    parameters: tuple[FoundParameter, ...]


def found_shape(run: Exploration) -> FoundShape:
    """Summarise the posterior after the last reading: the most probable shape and its parameters."""
    shape, last = run.experiment.shape, run.last
    theta, weight = run.posterior.theta[:, run.experiment.shape_columns], run.posterior.weight
    name = last.likely_shape or _shape_name(shape)
    if isinstance(shape, AnyOf):
        own = shape.shape_index(theta) == shape.shape_names.index(name)
        theta, weight = theta[own], weight[own]
    low, high = weighted_quantiles(theta, weight, [0.025, 0.975])
    parameters = tuple(
        FoundParameter(
            last.names[k].removeprefix(f"{name}."),
            float(last.mean[k]),
            float(run.sd[k]),
            (float(low[k]), float(high[k])),
            None if run.arm_error is None else float(run.arm_error.sd[k]),
        )
        for k in np.flatnonzero(np.isfinite(last.mean)).tolist()
        if last.names[k] != "shape"
    )
    return FoundShape(name, last.shapes.get(name, 1.0), parameters)


def result_json(run: Exploration) -> str:
    """Return a run's result, with its numbers of readings and seconds, as strict JSON, format "exploration/1"."""
    require_exploration(run)
    document = {
        "format": FORMAT,
        "readings": len(run.steps),
        "stop_reason": run.stop_reason,
        "known": run.reached,
        "shape": asdict(found_shape(run)),
        "chance_off_12mm": probability_of_length_off(run.experiment, run.posterior, OFF_MM),
        "left_out": left_out_after_step(run.last, run.experiment.trust).as_json(),
        "notes": list(run.notes),
        "bits": run.last.bits,
        "seconds": run.seconds,
    }
    return json.dumps(document, allow_nan=False, indent=1) + "\n"


def samples_csv(run: Exploration) -> str:
    """Return the weighted posterior samples of the shape as CSV: a column "weight", then one per parameter.

    For a set of shapes, the column "shape" names each sample's shape, and parameters of other shapes are empty.
    """
    require_exploration(run)
    shape, names = run.experiment.shape, run.last.names
    theta, weight = run.posterior.theta[:, run.experiment.shape_columns], run.posterior.weight
    several = isinstance(shape, AnyOf)
    columns = [k for k, name in enumerate(names) if name != "shape"]
    rows = []
    which = shape.shape_index(theta) if isinstance(shape, AnyOf) else np.zeros(len(theta), dtype=np.int64)
    for row in np.flatnonzero(weight > 0).tolist():
        label, held = [], set(columns)
        if isinstance(shape, AnyOf):
            label = [shape.shape_names[which[row]]]
            held = set(shape.prior.columns_by_shape[which[row]])
        values = (f"{theta[row, k]:.7g}" if k in held else "" for k in columns)
        rows.append([f"{weight[row]:.7g}", *label, *values])
    return csv_text_of_rows(["weight", *(["shape"] if several else []), *(names[k] for k in columns)], rows)


def _shape_name(shape: Shape) -> str:
    if isinstance(shape, RegularPolygon):
        return _POLYGONS.get(shape.n_sides, f"regular polygon of {shape.n_sides} sides")
    return type(shape).__name__.lower()
