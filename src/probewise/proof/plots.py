"""Figures of studies and challenges: many runs or many diagnoses at once."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import FloatArray, IntArray
from probewise._words import count_with_noun
from probewise.diagnosis.words import effect_has_words, effect_in_words
from probewise.proof.concealed_study import ConcealedRow
from probewise.proof.estimates import Estimate
from probewise.proof.study import Summary
from probewise.report.plots.canvas import (
    BLACK,
    BLUE,
    GREY,
    PAGE_IN,
    SMALL_PT,
    VERMILLION,
    AxesGrid,
    grid_of_axes,
    label_axes,
    legend_above,
    legend_below,
)
from probewise.report.plots.search import set_up_width_axes

__all__ = [
    "confusion_matrix",
    "doubt_against_trust",
    "posterior_widths_of_runs",
    "readings_needed",
    "reliability_diagram",
]

_BAND = (0.16, 0.84)


def posterior_widths_of_runs(runs: Mapping[str, Sequence[FloatArray]], *, target_mm: float = 4.0) -> AxesGrid:
    """Draw the widest posterior sd after each reading: median and middle 68 % of the runs, one panel per row.

    Thin lines are the medians of the other panels. A run that has ended keeps its last width.

    `runs`: for each row, by name, the widest posterior sd after each reading of every run, (n_readings,), mm.
    """
    n_columns = min(len(runs), 2)
    n_rows = -(-len(runs) // max(n_columns, 1))
    size_in = (PAGE_IN if n_columns == 2 else 6.8, 0.5 + 2.9 * n_rows)
    axes = grid_of_axes(n_rows, n_columns, size_in=size_in, sharex=True, sharey=True)
    longest = {name: max(len(w) for w in widths) for name, widths in runs.items()}
    tables = {
        name: np.array([np.pad(w, (0, longest[name] - len(w)), mode="edge") for w in widths])
        for name, widths in runs.items()
    }
    number = {name: np.arange(1.0, table.shape[1] + 1) for name, table in tables.items()}
    for ax, (name, table) in zip(axes.flat, tables.items(), strict=False):
        for other, more in tables.items():
            if other != name:
                label = "median of another panel"
                ax.plot(number[other], np.median(more, axis=0), color=GREY, linewidth=0.9, label=label)
        low, high = np.quantile(table, _BAND, axis=0)
        ax.fill_between(number[name], low, high, color=BLUE, alpha=0.2, linewidth=0, label="middle 68 % of the runs")
        ax.plot(number[name], np.median(table, axis=0), color=BLUE, linewidth=1.8, label="median")
        set_up_width_axes(ax, target_mm)
        ax.set_title(f"{name} ({count_with_noun(len(table), 'run')})", fontsize="medium", loc="left")
        ax.label_outer()
    for ax in list(axes.flat)[len(runs) :]:
        ax.set_visible(False)
        axes.flat[len(runs) - n_columns].xaxis.set_tick_params(labelbottom=True)
        axes.flat[len(runs) - n_columns].set_xlabel("number of readings")
    legend_below(axes)
    return axes


def _value_and_whiskers(estimates: Sequence[Estimate]) -> tuple[FloatArray, FloatArray]:
    """Return values, (n,), and whiskers down and up, (2, n): rounding may put an end a hair inside the value."""
    value, low, high = (np.array([getattr(e, k) for e in estimates]) for k in ("value", "low", "high"))
    return value, np.maximum([value - low, high - value], 0.0)


def readings_needed(rows: Mapping[str, Summary]) -> AxesGrid:
    """Draw mean and median readings needed in each row of a study, in all and after the first reading on white.

    `rows` are drawn from the top in this order. Returns axes, (1, 2).
    """
    names = ["\n".join(textwrap.wrap(name, 30)) for name in rows]
    n_lines = sum(1 + name.count("\n") for name in names)
    axes = grid_of_axes(1, 2, size_in=(PAGE_IN, 1.5 + 0.2 * len(names) + 0.16 * n_lines), sharey=True)
    y = np.arange(len(names))
    for ax, parts, title in (
        (axes[0, 0], (("mean", BLUE, "o", -0.14), ("median", VERMILLION, "s", 0.14)), "in all"),
        (axes[0, 1], (("after_white", BLUE, "o", 0.0),), "after the first on white"),
    ):
        for part, colour, marker, shift in parts:
            value, whiskers = _value_and_whiskers([getattr(summary, part) for summary in rows.values()])
            known = "median, 95 % interval" if np.isfinite(whiskers).any() else "median"
            label = "mean ± standard error" if part != "median" else known
            style = {"fmt": marker, "color": colour, "markersize": 5, "capsize": 3, "label": label}
            ax.errorbar(value, y + shift, xerr=whiskers, **style)
        ax.set_xlim(left=0)
        ax.grid(axis="x", color=GREY, alpha=0.25)
        ax.set_yticks(y, names)
        label_axes(ax, x="number of readings", y="", title=title)
    # Half a row of margin at either end, also for a single row.
    axes[0, 0].set_ylim(len(names) - 0.5, -0.5)
    legend_below(axes)
    return axes


def reliability_diagram(bins: Sequence[tuple[float, Estimate]]) -> Axes:
    """Draw the share of right diagnoses against the stated probability, with Wilson intervals and numbers of cases."""
    ax = grid_of_axes(1, 1, size_in=(5.2, 5.0))[0, 0]
    ax.plot([0, 1], [0, 1], color=GREY, linewidth=0.9, linestyle="--", label="honest")
    value, whiskers = _value_and_whiskers([right for _, right in bins])
    at = np.array([stated for stated, _ in bins])
    ax.errorbar(at, value, yerr=whiskers, fmt="o", color=BLUE, markersize=5, capsize=3, label="found, 95 %")
    for stated, right in bins:
        place = {"xytext": (6, -3), "textcoords": "offset points", "fontsize": SMALL_PT}
        ax.annotate(str(right.n), (stated, right.value), **place)
    ax.set(xlim=(0, 1.04), ylim=(-0.02, 1.04), aspect="equal")
    legend_above(ax)
    return label_axes(ax, x="probability stated", y="share that was right")


def confusion_matrix(truths: Sequence[str], said: Sequence[str], counts: IntArray) -> Axes:
    """Draw the number of cases by truth and answer, (n_truths, n_said), shaded by its share of the row."""
    ax = grid_of_axes(1, 1, size_in=(3.0 + 0.34 * len(said), 2.4 + 0.3 * len(truths)))[0, 0]
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    ax.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for (row, column), n in np.ndenumerate(counts):
        if n:
            colour = "white" if shares[row, column] > 0.6 else BLACK
            ax.text(column, row, str(n), ha="center", va="center", fontsize=SMALL_PT, color=colour)
    ax.set_xticks(np.arange(len(said)), said, rotation=60, ha="right", rotation_mode="anchor", fontsize=SMALL_PT)
    ax.set_yticks(np.arange(len(truths)), truths, fontsize=SMALL_PT)
    return label_axes(ax, x="most probable", y="concealed")


_PANELS = (
    ("sure_and_wrong", "sure and wrong", "share of the runs"),
    ("intervals_hold", "95 % intervals that hold", "share of the intervals"),
    ("readings", "readings, median", "number"),
)


def effect_and_size_in_words(row: ConcealedRow) -> str:
    """Name a row: the concealed effect in words and, if it has one, its size."""
    name = effect_in_words(row.concealed) if effect_has_words(row.concealed) else row.concealed.replace("_", " ")
    return name if row.size is None else f"{name}, {row.size:g}"


def doubt_against_trust(rows: Sequence[ConcealedRow]) -> AxesGrid:
    """Compare doubt in the sensor model with trust: runs sure and wrong, intervals that hold, median readings.

    `rows` are drawn from the top in this order. Returns axes, (1, 3).
    """
    names = list(dict.fromkeys(effect_and_size_in_words(row) for row in rows))
    axes = grid_of_axes(1, 3, size_in=(PAGE_IN, 1.7 + 0.32 * len(names)), sharey=True)
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
                value, whiskers = _value_and_whiskers(values)
                ax.errorbar(value, y, xerr=whiskers, capsize=2.5, **style)
            else:
                ax.errorbar(values, y, **style)
        ax.set_xlim(*((0, None) if field == "readings" else (-0.03, 1.03)))
        if field == "intervals_hold":
            ax.axvline(0.95, color=GREY, linewidth=0.9, linestyle="--")
        ax.grid(axis="x", color=GREY, alpha=0.25)
        ax.set_yticks(np.arange(len(names)), names)
        label_axes(ax, x=x, y="", title=title)
    axes[0, 0].set_ylim(len(names) - 0.5, -0.5)
    legend_below(axes)
    return axes
