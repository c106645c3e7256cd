"""A study of the robot with concealed faults: runs that doubt the sensor model beside runs that trust it, by effect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from probewise.diagnosis.effect_words import effect_has_words, effect_in_words
from probewise.report.plots.canvas import (
    BLUE,
    GREY,
    PAGE_IN,
    VERMILLION,
    AxesGrid,
    axes_or_grid,
    label_axes,
    legend_below,
)
from probewise.study import ConcealedRow
from probewise.study.table import Estimate

_PANELS = (
    ("sure_and_wrong", "sure and wrong", "share of the runs"),
    ("intervals_hold", "95 % intervals that hold", "share of the intervals"),
    ("readings", "readings, median", "number"),
)


def effect_and_size_in_words(row: ConcealedRow) -> str:
    """Name a row: the concealed effect in words and, if it has one, its size."""
    name = effect_in_words(row.concealed) if effect_has_words(row.concealed) else row.concealed.replace("_", " ")
    return name if row.size is None else f"{name}, {row.size:g}"


def doubt_against_trust(rows: Sequence[ConcealedRow], *, axes: AxesGrid | None = None) -> AxesGrid:
    """Compare doubt in the sensor model with trust: runs sure and wrong, intervals that hold, median readings.

    Parameters
    ----------
    rows
        From `study.concealed_rows`, drawn from the top in this order.
    axes
        Axes to draw on, (1, 3), with one y axis; a new figure without.

    Returns
    -------
    Axes, (1, 3).
    """
    names = list(dict.fromkeys(effect_and_size_in_words(row) for row in rows))
    own = axes is None
    axes = axes_or_grid(axes, 1, 3, size_in=(PAGE_IN, 1.7 + 0.32 * len(names)), sharey=True)
    arms: Mapping[str, tuple[list[ConcealedRow], str, str, float]] = {
        "trusts its sensor": ([row for row in rows if row.trust == 1], VERMILLION, "s", 0.15),
        "doubts its sensor": ([row for row in rows if row.trust < 1], BLUE, "o", -0.15),
    }
    for ax, (field, title, x) in zip(axes[0], _PANELS, strict=True):
        for label, (those, colour, marker, shift) in arms.items():
            y = np.array([names.index(effect_and_size_in_words(row)) for row in those]) + shift
            values = [getattr(row, field) for row in those]
            style = {"fmt": marker, "color": colour, "markersize": 4.5, "label": label}
            if all(isinstance(value, Estimate) for value in values):
                value, low, high = (np.array([getattr(e, k) for e in values]) for k in ("value", "low", "high"))
                # Rounding may put an end a hair inside the value.
                ax.errorbar(value, y, xerr=np.maximum([value - low, high - value], 0.0), capsize=2.5, **style)
            else:
                ax.errorbar(values, y, **style)
        ax.set_xlim(*((0, None) if field == "readings" else (-0.03, 1.03)))
        if field == "intervals_hold":
            ax.axvline(0.95, color=GREY, linewidth=0.9, linestyle="--")
        ax.grid(axis="x", color=GREY, alpha=0.25)
        ax.set_yticks(np.arange(len(names)), names)
        label_axes(ax, x=x, y="", title=title)
    axes[0, 0].set_ylim(len(names) - 0.5, -0.5)
    if own:
        legend_below(axes)
    return axes
