"""Many runs at once: how fast they learn, and what each row of a study needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import FloatArray
from probewise.report.plots.canvas import (
    BLUE,
    CYCLE,
    GREY,
    VERMILLION,
    AxesGrid,
    axes_or_new,
    grid_of_axes,
    tidy,
)
from probewise.report.plots.progress import towards_target
from probewise.study import Summary

__all__ = ["readings_needed", "widths_of_runs"]

_BAND = (0.16, 0.84)


def widths_of_runs(runs: Mapping[str, Sequence[FloatArray]], *, target_mm: float = 4.0, ax: Axes | None = None) -> Axes:
    """Draw the widest posterior sd against the number of readings: median and middle 68 % of many runs.

    A run that has ended stays at its last width.

    Parameters
    ----------
    runs
        By name: of each run the widest posterior sd after each reading, (n_readings,), mm.
    target_mm
        The precision asked for.
    ax
        Axes to draw on; a new figure without.
    """
    ax = axes_or_new(ax, size_in=(6.8, 4.0))
    for (name, widths), colour in zip(runs.items(), CYCLE, strict=False):
        longest = max(len(w) for w in widths)
        table = np.array([np.pad(w, (0, longest - len(w)), mode="edge") for w in widths])
        number = np.arange(1, longest + 1)
        low, high = np.quantile(table, _BAND, axis=0)
        ax.fill_between(number, low, high, color=colour, alpha=0.18, linewidth=0)
        ax.plot(number, np.median(table, axis=0), color=colour, label=f"{name} ({len(widths)} runs)")
    ax.legend(frameon=False, fontsize="small", loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
    return towards_target(ax, target_mm)


def readings_needed(rows: Mapping[str, Summary], *, axes: AxesGrid | None = None) -> AxesGrid:
    """Draw what each row of a study needs: mean and median in all, and after the first reading on white.

    Parameters
    ----------
    rows
        Summary by name, drawn from the top in this order.
    axes
        Axes to draw on, (1, 2), with one y axis; a new figure without.

    Returns
    -------
    Axes, (1, 2).
    """
    names = list(rows)
    if axes is None:
        axes = grid_of_axes(1, 2, size_in=(9.0, 1.2 + 0.34 * len(names)), sharey=True)
    y = np.arange(len(names))
    for ax, parts, title in (
        (axes[0, 0], (("mean", BLUE, -0.14), ("median", VERMILLION, 0.14)), "in all"),
        (axes[0, 1], (("after_white", BLUE, 0.0),), "after the first on white"),
    ):
        for part, colour, shift in parts:
            estimates = [getattr(summary, part) for summary in rows.values()]
            value, low, high = (np.array([getattr(e, k) for e in estimates]) for k in ("value", "low", "high"))
            whiskers = np.array([value - low, high - value])
            label = "mean ± standard error" if part != "median" else "median, 95 % interval"
            ax.errorbar(value, y + shift, xerr=whiskers, fmt="o", color=colour, markersize=5, capsize=3, label=label)
        ax.set_xlim(left=0)
        ax.grid(axis="x", color=GREY, alpha=0.25)
        ax.set_yticks(y, names)
        tidy(ax, x="readings", y="", title=title)
    axes[0, 0].invert_yaxis()
    axes[0, 0].legend(frameon=False, fontsize="small", loc="lower left", bbox_to_anchor=(0.0, 1.04))
    return axes
