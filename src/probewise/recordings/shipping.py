"""Recordings shipped with the package."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from probewise.errors import ParameterError

SHIPPED = ("paper", "concealed")


def shipped(name: str) -> Path:
    """Return the path of a recording shipped with the package, with its JSON beside it.

    Both are simulated (world/shipped.py). `paper`: readings of the paper's plan, 404 over the black-and-white boundary
    and four over the quadrants. `concealed`: 961 readings of scans out and back, with one effect that the sensor model
    leaves out, drawn from a seed.

    Raises
    ------
    ParameterError
        If there is no recording of that name.
    """
    if name not in SHIPPED:
        raise ParameterError("name", name, " or ".join(repr(known) for known in SHIPPED))
    return Path(str(resources.files("probewise"))) / "data" / f"{name}.csv"
