"""Figures and axes, the palette, maps, legends, and rendering to PNG and SVG.

Without axes, a plot function opens a pyplot figure, so that `plt.savefig` and `plt.show` find it; `png` and
`svg` close it, so that a page of many pictures leaves none open.
"""

from __future__ import annotations

import contextlib
import io
import re
import textwrap
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any, Literal, TypeAlias, cast
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
from matplotlib.layout_engine import LayoutEngine
from matplotlib.patches import Rectangle
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from PIL import Image, ImageChops, ImageOps

from probewise._arrays import FloatArray
from probewise._kinds import require_kind

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

_TICK_IN = 0.8  # width of a tick with its label, of six digits
_LINE_SAMPLE = 6  # letters that the sample of the line or colour before a label takes
_AXES = "axes of matplotlib: figure.add_subplot(), figure.subplots(), or None for a figure of its own"
_MARGIN_IN = 0.1  # about a cropped picture, as matplotlib leaves it
_EMPTY_BRACKETS = re.compile(r"\s*\(\)$")

AxesGrid: TypeAlias = NDArray[Any]

PAGE_IN, PANEL_IN = 9.6, 6.8
"""Width of a report's column: a wider drawing is shrunk, and its text with it; width of a drawing of one column."""

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


def axes_or_new(ax: Axes | None, *, size_in: tuple[float, float] = (PANEL_IN, 2.7)) -> Axes:
    """Return the axes given, or those of a new figure; ParameterError for anything else, such as a figure."""
    if ax is not None:
        require_kind("ax", ax, Axes, _AXES)
    return ax if ax is not None else grid_of_axes(1, 1, size_in=size_in)[0, 0]


def grid_of_axes(n_rows: int, n_columns: int, *, size_in: tuple[float, float], **options: Any) -> AxesGrid:
    """Open a pyplot figure, which `png` or `svg` will close; return its axes, (n_rows, n_columns).

    The options go to `Figure.subplots`.
    """
    sheet = plt.figure(figsize=size_in, layout="constrained")
    _OPENED.add(sheet)
    return np.asarray(sheet.subplots(n_rows, n_columns, squeeze=False, **options), dtype=np.object_)


def stack_of_axes(heights_in: Sequence[float]) -> AxesGrid:
    """Open a figure and return its axes of these heights, one above the other, (n_axes,)."""
    size_in = (PANEL_IN, sum(heights_in))
    return grid_of_axes(len(heights_in), 1, size_in=size_in, height_ratios=list(heights_in))[:, 0]


@lru_cache(maxsize=1)
def axes_of_frame() -> Axes:
    """Return the axes of an animation's frames, the same for each, with room for colour bar and legend.

    Who draws a frame replaces what was drawn before: new axes, with new ticks, take most of the time of a frame, and a
    layout that measures the labels as long again.
    """
    return Figure((8.4, 4.7)).add_axes((0.09, 0.24, 0.77, 0.69))


def figure_of(drawing: Axes | AxesGrid | Figure) -> Figure:
    """Return the figure that axes belong to; none of ours has subfigures."""
    first = drawing.flat[0] if isinstance(drawing, np.ndarray) else drawing
    return first if isinstance(first, Figure) else cast(Figure, first.figure)


@contextlib.contextmanager
def text_as_it_is(sheet: Figure) -> Iterator[None]:
    """Take no name for a formula, since a `$` may stand in one, and send no text to LaTeX, whatever style is set."""
    for text in sheet.findobj(Text):
        text.set_usetex(False)
        if "\\mathdefault" not in text.get_text():  # of numbers along a logarithmic axis
            text.set_parse_math("$" not in text.get_text())
    with mpl.rc_context({"text.usetex": False}):  # also of ticks that are made while it is drawn
        yield


def png(drawing: Axes | AxesGrid | Figure, *, dpi: int = 110, tight: bool = True) -> bytes:
    """Render a drawing's figure as PNG; a figure that a plot function opened is closed, others stay open.

    `tight` crops empty margins. Without it, figures of equal size give PNGs of equal size, as an animation needs.
    """
    sheet, buffer = figure_of(drawing), io.BytesIO()
    own, own_dpi = sheet.canvas, sheet.dpi
    agg: Any = FigureCanvasAgg(sheet)  # `savefig` would draw everything twice, and measure it a third time
    sheet.dpi = dpi
    try:
        with text_as_it_is(sheet):
            agg.draw()
    finally:
        sheet.set_canvas(own)
        sheet.dpi = own_dpi
    if sheet in _OPENED:
        plt.close(sheet)
    picture = Image.fromarray(np.asarray(agg.buffer_rgba())).convert("RGB")
    if tight and (inked := ImageChops.invert(picture).getbbox()) is not None:
        margin = round(_MARGIN_IN * dpi)
        picture = ImageOps.expand(picture.crop(inked), margin, "white")
    picture.save(buffer, "PNG", dpi=(dpi, dpi))
    return buffer.getvalue()


def svg(drawing: Axes | AxesGrid) -> bytes:
    """Render a drawing's figure as SVG, reproducible byte for byte; a figure that a plot function opened is closed."""
    sheet, buffer = figure_of(drawing), io.BytesIO()
    own, canvas = sheet.canvas, cast(Any, FigureCanvasSVG(sheet))
    with text_as_it_is(sheet), mpl.rc_context({"svg.hashsalt": "probewise"}):
        canvas.print_svg(buffer, metadata={"Date": None})  # `savefig` would draw everything twice
    sheet.set_canvas(own)
    if sheet in _OPENED:
        plt.close(sheet)
    return buffer.getvalue()[buffer.getvalue().index(b"<svg") :]


def legend_above(ax: Axes, *, title: str = "") -> None:
    """Place the legend above the axes, in as many columns as fit, so that it never covers data; long labels wrap."""
    handles, labels = ax.get_legend_handles_labels()
    if not labels:
        return
    room = LETTERS_PER_IN * ax.get_position().width * figure_of(ax).get_figwidth()
    labels = [textwrap.fill(label, max(int(room) - _LINE_SAMPLE, 1)) for label in labels]
    widest = max(len(line) for label in labels for line in label.split("\n")) + _LINE_SAMPLE
    style: dict[str, Any] = {"frameon": False, "fontsize": SMALL_PT, "title_fontsize": SMALL_PT, "alignment": "left"}
    place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.1}
    ax.legend(handles, labels, ncols=max(int(room / widest), 1), title=title or None, **place, **style)


def fit_to_room(ax: Axes) -> None:
    """Lay the figure out, and fit legend and ticks of some axes to the width that long labels of others leave them."""
    sheet = figure_of(ax)
    with text_as_it_is(sheet):
        cast(LayoutEngine, sheet.get_layout_engine()).execute(sheet)
    legend_above(ax)
    if isinstance(ax.xaxis.get_major_locator(), MaxNLocator):
        width_in = ax.get_position().width * sheet.get_figwidth()
        ax.xaxis.set_major_locator(MaxNLocator(max(int(width_in / _TICK_IN), 2), steps=[1, 2, 2.5, 5, 10]))


def legend_below(axes: Axes | AxesGrid, *, n_columns: int = 4, ground: str = "none", ink: str = BLACK) -> None:
    """Draw one legend for all axes of a figure, below them, with text of the colour `ink`."""
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


def finish(ax: Axes, *, x: str, y: str, plain: Literal["x", "y", "both"] | None = "both") -> Axes:
    """Label axes, write the ticks of the axes `plain` without an offset, place the legend above; return the axes."""
    label_axes(ax, x=x, y=y)
    if plain:
        ax.ticklabel_format(axis=plain, useOffset=False)
    legend_above(ax)
    return ax


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
