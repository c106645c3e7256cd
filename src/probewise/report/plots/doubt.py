"""Probabilities of effects that the sensor model leaves out, reading by reading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from probewise.report.plots.canvas import axes_or_new, label_axes, legend_above

_MOST = 5  # effects with a colour of their own; the others share one
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")
_CLEAN, _REST = "#D9D9D9", "#7F7F7F"


def effect_probabilities_by_reading(left_out: Sequence[Mapping[str, float]], *, ax: Axes | None = None) -> Axes:
    """Draw one stacked bar per reading: the probability of each effect that the sensor model may leave out.

    A dashed line before a bar marks a reading that changed the most probable effect. The five effects of the highest
    probability after any reading have colours; the others are one part.

    Parameters
    ----------
    left_out
        Probability by name after each reading; "clean": nothing is left out.
    ax
        Axes to draw on; a new figure without.
    """
    ax = axes_or_new(ax, size_in=(6.8, 4.0))
    names = list(dict.fromkeys(name for step in left_out for name in step if name != "clean"))
    most = sorted(names, key=lambda name: -max(step.get(name, 0.0) for step in left_out))[:_MOST]
    number = np.arange(1, len(left_out) + 1)
    bottom = np.zeros(len(left_out))
    parts = [("nothing left out", _CLEAN, ["clean"])]
    parts += [(name.replace("_", " "), colour, [name]) for name, colour in zip(most, _COLOURS, strict=False)]
    rest = [name for name in names if name not in most]
    parts += [("something else", _REST, rest)] if rest else []
    for label, colour, own in parts:
        share = np.array([sum(step.get(name, 0.0) for name in own) for step in left_out])
        ax.bar(number, share, bottom=bottom, width=0.9, color=colour, label=label)
        bottom += share
    leaders = [max(step, key=step.__getitem__) for step in left_out]
    for k in range(1, len(leaders)):
        if leaders[k] != leaders[k - 1]:
            ax.axvline(number[k] - 0.5, color="black", linestyle="--", linewidth=1.0)
    ax.set(ylim=(0, 1), xlim=(0.4, len(left_out) + 0.6))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    legend_above(ax)
    return label_axes(ax, x="reading", y="probability")
