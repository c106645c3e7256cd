"""Every test ends without open figures, and none opens a window."""

import io
import os
import sys

import pytest

os.environ.setdefault("MPLBACKEND", "Agg")


@pytest.fixture(autouse=True)
def _figures_closed():
    yield
    if drawing := sys.modules.get("matplotlib.pyplot"):  # most tests draw nothing and never load it
        drawing.close("all")


@pytest.fixture
def quick_frames(monkeypatch):
    """Draw every step of a run as one black pixel."""
    from PIL import Image

    from probewise.report import exploration

    dot = io.BytesIO()
    Image.new("RGB", (1, 1)).save(dot, "PNG")
    for drawing in ("robot_view_png", "robot_views_by_model_png"):
        monkeypatch.setattr(exploration, drawing, lambda *_, **__: dot.getvalue())
