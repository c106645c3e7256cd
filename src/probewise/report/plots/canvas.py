"""Sheets to draw on, the palette, and the way from a drawing to a PNG.

Figures are made without pyplot: no global state, no window, nothing to close.
"""

from __future__ import annotations

import io
from typing import Any, TypeAlias, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from probewise.report.palette import BLACK, BLUE, CYCLE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION, YELLOW

__all__ = ["BLACK", "BLUE", "COPPER", "CYCLE", "GREEN", "GREY", "ORANGE", "PURPLE", "SKY", "VERMILLION", "YELLOW"]
__all__ += ["AxesGrid", "axes_or_new", "grid_of_axes", "png", "tidy"]

AxesGrid: TypeAlias = NDArray[Any]

# The paper's copper tones. They start above black, so that black squares and blue outlines
# stay legible, and lightness rises evenly, so that the map also reads in grey.
COPPER: Colormap = LinearSegmentedColormap.from_list(
    "probewise_copper", ["#2a1a12", "#6b3f26", "#a9673f", "#dd9a64", "#ffd9a8"]
)


def axes_or_new(ax: Axes | None, *, size_in: tuple[float, float] = (6.4, 4.2)) -> Axes:
    """Return the axes given, or those of a new figure."""
    return ax if ax is not None else grid_of_axes(1, 1, size_in=size_in)[0, 0]


def grid_of_axes(n_rows: int, n_columns: int, *, size_in: tuple[float, float], **options: Any) -> AxesGrid:
    """Make a new figure of several axes, shape (n_rows, n_columns); options go to `Figure.subplots`."""
    sheet = Figure(figsize=size_in, layout="constrained")
    FigureCanvasAgg(sheet)
    return np.asarray(sheet.subplots(n_rows, n_columns, squeeze=False, **options), dtype=np.object_)


def png(drawing: Axes | AxesGrid | Figure, *, dpi: int = 110) -> bytes:
    """Render the figure that holds a drawing."""
    if isinstance(drawing, Figure):
        sheet = drawing
    else:
        ax: Axes = drawing.flat[0] if isinstance(drawing, np.ndarray) else drawing
        sheet = cast(Figure, ax.figure)  # none of our figures has subfigures
    buffer = io.BytesIO()
    sheet.savefig(buffer, format="png", dpi=dpi, bbox_inches="tight")
    return buffer.getvalue()


def tidy(ax: Axes, *, x: str, y: str, title: str = "") -> Axes:
    """Label axes with their units, drop the frame that carries nothing."""
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    if title:
        ax.set_title(title, fontsize="medium", loc="left")
    ax.spines[["top", "right"]].set_visible(False)
    return ax
