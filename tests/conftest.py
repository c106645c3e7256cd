"""Every test ends without open figures, and none opens a window."""

import os
import sys

import pytest

os.environ.setdefault("MPLBACKEND", "Agg")


@pytest.fixture(autouse=True)
def _figures_closed():
    yield
    if drawing := sys.modules.get("matplotlib.pyplot"):  # most tests draw nothing and never load it
        drawing.close("all")
