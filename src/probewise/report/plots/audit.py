"""Detectability of every effect under a plan, and the matrix of aliases."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import FloatArray
from probewise.effects import spoken_name
from probewise.report.plots.canvas import (
    BLUE,
    COPPER,
    GREY,
    ORANGE,
    SMALL_PT,
    AxesGrid,
    axes_or_grid,
    label_axes,
    legend_below,
)

COLOUR = {"fine": BLUE, "aliased": ORANGE, "invisible": GREY}

_NOT_COMPARED = "#e8e8e8"
_MOST_NAMES = 36  # columns labelled with names; if there are more, they are numbered


def audit_matrix(
    names: Sequence[str],
    detectability: Sequence[str],
    cosines: FloatArray,
    *,
    alias: float,
    axes: AxesGrid | None = None,
) -> AxesGrid:
    """Draw the detectable share of each effect, and how well every other effect imitates it; fine effects come first.

    The matrix is not symmetric: the row is the effect that is present, at typical parameters; the column is the effect
    it may be mistaken for, at its best-fitting parameters.

    Parameters
    ----------
    names, detectability
        Names of the effects, and whether each is "fine", "aliased" or "invisible".
    cosines
        Cosine of the row's change with the column's best imitation, (n_effects, n_effects), 0 where not compared; the
        detectable share on the diagonal.
    alias
        Cosine from which two effects are aliased, and marked.
    axes
        Axes to draw on, (1, 2), with one y axis; a new figure without.

    Returns
    -------
    The two axes, shape (1, 2).
    """
    order = sorted(range(len(names)), key=lambda k: (list(COLOUR).index(detectability[k]), -cosines[k, k]))
    labels = [spoken_name(names[k]) for k in order]
    at = np.arange(len(order))
    own = axes is None
    axes = axes_or_grid(axes, 1, 2, size_in=(9.4, 1.5 + 0.25 * len(order)), width_ratios=[1, 2.8], sharey=True)
    bars, matrix = axes[0]
    bars.barh(at, np.diag(cosines)[order], color=[COLOUR[detectability[k]] for k in order], height=0.7)
    bars.set_yticks(at, labels)
    bars.invert_yaxis()
    bars.set_xlim(0, 1)
    for kind, colour in COLOUR.items():
        if kind in detectability:
            bars.barh([np.nan], [0], color=colour, label=kind)
    label_axes(bars, x="detectable share (no unit)", y="")
    numbered = len(order) > _MOST_NAMES
    if numbered:
        bars.set_yticks(at, [f"{name}  {k + 1}" for k, name in enumerate(labels)])
        labels = [str(k + 1) if k % 5 == 4 else "" for k in range(len(labels))]
    _draw_matrix(matrix, cosines[np.ix_(order, order)], labels, alias)
    if own:
        legend_below(axes)
    else:
        bars.legend(frameon=False, fontsize=SMALL_PT)
    return axes


def _draw_matrix(ax: Axes, cosines: FloatArray, labels: Sequence[str], alias: float) -> None:
    shown = np.where(np.eye(len(labels), dtype=np.bool_), np.nan, cosines)
    alone = ~(np.nan_to_num(shown).any(axis=0) | np.nan_to_num(shown).any(axis=1))
    shown[alone, :] = shown[:, alone] = np.nan
    ax.set_facecolor(_NOT_COMPARED)
    image = ax.imshow(shown, cmap=COPPER, vmin=0, vmax=1, aspect="auto")
    rows, columns = np.nonzero(np.nan_to_num(shown) >= alias)
    ax.plot(columns, rows, linestyle="none", marker="o", markersize=4, color="white", markeredgecolor="black")
    ax.set_xticks(np.arange(len(labels)), labels, rotation=0 if labels[0] == "" else 90, fontsize=SMALL_PT)
    ax.tick_params(left=False)
    bar = ax.figure.colorbar(image, ax=ax, label="cosine (no unit); circles from the line on", shrink=0.7)
    bar.ax.axhline(alias, color="black", linewidth=1.2)
    label_axes(ax, x="effect it may be mistaken for", y="", title="row: the effect present; grey: not compared")
