"""A robot's search: its view of the field (the paper's figures 2 and 8), and its progress from reading to reading."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Polygon
from matplotlib.ticker import MaxNLocator

from probewise._arrays import FloatArray
from probewise._words import count_with_noun
from probewise.report.plots import canvas

_NEXT_GREEN = "#00e08a"  # the palette's green, lighter, so that the next place shows on copper
_OUTLINE_BLUE = "#3fa7ff"  # likewise; hypotheses are blue, as in the paper
_DARK_EDGE = "#c8c8c8"  # edge of a square whose reading was dark
_GROUND = "#2a1a12"  # of the legend, as dark as the map at its darkest: everything on the map shows on it
_NOTHING = 1e-6  # of a utility: rounding


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
    ax: Axes | None = None,
) -> Axes:
    """Draw the field with the utility map, hypotheses and readings (paper, figures of the entropy map).

    Parameters
    ----------
    utility
        Utility of a reading at each place, such as its bits, (n_y, n_x), lower row first; NaN out of the arm's reach.
    x_mm, y_mm
        Places of the columns and rows, shapes (n_x,) and (n_y,).
    outlines_mm, truth_mm
        Outline of each sampled hypothesis, and of the true target, drawn dashed, (n_vertices, 2) each.
    places_mm, readings
        Places of the readings, shape (n_readings, 2), and their values, (n_readings,).
    levels
        Reading of black and of white, for the brightness of the squares.
    cards_mm
        Corners of each card whose place and albedo are known, (4, 2).
    """
    ax = canvas.axes_or_new(ax, size_in=(8.2, 5.2))
    top = float(np.nanmax(utility))
    top = top if top > _NOTHING else 1.0
    for earlier in (*ax.collections, *ax.lines, *ax.patches):  # of a frame before; its map and colour bar are kept
        earlier.remove()
    if ax.images:
        ax.images[0].set_data(np.ma.masked_invalid(utility))
        ax.images[0].set_extent(canvas.extent_of_map(x_mm, y_mm))
        ax.images[0].set_clim(0.0, top)
    else:
        canvas.draw_map(ax, utility, x_mm, y_mm, cmap=canvas.COPPER, vmin=0.0, vmax=top)
    canvas.add_colour_bar(ax, ax.images[0], utility_label)
    if np.isnan(utility).any():
        canvas.paint_out_of_reach(ax)
    if len(outlines_mm):
        ax.add_collection(LineCollection(list(outlines_mm), colors=_OUTLINE_BLUE, linewidths=0.7, alpha=0.75))
        ax.plot([], [], color=_OUTLINE_BLUE, label=f"{len(outlines_mm)} hypotheses drawn from the posterior")
    if truth_mm is not None:
        ax.plot(*truth_mm.T, color="white", linewidth=1.2, linestyle=(0, (3, 5)), label="the true target")
    for n, corners in enumerate(cards_mm):
        label = "" if n else "known card"
        ax.add_patch(Polygon(corners, fill=False, edgecolor="#ffd54a", linewidth=1.4, hatch="//", label=label))
    if places_mm is not None and readings is not None and len(places_mm):
        low, high = levels
        shade = np.clip((np.asarray(readings) - low) / max(high - low, 1e-9), 0, 1)
        colours: dict[str, Any] = {
            "c": np.repeat(shade[:, None], 3, axis=1),
            "edgecolors": np.where(shade < 0.5, _DARK_EDGE, canvas.BLACK),
        }
        ax.scatter(places_mm[:, 0], places_mm[:, 1], s=34, marker="s", linewidths=0.9, zorder=3, **colours)
        for name, colour in (("dark reading", "black"), ("reading between", "#909090"), ("bright reading", "white")):
            rim = _DARK_EDGE if colour == "black" else canvas.BLACK
            ax.plot([], [], "s", color=colour, markersize=6, markeredgecolor=rim, label=name)
    if next_mm is not None:
        style: dict[str, Any] = {
            "c": _NEXT_GREEN,
            "edgecolors": canvas.BLACK,
            "linewidths": 1.0,
            "zorder": 4,
            "label": "next place",
        }
        ax.scatter(*next_mm, s=52, marker="s", **style)
    left, right, low, high = ax.images[0].get_extent()
    ax.set(xlim=(left, right), ylim=(low, high), aspect="equal", xlabel="x (mm)", ylabel="y (mm)")
    if title:
        ax.set_title(title, **canvas.TITLE)
    return ax


def draw_field_legend(axes: Axes | canvas.AxesGrid) -> None:
    """Draw one legend for all playing fields of a figure, below them."""
    canvas.legend_below(axes, n_columns=3, ground=_GROUND, ink="white")


def posterior_widths(widths_mm: Mapping[str, FloatArray], *, target_mm: float = 4.0, ax: Axes | None = None) -> Axes:
    """Draw the largest posterior sd (mm) after each reading, (n_readings,), of each run by name, and the target.

    The default is the paper's stopping rule: 4 mm, half the spacing of LEGO holes (section 3.2).
    """
    ax = canvas.axes_or_new(ax, size_in=(6.4, 3.6))
    for k, (name, sd) in enumerate(widths_mm.items()):
        label = f"{name}: {count_with_noun(len(sd), 'reading')}"
        ax.plot(np.arange(1, len(sd) + 1), sd, label=label, **_dots_and_line(k))
    set_up_width_axes(ax, target_mm)
    canvas.legend_above(ax)
    return ax


def set_up_width_axes(ax: Axes, target_mm: float) -> Axes:
    """Label axes of posterior sds (log scale, mm) by number of readings, draw the target's line; return the axes."""
    ax.axhline(target_mm, color=canvas.BLACK, linestyle="--", label=f"target: {target_mm:g} mm")
    canvas.use_log_scale(ax, ticks=(1.0, 2.0, 5.0))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    return canvas.label_axes(ax, x="number of readings", y="widest posterior sd (mm)")


def information_gained(bits: Mapping[str, FloatArray], *, about: str = "the shape", ax: Axes | None = None) -> Axes:
    """Draw prior minus posterior differential entropy (bits) after each reading, (n_readings,), of each run by name.

    `about` says of what, in the axis's label.
    """
    ax = canvas.axes_or_new(ax, size_in=(6.4, 3.6))
    for k, (name, gained) in enumerate(bits.items()):
        per_reading = gained[-1] / len(gained) if len(gained) else 0.0
        label = f"{name}: {per_reading:.2f} bits per reading"
        ax.plot(np.arange(len(gained) + 1), np.r_[0.0, gained], label=label, **_dots_and_line(k))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    label = "\n".join(textwrap.wrap(f"information about {about} (bits)", 34))  # no longer than the axes are high
    return canvas.finish(ax, x="number of readings", y=label, plain=None)


def _dots_and_line(k: int) -> dict[str, Any]:
    return {"marker": "o", "markersize": 3.5, "color": canvas.CYCLE[k % len(canvas.CYCLE)]}
