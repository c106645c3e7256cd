"""Many diagnoses at once: reliability diagram and confusion matrix."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import IntArray
from probewise.challenge import Bin
from probewise.report.plots.canvas import BLACK, BLUE, GREY, SMALL_PT, axes_or_new, label_axes, legend_above


def reliability_diagram(bins: Sequence[Bin], *, ax: Axes | None = None) -> Axes:
    """Draw the share of right diagnoses against the stated probability, with Wilson intervals and numbers of cases.

    Parameters
    ----------
    bins
        From `challenge.reliability_bins`.
    ax
        Axes to draw on; a new figure without.
    """
    ax = axes_or_new(ax, size_in=(5.2, 5.0))
    ax.plot([0, 1], [0, 1], color=GREY, linewidth=0.9, linestyle="--", label="honest")
    stated = np.array([b.stated for b in bins])
    value, low, high = (np.array([getattr(b.right, end) for b in bins]) for end in ("value", "low", "high"))
    # Rounding may put an end of the interval slightly inside the value.
    whiskers = np.maximum([value - low, high - value], 0.0)
    ax.errorbar(stated, value, yerr=whiskers, fmt="o", color=BLUE, markersize=5, capsize=3, label="found, 95 %")
    for b in bins:
        ax.annotate(
            str(b.right.n), (b.stated, b.right.value), xytext=(6, -3), textcoords="offset points", fontsize=SMALL_PT
        )
    ax.set(xlim=(0, 1.04), ylim=(-0.02, 1.04), aspect="equal")
    legend_above(ax)
    return label_axes(ax, x="probability stated", y="share that was right")


def confusion_matrix(truths: Sequence[str], said: Sequence[str], counts: IntArray, *, ax: Axes | None = None) -> Axes:
    """Draw the confusion matrix: the number of cases in each cell, shaded by its share of the row.

    Parameters
    ----------
    truths, said
        Names of the rows and of the columns.
    counts
        Number of cases, (n_truths, n_said).
    ax
        Axes to draw on; a new figure without.
    """
    ax = axes_or_new(ax, size_in=(3.0 + 0.34 * len(said), 2.4 + 0.3 * len(truths)))
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    ax.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for (row, column), n in np.ndenumerate(counts):
        if n:
            colour = "white" if shares[row, column] > 0.6 else BLACK
            ax.text(column, row, str(n), ha="center", va="center", fontsize=SMALL_PT, color=colour)
    ax.set_xticks(np.arange(len(said)), said, rotation=60, ha="right", rotation_mode="anchor", fontsize=SMALL_PT)
    ax.set_yticks(np.arange(len(truths)), truths, fontsize=SMALL_PT)
    return label_axes(ax, x="most probable", y="concealed")
