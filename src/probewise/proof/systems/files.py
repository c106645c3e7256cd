"""Write a case as a user would provide it, with the truth in a separate file."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from probewise._arrays import IntArray
from probewise.proof.systems.cases import SystemCase, SystemEffect
from probewise.recordings import write_text_atomically
from probewise.recordings.table import csv_text


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
    return (
        own if effect.in_vocabulary else {**own, "side": "strange", "on_the_list": False, "formula": effect.form.shape}
    )


def _alias_name_and_nats_rows(effect: SystemEffect) -> list[list[Any]]:
    return [[name, round(nats, 3)] for name, nats in effect.aliases.items()]
