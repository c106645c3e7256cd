"""Sheets to draw on, the palette, and the way from a drawing to a PNG.

Figures are made without pyplot: no global state, no window, nothing to close.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import Any, TypeAlias, cast

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, ScalarFormatter
from numpy.typing import NDArray

from probewise.report.palette import BLACK, BLUE, CYCLE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION, YELLOW
from probewise.report.words import readable

__all__ = ["BLACK", "BLUE", "COPPER", "CYCLE", "GREEN", "GREY", "ORANGE", "PURPLE", "SKY", "VERMILLION", "YELLOW"]
__all__ += [
    "AxesGrid",
    "axes_or_new",
    "grid_of_axes",
    "legend_above",
    "plain_numbers",
    "png",
    "stack_of_axes",
    "svg",
    "tidy",
]

_LETTERS_PER_IN = 17.5  # of a legend, about
_LEAST_IN_FULL = 1e-5  # length of an axis whose labels are written without a power of ten

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


def stack_of_axes(heights_in: Sequence[float], *, width_in: float = 6.8) -> AxesGrid:
    """Make a new figure of axes one above another, shape (n_axes,); `svg` finds their margins in one pass."""
    sheet = Figure(figsize=(width_in, sum(heights_in)))
    FigureCanvasAgg(sheet)
    axes = sheet.subplots(len(heights_in), 1, squeeze=False, height_ratios=list(heights_in))
    return np.asarray(axes[:, 0], dtype=np.object_)


def svg(drawing: Axes | AxesGrid) -> bytes:
    """Render the figure that holds a drawing as SVG, the same bytes for the same drawing."""
    ax: Axes = drawing.flat[0] if isinstance(drawing, np.ndarray) else drawing
    sheet = cast(Figure, ax.figure)
    sheet.tight_layout(pad=0.4, h_pad=0.9)
    buffer, own = io.BytesIO(), sheet.canvas
    canvas: Any = FigureCanvasSVG(sheet)
    with mpl.rc_context({"svg.hashsalt": "probewise"}):
        canvas.print_svg(buffer, metadata={"Date": None})  # `savefig` would draw everything twice
    sheet.set_canvas(own)
    text = buffer.getvalue()
    return text[text.index(b"<svg") :]


def legend_above(ax: Axes) -> None:
    """Set the legend above the axes, in as many columns as fit: it never lies over data."""
    handles, labels = ax.get_legend_handles_labels()
    if not labels:
        return
    room = _LETTERS_PER_IN * ax.get_position().width * cast(Figure, ax.figure).get_figwidth()
    n_columns = next((n for n in range(len(labels), 1, -1) if _legend_width(labels, n) < room), 1)
    ax.legend(
        handles,
        labels,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=n_columns,
        frameon=False,
        fontsize="small",
        borderaxespad=0.1,
        columnspacing=1.2,
    )


def _legend_width(labels: Sequence[str], n_columns: int) -> int:
    """Count the letters across a legend, which is filled column by column; each sample is as wide as five."""
    n_rows = -(-len(labels) // n_columns)
    return sum(max(map(len, labels[k : k + n_rows])) + 6 for k in range(0, len(labels), n_rows))


def plain_numbers(ax: Axes, *, x: bool = True, y: bool = True) -> None:
    """Write tick labels in full: no factor or offset stands apart from them."""
    for axis in ([ax.xaxis] if x else []) + ([ax.yaxis] if y else []):
        low, high = axis.get_view_interval()
        if high - low > _LEAST_IN_FULL:
            in_full = ScalarFormatter(useOffset=False)
            in_full.set_scientific(False)
            axis.set_major_formatter(in_full)
        else:
            digits = 3 - math.floor(math.log10(max(high - low, 1e-300)))
            axis.set_major_formatter(FuncFormatter(lambda v, _, digits=digits: readable(f"{round(v, digits) + 0.0:g}")))


def tidy(ax: Axes, *, x: str, y: str, title: str = "") -> Axes:
    """Label axes with their units, drop the frame that carries nothing."""
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    if title:
        ax.set_title(title, fontsize="medium", loc="left")
    ax.spines[["top", "right"]].set_visible(False)
    return ax
