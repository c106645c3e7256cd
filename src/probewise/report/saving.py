"""Write a result of a verb as its command does, or make its page alone."""

from __future__ import annotations

import importlib
from pathlib import Path

from probewise._kinds import checked_path, checked_whole
from probewise._writing import Drawings, Output, checked_output_directory

_REPORTS = {
    "Calibration": "calibration",
    "Diagnosis": "diagnosis",
    "SystemFit": "fit",
    "PlanAudit": "audit",
    "Investigation": "investigation",
    "Exploration": "exploration",
}
"""The report of each type of result, by name: a module is loaded for its own type only."""


def _output_of(value: object, seed: int | None) -> Output:
    report = next(_REPORTS[kind.__name__] for kind in type(value).__mro__ if kind.__name__ in _REPORTS)
    made: Output = importlib.import_module(f"probewise.report.{report}").output_of(value, seed=_checked_seed(seed))
    return made


def page_of(value: object, *, seed: int | None) -> str:
    """Return the page of a result, with its figures inside."""
    made = _output_of(value, seed)
    return made.page({name: draw() for name, draw in made.drawers.items()})


def save(value: object, folder: str | Path, *, seed: int | None) -> Path:
    """Write a result into a folder, made if missing, and return it; errors as of `probewise._display.Reported.save`."""
    made, out = _output_of(value, seed), checked_path("folder", folder)
    drawings = Drawings(checked_output_directory(out, main=made.main, option="folder"))
    drawings.write_results(made)
    drawings.raise_if_any_failed()
    return out


def _checked_seed(seed: int | None) -> int | None:
    return None if seed is None else checked_whole("seed", seed, least=0, most=None)
