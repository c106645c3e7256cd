"""What the diagnosis believes, as bars."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from probewise.report.plots.canvas import BLUE, GREY, axes_or_new, tidy

__all__ = ["hypothesis_probabilities"]


def hypothesis_probabilities(
    names: Sequence[str], probabilities: Sequence[float], *, most: int = 8, ax: Axes | None = None
) -> Axes:
    """Draw the probability of each hypothesis, most probable first.

    Parameters
    ----------
    names, probabilities
        One a hypothesis; probabilities sum to one over all.
    most
        How many are drawn; the others are added up in one last bar.
    ax
        Axes to draw on; a new figure without.
    """
    order = np.argsort(-np.asarray(probabilities), kind="stable")
    shown = [(names[i], float(probabilities[i])) for i in order[:most]]
    rest = float(np.sum(np.asarray(probabilities)[order[most:]]))
    if len(order) > most:
        shown.append((f"{len(order) - most} others", rest))
    ax = axes_or_new(ax, size_in=(6.6, 0.8 + 0.36 * len(shown)))
    at = np.arange(len(shown))[::-1]
    ax.barh(at, [p for _, p in shown], color=[BLUE, *[GREY] * (len(shown) - 1)], height=0.62)
    for y, (_, p) in zip(at, shown, strict=True):
        ax.annotate(f"{p:.3f}", (p, float(y)), xytext=(4, 0), textcoords="offset points", va="center", fontsize="small")
    ax.set_yticks(at, [name.replace("_", " ") for name, _ in shown])
    ax.set_xlim(0, 1.12)
    # Room for four bars at least, so that one alone is no wall.
    ax.set_ylim(min(-0.5, len(shown) - 4.5), len(shown) - 0.5)
    return tidy(ax, x="probability", y="")
