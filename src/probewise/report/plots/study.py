"""Many runs at once: posterior widths by reading, and readings needed in each row of a study."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import count_with_noun
from probewise.report.plots.canvas import (
    BLUE,
    GREY,
    PAGE_IN,
    SMALL_PT,
    VERMILLION,
    AxesGrid,
    axes_or_grid,
    label_axes,
    legend_below,
)
from probewise.report.plots.progress import set_up_width_axes
from probewise.study import Summary

_BAND = (0.16, 0.84)


def posterior_widths_of_runs(
    runs: Mapping[str, Sequence[FloatArray]], *, target_mm: float = 4.0, axes: AxesGrid | None = None
) -> AxesGrid:
    """Draw the widest posterior sd after each reading: median and middle 68 % of the runs, one panel per row.

    Thin lines are the medians of the other panels. A run that has ended keeps its last width.

    Parameters
    ----------
    runs
        For each row, by name: the widest posterior sd after each reading of every run, (n_readings,), mm.
    target_mm
        Target precision.
    axes
        Axes to draw on, of the shape returned; a new figure without.

    Returns
    -------
    Axes, (n_rows, 2), or (1, 1) for a single name.
    """
    n_columns = min(len(runs), 2)
    n_rows = -(-len(runs) // max(n_columns, 1))
    own = axes is None
    size_in = (PAGE_IN if n_columns == 2 else 6.8, 0.5 + 2.9 * n_rows)
    axes = axes_or_grid(axes, n_rows, n_columns, size_in=size_in, sharex=True, sharey=True)
    tables = {name: _extended_at_last_width(widths) for name, widths in runs.items()}
    for ax, (name, table) in zip(axes.flat, tables.items(), strict=False):
        for other, more in tables.items():
            if other != name:
                label = "median of another panel"
                ax.plot(_reading_numbers(more), np.median(more, axis=0), color=GREY, linewidth=0.9, label=label)
        low, high = np.quantile(table, _BAND, axis=0)
        ax.fill_between(
            _reading_numbers(table), low, high, color=BLUE, alpha=0.2, linewidth=0, label="middle 68 % of the runs"
        )
        ax.plot(_reading_numbers(table), np.median(table, axis=0), color=BLUE, linewidth=1.8, label="median")
        set_up_width_axes(ax, target_mm)
        ax.set_title(f"{name} ({count_with_noun(len(table), 'run')})", fontsize="medium", loc="left")
        ax.label_outer()
    for ax in list(axes.flat)[len(runs) :]:
        ax.set_visible(False)
        axes.flat[len(runs) - n_columns].xaxis.set_tick_params(labelbottom=True)
        axes.flat[len(runs) - n_columns].set_xlabel("number of readings")
    if own:
        legend_below(axes)
    else:
        axes.flat[0].legend(frameon=False, fontsize=SMALL_PT)
    return axes


def _extended_at_last_width(widths: Sequence[FloatArray]) -> FloatArray:
    """Extend every run at its last width to the length of the longest: (n_runs, n_readings)."""
    longest = max(len(w) for w in widths)
    return np.array([np.pad(w, (0, longest - len(w)), mode="edge") for w in widths])


def _reading_numbers(table: FloatArray) -> FloatArray:
    return np.arange(1.0, table.shape[1] + 1)


def readings_needed(rows: Mapping[str, Summary], *, axes: AxesGrid | None = None) -> AxesGrid:
    """Draw mean and median readings needed in each row of a study, in all and after the first reading on white.

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
    names = ["\n".join(textwrap.wrap(name, 30)) for name in rows]
    n_lines = sum(1 + name.count("\n") for name in names)
    own = axes is None
    axes = axes_or_grid(axes, 1, 2, size_in=(PAGE_IN, 1.5 + 0.2 * len(names) + 0.16 * n_lines), sharey=True)
    y = np.arange(len(names))
    for ax, parts, title in (
        (axes[0, 0], (("mean", BLUE, "o", -0.14), ("median", VERMILLION, "s", 0.14)), "in all"),
        (axes[0, 1], (("after_white", BLUE, "o", 0.0),), "after the first on white"),
    ):
        for part, colour, marker, shift in parts:
            estimates = [getattr(summary, part) for summary in rows.values()]
            value, low, high = (np.array([getattr(e, k) for e in estimates]) for k in ("value", "low", "high"))
            whiskers = np.array([value - low, high - value])
            known = "median, 95 % interval" if np.isfinite(low).any() else "median"
            label = "mean ± standard error" if part != "median" else known
            style = {"fmt": marker, "color": colour, "markersize": 5, "capsize": 3, "label": label}
            ax.errorbar(value, y + shift, xerr=whiskers, **style)
        ax.set_xlim(left=0)
        ax.grid(axis="x", color=GREY, alpha=0.25)
        ax.set_yticks(y, names)
        label_axes(ax, x="number of readings", y="", title=title)
    # Half a row of margin at either end, also for a single row.
    axes[0, 0].set_ylim(len(names) - 0.5, -0.5)
    if own:
        legend_below(axes)
    else:
        axes.flat[0].legend(frameon=False, fontsize=SMALL_PT)
    return axes
