"""The robot's view of the playing field: entropy map, hypotheses, readings, the next place (the paper's picture)."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.patches import Polygon as PolygonPatch
from matplotlib.patches import Rectangle
from numpy.typing import ArrayLike

from probewise._arrays import FloatArray
from probewise.report.plots.canvas import BLACK, COPPER, OUT_OF_REACH, SMALL_PT, AxesGrid, axes_or_new, legend_below

LEGO_UNIT_MM = 8.0  # spacing of the holes of a LEGO Technic part
NEXT_GREEN = "#00e08a"  # the palette's green, lighter, so that the next place shows on copper
CARD_YELLOW = "#ffd54a"
OUTLINE_BLUE = "#3fa7ff"  # likewise; hypotheses are blue, as in the paper
DARK_EDGE = "#c8c8c8"  # edge of a square whose reading was dark
GROUND = "#2a1a12"  # background of the legend, as dark as the map at its darkest: everything on the map shows on it

_NOTHING = 1e-9  # of a utility


def playing_field(
    utility: FloatArray,
    x_mm: FloatArray,
    y_mm: FloatArray,
    *,
    outlines_mm: Sequence[FloatArray] = (),
    places_mm: FloatArray | None = None,
    readings: FloatArray | None = None,
    levels: tuple[float, float] = (1.0, 100.0),
    next_mm: tuple[float, float] | None = None,
    truth_mm: FloatArray | None = None,
    cards_mm: Sequence[FloatArray] = (),
    title: str = "",
    utility_label: str = "entropy (bits)",
    utility_max: float | None = None,
    lego_scale: bool = False,
    ax: Axes | None = None,
) -> Axes:
    """Draw the field with the utility map, hypotheses and readings (paper, figures of the entropy map).

    Parameters
    ----------
    utility
        Utility of a reading at each place, such as its bits, (n_y, n_x), lower row first; NaN out of the arm's reach.
    x_mm, y_mm
        Places of the columns and rows, shapes (n_x,) and (n_y,).
    outlines_mm
        Outline of each sampled hypothesis, shape (n_vertices, 2) each.
    places_mm, readings
        Places of the readings, shape (n_readings, 2), and their values, (n_readings,).
    levels
        Reading of black and of white, for the brightness of the squares.
    next_mm
        The place chosen next.
    truth_mm
        Outline of the true target, drawn dashed; None if unknown.
    cards_mm
        Corners of each card whose place and albedo are known, (4, 2).
    title, utility_label
        Text of the figure and of its colour bar.
    utility_max
        Upper end of the colour scale, for comparable figures; default: the map's maximum.
    lego_scale
        Whether to add the paper's coordinates, LEGO distance units, at the top.
    ax
        Axes to draw on; a new figure without.
    """
    ax = axes_or_new(ax, size_in=(8.2, 5.2))
    dx, dy = (x_mm[1] - x_mm[0]) / 2, (y_mm[1] - y_mm[0]) / 2
    if np.isnan(utility).any():
        paint_out_of_reach(ax)
    top = utility_max if utility_max is not None else float(np.nanmax(utility))
    if top <= _NOTHING:
        top = 1.0  # a scale of nothing would have a power of ten
    image = ax.imshow(
        np.ma.masked_invalid(utility),
        origin="lower",
        extent=(x_mm[0] - dx, x_mm[-1] + dx, y_mm[0] - dy, y_mm[-1] + dy),
        cmap=COPPER,
        vmin=0.0,
        vmax=top,
        interpolation="nearest",
    )
    add_colour_bar(ax, image, utility_label)
    if len(outlines_mm):
        ax.add_collection(LineCollection(list(outlines_mm), colors=OUTLINE_BLUE, linewidths=0.7, alpha=0.75))
        ax.plot([], [], color=OUTLINE_BLUE, label=f"{len(outlines_mm)} hypotheses drawn from the posterior")
    if truth_mm is not None:
        dashes = (0, (5, 3))
        label = "the true target"
        ax.plot(truth_mm[:, 0], truth_mm[:, 1], color="white", linewidth=1.4, linestyle=dashes, label=label)
    for n, corners in enumerate(cards_mm):
        label = "" if n else "known card"
        card = PolygonPatch(corners, fill=False, edgecolor=CARD_YELLOW, linewidth=1.4, hatch="//", label=label)
        ax.add_patch(card)
    if places_mm is not None and readings is not None and len(places_mm):
        low, high = levels
        shade = np.clip((np.asarray(readings) - low) / max(high - low, 1e-9), 0, 1)
        face = np.repeat(shade[:, None], 3, axis=1)
        edge = [DARK_EDGE if s < 0.5 else BLACK for s in shade]
        ax.scatter(
            places_mm[:, 0], places_mm[:, 1], s=34, marker="s", c=face, edgecolors=edge, linewidths=0.9, zorder=3
        )
        for name, colour, rim in (("dark reading", "black", DARK_EDGE), ("bright reading", "white", BLACK)):
            ax.plot([], [], "s", color=colour, markersize=6, markeredgecolor=rim, label=name)
    if next_mm is not None:
        ax.scatter(
            *next_mm, s=52, marker="s", c=NEXT_GREEN, edgecolors=BLACK, linewidths=1.0, zorder=4, label="next place"
        )
    ax.set_xlim(x_mm[0] - dx, x_mm[-1] + dx)
    ax.set_ylim(y_mm[0] - dy, y_mm[-1] + dy)
    ax.set_aspect("equal")
    ax.set_xlabel("x (mm)")
    ax.set_ylabel("y (mm)")
    if lego_scale:
        _add_lego_scale(ax)
    if title:
        ax.set_title(title, fontsize="medium", loc="left")
    return ax


def draw_field_legend(axes: Axes | AxesGrid) -> None:
    """Draw one legend for all playing fields of a figure, below them."""
    legend_below(axes, n_columns=3, ground=GROUND, ink="white")


def paint_out_of_reach(ax: Axes) -> None:
    """Paint the axes' background grey, with an entry for the legend: what a map leaves blank is out of reach."""
    ax.set_facecolor(OUT_OF_REACH)
    ax.add_patch(Rectangle((0.0, 0.0), 0.0, 0.0, facecolor=OUT_OF_REACH, label="out of the arm's reach"))


def add_colour_bar(ax: Axes, image: ScalarMappable, label: str) -> None:
    """Add a colour bar beside axes, of the same height."""
    ax.figure.colorbar(image, cax=ax.inset_axes((1.015, 0.0, 0.022, 1.0)))
    bar = ax.child_axes[-1]
    bar.set_ylabel("\n".join(textwrap.wrap(label, 32)), fontsize=SMALL_PT)
    bar.tick_params(labelsize=SMALL_PT)


def _add_lego_scale(ax: Axes) -> None:
    lego = ax.secondary_xaxis("top", functions=(_to_lego, _from_lego))
    lego.set_xlabel("LEGO distance units (8 mm)", fontsize=SMALL_PT)
    lego.tick_params(labelsize=SMALL_PT)


def _to_lego(mm: ArrayLike) -> FloatArray:
    return np.asarray(mm, dtype=np.float64) / LEGO_UNIT_MM


def _from_lego(units: ArrayLike) -> FloatArray:
    return np.asarray(units, dtype=np.float64) * LEGO_UNIT_MM
