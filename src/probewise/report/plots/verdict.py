"""Probabilities of hypotheses as bars: of one diagnosis, and from round to round."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from probewise.report.plots.canvas import (
    BLUE,
    CYCLE,
    GREY,
    LETTERS_PER_IN,
    SMALL_PT,
    axes_or_new,
    label_axes,
    legend_above,
)

_SHOWN = 6  # hypotheses with a colour of their own
_LINE = 0.42  # height of a further line of a label, in distances of two bars
_AXES_SHARE = 0.775  # of a figure's width: its axes before the layout, which widens them
_VISIBLE = 0.02  # probability from which a hypothesis has one


def hypothesis_probabilities(
    names: Sequence[str], probabilities: Sequence[float], *, most: int = 8, ax: Axes | None = None
) -> Axes:
    """Draw the probability of each hypothesis, most probable first.

    Parameters
    ----------
    names, probabilities
        One per hypothesis; the probabilities sum to one.
    most
        Number of bars; one more adds up the other hypotheses.
    ax
        Axes to draw on; a new figure without.
    """
    order = np.argsort(-np.asarray(probabilities), kind="stable")
    shown = [(names[i], float(probabilities[i])) for i in order[:most]]
    rest = float(np.sum(np.asarray(probabilities)[order[most:]]))
    if len(order) > most:
        shown.append((f"{len(order) - most} others", rest))
    names_shown = [name for name, _ in shown]
    ax = axes_or_new(ax, size_in=(6.6, 0.6 + 0.42 * (len(shown) + _LINE * n_further_lines(names_shown, width_in=6.6))))
    wrapped = _wrapped_labels(names_shown, ax.get_position().width * cast(Figure, ax.figure).get_figwidth())
    # A bar lies below all lines of its label.
    lines_before = np.cumsum([len(lines) - 1 for lines in wrapped])
    at = -np.arange(len(shown), dtype=np.float64) - _LINE * lines_before
    ax.barh(at - 0.22, [p for _, p in shown], color=[BLUE, *[GREY] * (len(shown) - 1)], height=0.34)
    beside: dict[str, Any] = {"textcoords": "offset points", "fontsize": SMALL_PT}
    for y, lines, (_, p) in zip(at, wrapped, shown, strict=True):
        ax.annotate(f"{p:.3f}", (p, y - 0.22), xytext=(4, 0), va="center", **beside)
        ax.annotate("\n".join(lines), (0.0, y + 0.06), xytext=(3, 0), **beside)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    ax.set_xlim(0, 1.08)
    ax.set_xticks(np.linspace(0.0, 1.0, 6))
    # Room for at least three bars, so that a single bar is not too thick.
    ax.set_ylim(min(at[-1], -2.0) - 0.5, 0.5)
    return label_axes(ax, x="probability", y="")


def n_further_lines(names: Sequence[str], *, width_in: float) -> int:
    """Return how many lines more than one each the labels of hypotheses take in a figure of this width."""
    return sum(len(lines) - 1 for lines in _wrapped_labels(names, _AXES_SHARE * width_in))


def _wrapped_labels(names: Sequence[str], width_in: float) -> list[list[str]]:
    """Return the lines of each label in axes of this width."""
    room = max(int(LETTERS_PER_IN * width_in), 1)
    return [textwrap.wrap(name, room) or [""] for name in names]


def probabilities_by_round(beliefs: Mapping[str, Mapping[str, float]], *, ax: Axes | None = None) -> Axes:
    """Draw the probabilities of the hypotheses after each round, one stacked bar per round.

    Parameters
    ----------
    beliefs
        Probability of each hypothesis by name, for each round by name, the first on top. Up to six hypotheses have
        colours, those of the highest probability in any round if it is 0.02 or more; the others share a grey.
    ax
        Axes to draw on; a new figure without.
    """
    highest: dict[str, float] = {}
    for believed in beliefs.values():
        for name, p in believed.items():
            highest[name] = max(p, highest.get(name, 0.0))
    likely = [name for name in sorted(highest, key=lambda name: -highest[name]) if highest[name] >= _VISIBLE]
    shown = likely[:_SHOWN]
    alone = ax is None
    ax = axes_or_new(ax, size_in=(6.6, 1.1 + 0.5 * len(beliefs)))
    at = -np.arange(len(beliefs), dtype=np.float64)
    left = np.zeros(len(beliefs))
    for name, colour in zip(shown, CYCLE, strict=False):
        width = np.array([believed.get(name, 0.0) for believed in beliefs.values()])
        ax.barh(at, width, left=left, height=0.6, color=colour, edgecolor="white", linewidth=0.5, label=name)
        left += width
    if (left < 1.0 - 1e-3).any():
        ax.barh(at, 1.0 - left, left=left, height=0.6, color=GREY, edgecolor="white", linewidth=0.5, label="all others")
    ax.set_yticks(at, list(beliefs))
    ax.set_xlim(0.0, 1.0)
    n_lines = legend_above(ax)
    if alone:
        sheet = cast(Figure, ax.figure)
        sheet.set_figheight(sheet.get_figheight() + 0.2 * n_lines)
    return label_axes(ax, x="probability", y="")
