"""From parameters to noise-free readings, with effects on inputs and clock, parameters, rates of a law, readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.proof.systems.forms.form import FormWithParameters, Instants
from probewise.proof.systems.kind import SystemKind
from probewise.proof.systems.motion import solve_law
from probewise.proof.systems.table import SystemTable


@dataclass(frozen=True, eq=False)
class NoiseFreeResult:
    """Noise-free readings, (n_samples, n_points), and states by name of the same shape ({} for a static system)."""

    readings: FloatArray
    states: Mapping[str, FloatArray]


def simulate_noise_free(
    kind: SystemKind,
    rows: SystemTable,
    parameters: Mapping[str, FloatArray],
    effects: Sequence[FormWithParameters] = (),
) -> NoiseFreeResult:
    """Simulate a system without noise, at one set of parameters per sample.

    Parameters
    ----------
    kind
        The system.
    rows
        The table of the rows to simulate.
    parameters
        By name, (n_samples or 1, 1 or n_points) each.
    effects
        Forms, each with its parameters by name, (n_samples or 1, 1).
    """
    placed = [(form, {name: np.atleast_2d(v) for name, v in numbers.items()}) for form, numbers in effects]
    columns = {name: values[None, :] for name, values in rows.columns.items()}
    for form, numbers in placed:
        if form.side == "input" and not (form.late and kind.law is not None):
            columns = form.act(columns, rows, numbers)
    inner = [
        (form, n) for form, n in placed if form.side in ("parameter", "rate") or (form.late and kind.law is not None)
    ]
    n_samples = max(
        len(v) for v in (*parameters.values(), *columns.values(), *(v for _, n in placed for v in n.values()))
    )
    if kind.law is not None:
        states = solve_law(kind, rows, parameters, columns, inner)
        readings = np.asarray(kind.law.read(states, parameters, columns))
    else:
        assert kind.formula is not None
        states, p = {}, dict(parameters)
        now = Instants.at_rows(rows)
        for form, numbers in inner:
            p[form.target] = p[form.target] + form.act(now, numbers)
        readings = np.asarray(kind.formula(p, columns))
    readings = np.array(np.broadcast_to(readings, (n_samples, len(rows))))
    return NoiseFreeResult(apply_reading_effects(readings, rows, placed), states)


def apply_reading_effects(readings: FloatArray, rows: SystemTable, effects: Sequence[FormWithParameters]) -> FloatArray:
    """Return readings, (n_samples, n_points), with the effects of side "reading" applied in ascending `Form.order`."""
    for form, numbers in sorted((e for e in effects if e[0].side == "reading"), key=lambda e: e[0].order):
        readings = form.act(readings, rows, numbers)
    return readings
