"""Figures and axes, the palette, maps, legends, and rendering to PNG and SVG.

Without axes, a plot function opens a pyplot figure, so that `plt.savefig` and `plt.show` find it; `png` and
`svg` close it, so that a page of many pictures leaves none open.
"""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, TypeAlias, cast
from weakref import WeakSet

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, ScalarFormatter
from numpy.typing import NDArray
from PIL import Image

from probewise._arrays import FloatArray
from probewise._kinds import require_kind
from probewise.report.words import typeset_numbers

BLACK, ORANGE, SKY, GREEN = "#000000", "#e69f00", "#56b4e9", "#009e73"
BLUE, VERMILLION, PURPLE, GREY = "#0072b2", "#d55e00", "#cc79a7", "#8c8c8c"
CYCLE = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK)
"""Okabe and Ito's palette, distinct for the colour-blind."""

THIN: dict[str, Any] = {"color": BLACK, "linewidth": 0.7}
"""Style of the line at zero."""
BAND: dict[str, Any] = {"color": GREY, "alpha": 0.3, "linewidth": 0}
"""Style of a band of chance, or of errors."""
FILLED: dict[str, Any] = {"color": BLUE, "alpha": 0.25, "linewidth": 0}
"""Style of the area below a curve."""
TITLE: dict[str, Any] = {"fontsize": "medium", "loc": "left", "y": 1.0}
"""Style of a title. Without `y`, each drawing measures the tick labels of both axes, to place the title above them."""

_LINE_SAMPLE = 6  # letters that the sample of the line or colour before a label takes
_AXES = "axes of matplotlib: figure.add_subplot(), figure.subplots(), or None for a figure of its own"
_MARGIN_IN = 0.1  # about a cropped picture, as matplotlib leaves it
_EMPTY_BRACKETS = re.compile(r"\s*\(\)$")
_LEAST_IN_FULL = 1e-5  # of an axis' length: shorter ones have labels with a power of ten

AxesGrid: TypeAlias = NDArray[Any]

PAGE_IN = 9.6
"""Width of a report's column: a wider drawing is shrunk, and its text with it."""

LETTERS_PER_IN = 16.2
"""Letters in an inch of the smallest font, about."""

SMALL_PT = 9.0
"""The smallest font size of any drawing: 8.5 pt or more on a page."""

OUT_OF_REACH = "#d9d9d9"
"""Colour of places out of the arm's reach, in every drawing of the field."""

_OPENED: WeakSet[Figure] = WeakSet()  # figures that plot functions opened: `png` closes them, and no others

# The paper's copper tones. They start above black, so that black squares and blue outlines stay visible, and lightness
# rises evenly, so that the map can be read in grey too.
COPPER: Colormap = LinearSegmentedColormap.from_list(
    "probewise_copper", ["#2a1a12", "#6b3f26", "#a9673f", "#dd9a64", "#ffd9a8"]
)


def axes_or_new(ax: Axes | None, *, size_in: tuple[float, float] = (6.4, 4.2)) -> Axes:
    """Return the axes given, or those of a new figure; ParameterError for anything else, such as a figure."""
    if ax is not None:
        require_kind("ax", ax, Axes, _AXES)
    return ax if ax is not None else grid_of_axes(1, 1, size_in=size_in)[0, 0]


def grid_of_axes(n_rows: int, n_columns: int, *, size_in: tuple[float, float], **options: Any) -> AxesGrid:
    """Open a figure and return its axes, (n_rows, n_columns); options go to `Figure.subplots`."""
    return np.asarray(
        new_figure(size_in, layout="constrained").subplots(n_rows, n_columns, squeeze=False, **options),
        dtype=np.object_,
    )


def grid_of_frames(
    n_rows: int, n_columns: int, *, size_in: tuple[float, float], margins_in: tuple[float, float, float, float]
) -> AxesGrid:
    """Return axes, (n_rows, n_columns), each of a part of this size within fixed margins: left, bottom, right, top.

    To measure what the margins must hold would take as long as to draw.
    """
    (width, height), (left, bottom, right, top) = size_in, margins_in
    sheet = Figure((n_columns * width, n_rows * height))
    axes = sheet.subplots(n_rows, n_columns, squeeze=False)
    sheet.subplots_adjust(
        left=left / (n_columns * width),
        right=1.0 - right / (n_columns * width),
        bottom=bottom / (n_rows * height),
        top=1.0 - top / (n_rows * height),
        wspace=(left + right) / (width - left - right),
        hspace=(bottom + top) / (height - bottom - top),
    )
    return np.asarray(axes, dtype=np.object_)


@lru_cache(maxsize=1)
def axes_of_frame(size_in: tuple[float, float], margins_in: tuple[float, float, float, float]) -> Axes:
    """Return the axes of an animation's frames, the same for each, within fixed margins.

    Who draws a frame replaces what was drawn before: new axes, with new ticks, take most of the time of a frame.
    """
    axes: Axes = grid_of_frames(1, 1, size_in=size_in, margins_in=margins_in)[0, 0]
    return axes


def new_figure(size_in: tuple[float, float], *, layout: Any = None) -> Figure:
    """Open a pyplot figure, which `png` or `svg` will close, and return it."""
    sheet = plt.figure(figsize=size_in, layout=layout)
    _OPENED.add(sheet)
    return sheet


def figure_of(drawing: Axes | AxesGrid | Figure) -> Figure:
    """Return the figure that axes belong to; none of ours has subfigures."""
    first = drawing.flat[0] if isinstance(drawing, np.ndarray) else drawing
    return first if isinstance(first, Figure) else cast(Figure, first.figure)


def png(drawing: Axes | AxesGrid | Figure, *, dpi: int = 110, tight: bool = True) -> bytes:
    """Render a drawing's figure as PNG; a figure that a plot function opened is closed, others stay open.

    `tight` crops empty margins. Without it, figures of equal size give PNGs of equal size, as an animation needs.
    """
    sheet, buffer = figure_of(drawing), io.BytesIO()
    own, own_dpi = sheet.canvas, sheet.dpi
    agg: Any = FigureCanvasAgg(sheet)  # `savefig` would draw everything twice, and measure it a third time
    sheet.dpi = dpi
    try:
        agg.draw()
    finally:
        sheet.set_canvas(own)
        sheet.dpi = own_dpi
    if sheet in _OPENED:
        plt.close(sheet)
    pixels = np.asarray(agg.buffer_rgba())[..., :3]
    if tight:
        margin = round(_MARGIN_IN * dpi)
        rows, columns = (np.flatnonzero((pixels != pixels[0, 0]).any(axis=axis)) for axis in ((1, 2), (0, 2)))
        within = (slice(max(at[0] - margin, 0), at[-1] + margin + 1) for at in (rows, columns) if at.size)
        pixels = pixels[tuple(within)]
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, "PNG", dpi=(dpi, dpi))
    return buffer.getvalue()


def stack_of_axes(heights_in: Sequence[float], *, width_in: float = 6.8) -> AxesGrid:
    """Open a figure and return its axes of these heights, one above the other, (n_axes,); `svg` sets their margins.

    Until then they are as high as the figure: in lower axes, tick labels are not longer, and need no second layout.
    """
    sheet = new_figure((width_in, sum(heights_in)))
    axes = sheet.subplots(len(heights_in), 1, squeeze=False, height_ratios=list(heights_in))
    sheet.subplots_adjust(bottom=0.0, top=1.0, hspace=0.0)
    return np.asarray(axes[:, 0], dtype=np.object_)


def axes_or_panel(ax: Axes | None, *, height_in: float = 2.7) -> Axes:
    """Return the axes given, or those of a new figure of one panel, for `svg`."""
    panel: Axes = ax if ax is not None else stack_of_axes([height_in])[0]
    return panel


def lay_out(drawing: Axes | AxesGrid) -> Axes | AxesGrid:
    """Give a stack of axes margins for its labels; return the drawing."""
    figure_of(drawing).tight_layout(pad=0.4, h_pad=0.9)
    return drawing


def svg(drawing: Axes | AxesGrid) -> bytes:
    """Render a drawing's figure as SVG, reproducible byte for byte; a figure that a plot function opened is closed."""
    sheet = figure_of(lay_out(drawing))
    buffer, own = io.BytesIO(), sheet.canvas
    canvas: Any = FigureCanvasSVG(sheet)
    with mpl.rc_context({"svg.hashsalt": "probewise"}):
        canvas.print_svg(buffer, metadata={"Date": None})  # `savefig` would draw everything twice
    sheet.set_canvas(own)
    if sheet in _OPENED:
        plt.close(sheet)
    text = buffer.getvalue()
    return text[text.index(b"<svg") :]


def legend_above(ax: Axes, *, title: str = "") -> int:
    """Place the legend above the axes, in as many columns as fit, so that it never covers data.

    A label that is wider than the axes is broken into lines: otherwise the layout would leave no room for the axes.
    Returns the number of lines of text in the longest column, 0 without labels.
    """
    handles, labels = ax.get_legend_handles_labels()
    if not labels:
        return 0
    room = LETTERS_PER_IN * ax.get_position().width * figure_of(ax).get_figwidth()
    labels = [textwrap.fill(label, max(int(room) - _LINE_SAMPLE, 1)) for label in labels]

    def lines_by_column(n: int) -> list[list[str]]:
        """Return the lines of text in each of `n` columns; a legend is filled column by column."""
        columns = np.array_split(np.array(labels, dtype=np.object_), n)
        return ["\n".join(column).split("\n") for column in columns]

    def width(n: int) -> int:
        return sum(max(map(len, lines)) + _LINE_SAMPLE for lines in lines_by_column(n))

    n_columns = next((n for n in range(len(labels), 1, -1) if width(n) < room), 1)
    ax.legend(
        handles,
        labels,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=n_columns,
        frameon=False,
        fontsize=SMALL_PT,
        title=title or None,
        title_fontsize=SMALL_PT,
        alignment="left",
        borderaxespad=0.1,
        columnspacing=1.2,
    )
    return max(map(len, lines_by_column(n_columns)))


def set_plain_tick_labels(ax: Axes, *, x: bool = True, y: bool = True) -> None:
    """Write tick labels in full, without a factor or offset; with a power of ten if the axis spans less than 1e-5."""
    for axis in ([ax.xaxis] if x else []) + ([ax.yaxis] if y else []):
        low, high = axis.get_view_interval()
        if high - low > _LEAST_IN_FULL:
            in_full = ScalarFormatter(useOffset=False)
            in_full.set_scientific(False)
            axis.set_major_formatter(in_full)
        else:
            digits = 3 - math.floor(math.log10(max(high - low, 1e-300)))
            axis.set_major_formatter(
                FuncFormatter(lambda v, _, digits=digits: typeset_numbers(f"{round(v, digits) + 0.0:g}"))
            )


def legend_below(axes: Axes | AxesGrid, *, n_columns: int = 4, ground: str = "none", ink: str = BLACK) -> None:
    """Draw one legend for all axes of a figure with constrained layout, below them, with text of the colour `ink`."""
    every: list[Axes] = list(axes.flat) if isinstance(axes, np.ndarray) else [axes]
    handles = {label: handle for ax in every for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    sheet = figure_of(every[0])
    for earlier in [*sheet.legends]:
        earlier.remove()
    if handles:
        sheet.legend(
            list(handles.values()),
            list(handles),
            loc="outside lower center",
            ncols=min(n_columns, len(handles)),
            frameon=ground != "none",
            facecolor=ground,
            framealpha=1.0,
            edgecolor="none",
            labelcolor=ink,
            fontsize=SMALL_PT,
        )


def label_axes(ax: Axes, *, x: str, y: str, title: str = "") -> Axes:
    """Label both axes (without empty brackets), set the title, and hide the upper and right spines; return the axes."""
    ax.set_xlabel(_EMPTY_BRACKETS.sub("", x))
    ax.set_ylabel(_EMPTY_BRACKETS.sub("", y))
    if title:
        ax.set_title(title, **TITLE)
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def finish(ax: Axes, *, x: str, y: str, plain: str = "xy") -> Axes:
    """Label axes, write the ticks of the axes in `plain` in full, place the legend above; return the axes."""
    label_axes(ax, x=x, y=y)
    set_plain_tick_labels(ax, x="x" in plain, y="y" in plain)
    legend_above(ax)
    return ax


def hide_unused(axes: AxesGrid, n: int) -> None:
    """Hide all axes of a grid after the first `n`."""
    for ax in list(axes.flat)[n:]:
        ax.set_visible(False)


def draw_map(ax: Axes, values: FloatArray, x: FloatArray, y: FloatArray, **style: Any) -> AxesImage:
    """Draw values, (n_y, n_x), lower row first, as pixels about even places, (n_x,) and (n_y,); NaN is blank."""
    dx, dy = (x[1] - x[0]) / 2, (y[1] - y[0]) / 2
    extent = (float(x[0] - dx), float(x[-1] + dx), float(y[0] - dy), float(y[-1] + dy))
    return ax.imshow(np.ma.masked_invalid(values), origin="lower", extent=extent, interpolation="nearest", **style)


def paint_out_of_reach(ax: Axes) -> None:
    """Paint the axes' background grey, with an entry for the legend: what a map leaves blank is out of reach."""
    ax.set_facecolor(OUT_OF_REACH)
    ax.add_patch(Rectangle((0.0, 0.0), 0.0, 0.0, facecolor=OUT_OF_REACH, label="out of the arm's reach"))


def add_colour_bar(ax: Axes, image: ScalarMappable, label: str) -> Axes:
    """Add a colour bar beside axes, of the same height, or label the one there anew; return its axes."""
    if not ax.child_axes:
        ax.figure.colorbar(image, cax=ax.inset_axes((1.015, 0.0, 0.022, 1.0)))
    bar = cast(Axes, ax.child_axes[-1])
    bar.set_ylabel("\n".join(textwrap.wrap(label, 32)), fontsize=SMALL_PT)
    bar.tick_params(labelsize=SMALL_PT)
    return bar
