"""Reports: one self-contained HTML page per run, and its figures."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from probewise.report import audit, calibration, demo, diagnosis, exploration, fit, plots

__all__ = ["audit", "calibration", "demo", "diagnosis", "exploration", "fit", "plots"]


def __getattr__(name: str) -> object:
    """Load a module of the package when it is first asked for (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module 'probewise.report' has no attribute {name!r}")
    return importlib.import_module(f"probewise.report.{name}")


def __dir__() -> list[str]:
    return __all__
