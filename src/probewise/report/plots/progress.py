"""Progress of a run: posterior sd and information against the number of readings."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from probewise._arrays import FloatArray
from probewise._words import count_with_noun
from probewise.report.plots.canvas import BLACK, CYCLE, SMALL_PT, axes_or_new, label_axes, legend_above


def posterior_widths(widths_mm: Mapping[str, FloatArray], *, target_mm: float = 4.0, ax: Axes | None = None) -> Axes:
    """Draw the largest posterior sd of a parameter after each reading, and the target precision.

    Parameters
    ----------
    widths_mm
        By name of the run: largest posterior sd after each reading, shape (n_readings,), in mm.
    target_mm
        The stopping rule: 4 mm, half the spacing of LEGO holes (paper, section 3.2).
    ax
        Axes to draw on; a new figure without.
    """
    ax = axes_or_new(ax, size_in=(6.4, 3.6))
    for (name, sd), colour in zip(widths_mm.items(), itertools.cycle(CYCLE), strict=False):
        number = np.arange(1, len(sd) + 1)
        ax.plot(
            number, sd, marker="o", markersize=3.5, color=colour, label=f"{name}: {count_with_noun(len(sd), 'reading')}"
        )
    legend_above(ax)
    return set_up_width_axes(ax, target_mm)


def set_up_width_axes(ax: Axes, target_mm: float) -> Axes:
    """Label axes of posterior sds (log scale, mm) by number of readings, draw the target's line; return the axes."""
    ax.axhline(target_mm, color=BLACK, linewidth=0.9, linestyle="--")
    ax.annotate(
        f"{target_mm:g} mm,\ntarget",
        (1.0, target_mm),
        xycoords=("axes fraction", "data"),
        xytext=(4, 0),
        textcoords="offset points",
        va="center",
        fontsize=SMALL_PT,
    )
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    return label_axes(ax, x="number of readings", y="widest posterior sd (mm)")


def information_gained(bits: Mapping[str, FloatArray], *, ax: Axes | None = None) -> Axes:
    """Draw the cumulative information in bits after each reading.

    Parameters
    ----------
    bits
        By name of the run: prior minus posterior differential entropy after each reading, shape (n_readings,), in bits.
    ax
        Axes to draw on; a new figure without.
    """
    ax = axes_or_new(ax, size_in=(6.4, 3.6))
    for (name, gained), colour in zip(bits.items(), itertools.cycle(CYCLE), strict=False):
        per_reading = gained[-1] / len(gained) if len(gained) else 0.0
        ax.plot(
            np.arange(len(gained) + 1),
            np.r_[0.0, gained],
            marker="o",
            markersize=3.5,
            color=colour,
            label=f"{name}: {per_reading:.2f} bits per reading",
        )
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    legend_above(ax)
    return label_axes(ax, x="number of readings", y="information about the shape (bits)")
