"""Figures and axes, the palette, maps, legends, and rendering to PNG and SVG.

Without axes, a plot function opens a pyplot figure, so that `plt.savefig` and `plt.show` find it; `png` and
`svg` close it, so that a page of many pictures leaves none open.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import re
import textwrap
from collections.abc import Iterator, Sequence
from functools import cache, lru_cache
from typing import Any, Literal, TypeAlias, cast
from weakref import WeakKeyDictionary, WeakSet

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.image import AxesImage
from matplotlib.layout_engine import LayoutEngine
from matplotlib.legend import Legend
from matplotlib.patches import Rectangle
from matplotlib.text import Text
from matplotlib.ticker import LogLocator, NullFormatter
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

_MOST_STEPS = 6  # along the x axis: a tick and its label take a hundredth of a figure's time each
_AXES = "axes of matplotlib: figure.add_subplot(), figure.subplots(), or None for a figure of its own"
_MARGIN_IN = 0.1  # about a cropped picture, as matplotlib leaves it
_PAD_IN = 0.05  # between axes, and around a label
_TICK_IN = 0.1  # of a tick and the gap before its label
_LINE, _NEXT_LINE = 1.2, 1.4  # height of one line, and of each that follows, in sizes of its font
_BAR_ENDS = 0.037  # of the width of axes, right of which their colour bar ends
_EMPTY_BRACKETS = re.compile(r"\s*\(\)$")

AxesGrid: TypeAlias = NDArray[Any]

PAGE_IN, PANEL_IN = 9.6, 6.8
"""Width of a report's column: a wider drawing is shrunk, and its text with it; width of a drawing of one column."""

SMALL_PT = 9.0
"""The smallest font size of any drawing: 8.5 pt or more on a page."""

OUT_OF_REACH = "#d9d9d9"
"""Colour of places out of the arm's reach, in every drawing of the field."""

_OPENED: WeakSet[Figure] = WeakSet()  # figures that plot functions opened: `png` closes them, and no others
# Of the figure of frames: what stays, and of what. Its canvas would keep the figure here for ever.
_STILL: WeakKeyDictionary[Figure, tuple[Any, Any]] = WeakKeyDictionary()
_COLUMNS: WeakKeyDictionary[Legend, int] = WeakKeyDictionary()  # of legends above axes, or below all of a figure

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


def grid_of_axes(
    n_rows: int, n_columns: int, *, size_in: tuple[float, float], aligned: bool = True, **options: Any
) -> AxesGrid:
    """Open a pyplot figure, which `png` or `svg` will close; return its axes, (n_rows, n_columns).

    `aligned` is that of `Margins`; the other options go to `Figure.subplots`.
    """
    sheet = plt.figure(figsize=size_in, layout=Margins(aligned=aligned))
    _OPENED.add(sheet)
    axes: AxesGrid = np.asarray(sheet.subplots(n_rows, n_columns, squeeze=False, **options), dtype=np.object_)
    for ax in axes.flat:
        ax.xaxis.get_major_locator().set_params(nbins=_MOST_STEPS)
    return axes


def stack_of_axes(heights_in: Sequence[float], *, aligned: bool = True) -> AxesGrid:
    """Open a figure and return its axes of these heights, one above the other, (n_axes,); `aligned` as in `Margins`."""
    size_in = (PANEL_IN, sum(heights_in))
    return grid_of_axes(len(heights_in), 1, size_in=size_in, aligned=aligned, height_ratios=list(heights_in))[:, 0]


class Margins(LayoutEngine):
    """Places the axes of a grid before a figure is drawn, with margins for the texts about them.

    The room of a text is known by the widths of its letters: constrained layout draws a figure twice to measure it.
    Each row has one margin above and one below, each column one on either side; unless `aligned`, where there is one
    column, all axes have their own.
    """

    _adjust_compatible = _colorbar_gridspec = False

    def __init__(self, *, aligned: bool = True) -> None:
        super().__init__()
        self._aligned = aligned

    def execute(self, fig: Figure) -> None:
        """Place the axes, then again with the ticks that fit there, and with the legends that fit beside these."""
        for _ in range(3):
            _place_axes(fig, aligned=self._aligned)


def _place_axes(sheet: Figure, *, aligned: bool) -> None:
    cells = [(ax, spec) for ax in sheet.axes if (spec := ax.get_subplotspec()) is not None]
    grid = cells[0][1].get_gridspec()
    left, right, below, above = sides = [np.zeros(n) for n in (grid.ncols, grid.ncols, grid.nrows, grid.nrows)]
    for ax, spec in cells:
        column, row = spec.colspan.start, spec.rowspan.start
        for side, place, room in zip(sides, (column, column, row, row), _rooms_about_in(ax), strict=True):
            side[place] = max(side[place], room)
    head = sum(_size_in(text)[1] + _PAD_IN for text in sheet.texts)
    foot = sum(map(_legend_height_in, sheet.legends))
    size, taken = sheet.get_size_inches(), [(left + right).sum(), (above + below).sum() + head + foot]
    ratios = grid.get_width_ratios() or [1.0] * grid.ncols, grid.get_height_ratios() or [1.0] * grid.nrows
    shares = [np.array(each) / np.sum(each) for each in ratios]
    widths, heights = (max(n - t, 0.2 * n) * share for n, t, share in zip(size, taken, shares, strict=True))
    for ax, spec in cells:
        column, row = spec.colspan.start, spec.rowspan.start
        if not aligned:
            (left[0], right[0], *_) = _rooms_about_in(ax)
            widths[0] = size[0] - left[0] - right[0]
        x = left[: column + 1].sum() + (right + widths)[:column].sum()
        y = size[1] - head - (above + heights)[: row + 1].sum() - below[:row].sum()
        ax.set_position((x / size[0], y / size[1], widths[column] / size[0], heights[row] / size[1]))
        ax.set_in_layout(True)
        if (legend := ax.get_legend()) is not None and legend in _COLUMNS:
            legend_above(ax, title=legend.get_title().get_text())


def _rooms_about_in(ax: Axes) -> tuple[float, float, float, float]:
    """Return the room that the texts of axes need on the left, on the right, below and above, in inches."""
    if not ax.get_visible():
        return 0.0, 0.0, 0.0, 0.0
    titles = [ax.get_title(), ax.get_title("left"), ax.yaxis.get_offset_text().get_text()]
    above = [_height_in(text, mpl.rcParams["font.size"]) + _PAD_IN for text in titles if text]
    above += [_beyond_in(ax, 1), _legend_height_in(ax.get_legend())]
    right = _beyond_in(ax, 0)
    for bar in ax.child_axes:
        right = _BAR_ENDS * ax.get_position().width * figure_of(ax).get_figwidth() + _axis_room_in(bar.yaxis, 0)
    return _axis_room_in(ax.yaxis, 0), right + _PAD_IN, _axis_room_in(ax.xaxis, 1), max(above) + _PAD_IN


def _beyond_in(ax: Axes, side: int) -> float:
    """Return how far tick labels reach to the right of axes (`side` 0), or above them (1)."""
    end, dpi = (ax.bbox.x1, ax.bbox.y1)[side], figure_of(ax).dpi
    texts = (ax.get_xticklabels, ax.get_yticklabels)[side]()
    places = [text.get_transform().transform(text.get_position())[side] for text in texts]
    reached = [_size_in(t)[side] / 2 + (at - end) / dpi for t, at in zip(texts, places, strict=True) if at <= end + 1]
    return max([0.0, *map(float, reached)])


def _axis_room_in(axis: Axis, side: int) -> float:
    ticks = max((_size_in(text)[side] for text in axis.get_majorticklabels()), default=0.0)
    label = _size_in(axis.label)[side]
    return (ticks + _TICK_IN if ticks else 0.0) + (label + _PAD_IN if label else 0.0) + _PAD_IN


def _legend_height_in(legend: Legend | None) -> float:
    if legend is None or legend not in _COLUMNS:
        return 0.0
    heights = np.array([_size_in(text)[1] + 0.5 * SMALL_PT / 72 for text in legend.get_texts()])
    return max(map(sum, np.array_split(heights, _COLUMNS[legend]))) + _size_in(legend.get_title())[1] + _PAD_IN


def _size_in(text: Text) -> tuple[float, float]:
    """Return the width and the height of a text, (0, 0) if nothing is shown."""
    if not text.get_visible() or not text.get_text():
        return 0.0, 0.0
    size, turn = float(text.get_fontsize()), np.radians(text.get_rotation())
    wide, high = _width_in(text.get_text(), size), _height_in(text.get_text(), size)
    across, along = abs(np.cos(turn)), abs(np.sin(turn))
    return wide * across + high * along, wide * along + high * across


def _height_in(text: str, size_pt: float) -> float:
    return size_pt / 72 * (_LINE + _NEXT_LINE * text.count("\n"))


def _width_in(text: str, size_pt: float = SMALL_PT) -> float:
    """Return the width of a text's longest line; 5 % more than by its letters, as hinted ones are wider."""
    return 1.05 * size_pt / 72 * max(sum(map(_letter_em, line)) for line in text.split("\n"))


@cache
def _letter_em(letter: str) -> float:
    font = get_font(findfont(FontProperties()))
    font.set_size(10, 72)
    return font.load_char(ord(letter)).linearHoriAdvance / 655360


@lru_cache(maxsize=1)
def axes_of_frame(n: int = 1) -> AxesGrid:
    """Return the `n` axes of an animation's frames, (n,), at the same place in each, above room for the legend.

    Who draws a frame replaces what was drawn before: new axes, with new ticks, take most of the time of a frame.
    """
    height_in = 0.6 + 4.1 * n
    sheet, bottoms_in = Figure((8.4, height_in), dpi=90), [1.13 + 4.1 * k for k in reversed(range(n))]
    return np.array([sheet.add_axes((0.09, low / height_in, 0.77, 3.24 / height_in)) for low in bottoms_in])


def rendered_frame(ax: Axes) -> bytes:
    """Render the axes of a frame as PNG; both axis labels with their ticks, and the legend, are drawn once for all."""
    sheet, inside = figure_of(ax), (ax.images, ax.collections, ax.lines, ax.patches, ax.spines.values(), ax.child_axes)
    (title,) = (text for text in ax.get_children() if isinstance(text, Text) and text.get_text())
    moving = sorted([title, *itertools.chain(*inside)], key=lambda artist: artist.get_zorder())
    labels = [text.get_text() for legend in sheet.legends for text in legend.get_texts()]
    still = [*labels, *ax.get_xlim(), *ax.get_ylim()]
    agg: Any = sheet.canvas if isinstance(sheet.canvas, FigureCanvasAgg) else FigureCanvasAgg(sheet)
    region, drawn = _STILL.get(sheet, (None, None))
    if drawn != still:
        try:
            for artist in moving:
                artist.set_visible(False)
            with text_as_it_is(sheet):
                agg.draw()
        finally:
            for artist in moving:
                artist.set_visible(True)
        _STILL[sheet] = region, _ = agg.copy_from_bbox(sheet.bbox), still
    agg.restore_region(region)
    for artist in moving:
        artist.draw(agg.get_renderer())
    return _png_of(agg, sheet.dpi, tight=False)


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
    sheet = figure_of(drawing)
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
    return _png_of(agg, dpi, tight=tight)


def _png_of(agg: FigureCanvasAgg, dpi: float, *, tight: bool) -> bytes:
    picture, buffer = Image.fromarray(np.asarray(cast(Any, agg).buffer_rgba())).convert("RGB"), io.BytesIO()
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
    room, em = ax.get_position().width * figure_of(ax).get_figwidth(), SMALL_PT / 72
    labels = [textwrap.fill(t, max(int(len(t) * (room - 2.8 * em) / _width_in(t)), 1)) for t in labels]
    widths = [_width_in(label) + 4.8 * em for label in labels]  # of the line before it and the gap after it, too
    counts = range(len(labels), 1, -1)
    columns = next((n for n in counts if sum(map(max, np.array_split(widths, n))) <= room + 2 * em), 1)
    earlier = ax.get_legend()
    if earlier and (columns, labels) == (_COLUMNS.get(earlier), [text.get_text() for text in earlier.get_texts()]):
        return
    style: dict[str, Any] = {"frameon": False, "fontsize": SMALL_PT, "title_fontsize": SMALL_PT, "alignment": "left"}
    place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.1}
    _COLUMNS[ax.legend(handles, labels, ncols=columns, title=title or None, **place, **style)] = columns


def legend_below(axes: Axes | AxesGrid, *, n_columns: int = 4, ground: str = "none", ink: str = BLACK) -> None:
    """Draw one legend for all axes of a figure, below them, with text of the colour `ink`."""
    every: list[Axes] = list(axes.flat) if isinstance(axes, np.ndarray) else [axes]
    handles = {label: handle for ax in every for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    sheet = figure_of(every[0])
    for earlier in [*sheet.legends]:
        earlier.remove()
    if handles:
        style: dict[str, Any] = {"facecolor": ground, "framealpha": 1.0, "edgecolor": "none", "labelcolor": ink}
        columns = min(n_columns, len(handles))
        place: dict[str, Any] = {"loc": "outside lower center", "ncols": columns, "frameon": ground != "none"}
        _COLUMNS[sheet.legend([*handles.values()], [*handles], fontsize=SMALL_PT, **place, **style)] = columns


def use_log_scale(ax: Axes, *, ticks: Sequence[float]) -> None:
    """Give axes a logarithmic y axis with plain numbers, of each decade these `ticks`; formulas take long to set."""
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=ticks))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter(NullFormatter())


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
    where: dict[str, Any] = {"origin": "lower", "extent": extent_of_map(x, y)}
    return ax.imshow(np.ma.masked_invalid(values), interpolation="nearest", **where, **style)


def extent_of_map(x: FloatArray, y: FloatArray) -> tuple[float, float, float, float]:
    """Return the outer edges of pixels about even places: left, right, below, above."""
    dx, dy = (x[1] - x[0]) / 2, (y[1] - y[0]) / 2
    return float(x[0] - dx), float(x[-1] + dx), float(y[0] - dy), float(y[-1] + dy)


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
