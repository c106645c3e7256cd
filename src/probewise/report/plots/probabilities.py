"""Probabilities of hypotheses as bars, from round to round and reading to reading; effects that a plan shows."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from probewise._arrays import FloatArray
from probewise.effects import spoken_name
from probewise.report.plots import canvas

_SHOWN = 6  # hypotheses with a colour of their own in the bars of rounds
_VISIBLE = 0.02  # probability from which a hypothesis has one
_LINE = 0.42  # height of a further line of a label, in distances of two bars
_AXES_SHARE = 0.775  # of a figure's width: its axes before the layout, which widens them
_EFFECT_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")  # of the likeliest effects by reading
_CLEAN, _REST = "#D9D9D9", "#7F7F7F"
_DETECTABILITY = {"fine": canvas.BLUE, "aliased": canvas.ORANGE, "invisible": canvas.GREY}
_MOST_NAMES = 36  # columns of the matrix labelled with names; if there are more, they are numbered


def hypothesis_probabilities(
    names: Sequence[str], probabilities: Sequence[float], *, most: int = 8, ax: Axes | None = None
) -> Axes:
    """Draw the probability of each hypothesis, most probable first; beyond `most` bars, one more adds up the others.

    `names` and `probabilities` are one per hypothesis; the probabilities sum to one.
    """
    order = np.argsort(-np.asarray(probabilities), kind="stable")
    shown = [(names[i], float(probabilities[i])) for i in order[:most]]
    if len(order) > most:
        shown.append((f"{len(order) - most} others", float(np.sum(np.asarray(probabilities)[order[most:]]))))
    shown_names = [name for name, _ in shown]
    height = 0.6 + 0.42 * (len(shown) + _LINE * n_further_lines(shown_names, width_in=6.6))
    ax = canvas.axes_or_new(ax, size_in=(6.6, height))
    wrapped = _wrapped_labels(shown_names, ax.get_position().width * canvas.figure_of(ax).get_figwidth())
    # A bar lies below all lines of its label.
    lines_before = np.cumsum([len(lines) - 1 for lines in wrapped])
    at = -np.arange(len(shown), dtype=np.float64) - _LINE * lines_before
    ax.barh(at - 0.22, [p for _, p in shown], color=[canvas.BLUE, *[canvas.GREY] * (len(shown) - 1)], height=0.34)
    beside: dict[str, Any] = {"textcoords": "offset points", "fontsize": canvas.SMALL_PT}
    for y, lines, (_, p) in zip(at, wrapped, shown, strict=True):
        ax.annotate(f"{p:.3f}", (p, y - 0.22), xytext=(4, 0), va="center", **beside)
        ax.annotate("\n".join(lines), (0.0, y + 0.06), xytext=(3, 0), **beside)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    ax.set_xlim(0, 1.08)
    ax.set_xticks(np.linspace(0.0, 1.0, 6))
    # Room for at least three bars, so that a single bar is not too thick.
    ax.set_ylim(min(at[-1], -2.0) - 0.5, 0.5)
    return canvas.label_axes(ax, x="probability", y="")


def n_further_lines(names: Sequence[str], *, width_in: float) -> int:
    """Return how many lines more than one each the labels of hypotheses take in a figure of this width."""
    return sum(len(lines) - 1 for lines in _wrapped_labels(names, _AXES_SHARE * width_in))


def _wrapped_labels(names: Sequence[str], width_in: float) -> list[list[str]]:
    """Return the lines of each label in axes of this width."""
    room = max(int(canvas.LETTERS_PER_IN * width_in), 1)
    return [textwrap.wrap(name, room) or [""] for name in names]


def probabilities_by_round(beliefs: Mapping[str, Mapping[str, float]], *, ax: Axes | None = None) -> Axes:
    """Draw the probabilities of the hypotheses, by name, after each round, by name: one stacked bar each, first on top.

    The six hypotheses of the highest probability in any round have colours, if it is 0.02 or more; the others share a
    grey.
    """
    highest: dict[str, float] = {}
    for believed in beliefs.values():
        for name, p in believed.items():
            highest[name] = max(p, highest.get(name, 0.0))
    shown = [name for name in sorted(highest, key=lambda name: -highest[name]) if highest[name] >= _VISIBLE][:_SHOWN]
    alone = ax is None
    ax = canvas.axes_or_new(ax, size_in=(6.6, 1.1 + 0.5 * len(beliefs)))
    at = -np.arange(len(beliefs), dtype=np.float64)
    left = np.zeros(len(beliefs))
    style: dict[str, Any] = {"height": 0.6, "edgecolor": "white", "linewidth": 0.5}
    for name, colour in zip(shown, canvas.CYCLE, strict=False):
        width = np.array([believed.get(name, 0.0) for believed in beliefs.values()])
        ax.barh(at, width, left=left, color=colour, label=name, **style)
        left += width
    if (left < 1.0 - 1e-3).any():
        ax.barh(at, 1.0 - left, left=left, color=canvas.GREY, label="all others", **style)
    ax.set_yticks(at, list(beliefs))
    ax.set_xlim(0.0, 1.0)
    n_lines = canvas.legend_above(ax)
    if alone:
        sheet = canvas.figure_of(ax)
        sheet.set_figheight(sheet.get_figheight() + 0.2 * n_lines)
    return canvas.label_axes(ax, x="probability", y="")


def effect_probabilities_by_reading(left_out: Sequence[Mapping[str, float]], *, ax: Axes | None = None) -> Axes:
    """Draw one stacked bar per reading: the probability of each effect that the sensor model may leave out, by name.

    The name "clean" stands for nothing. A dashed line before a bar marks a reading that changed the most probable
    effect. The five effects of the highest probability after any reading have colours; the others are one part.
    """
    ax = canvas.axes_or_new(ax, size_in=(6.8, 4.0))
    names = list(dict.fromkeys(name for step in left_out for name in step if name != "clean"))
    ranked = sorted(names, key=lambda name: -max(step.get(name, 0.0) for step in left_out))
    n = len(_EFFECT_COLOURS)
    parts = [("nothing left out", _CLEAN, ["clean"])]
    parts += [(name.replace("_", " "), colour, [name]) for name, colour in zip(ranked, _EFFECT_COLOURS, strict=False)]
    if ranked[n:]:
        parts.append(("something else", _REST, [name for name in names if name not in ranked[:n]]))
    number, bottom = np.arange(1, len(left_out) + 1), np.zeros(len(left_out))
    for label, colour, members in parts:
        share = np.array([sum(step.get(name, 0.0) for name in members) for step in left_out])
        ax.bar(number, share, bottom=bottom, width=0.9, color=colour, label=label)
        bottom += share
    leaders = [max(step, key=step.__getitem__) for step in left_out]
    for k in range(1, len(leaders)):
        if leaders[k] != leaders[k - 1]:
            ax.axvline(number[k] - 0.5, color="black", linestyle="--", linewidth=1.0)
    ax.set(ylim=(0, 1), xlim=(0.4, len(left_out) + 0.6))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    return canvas.finish(ax, x="reading", y="probability", plain="")


def audit_matrix(
    names: Sequence[str], detectability: Sequence[str], cosines: FloatArray, *, alias: float
) -> canvas.AxesGrid:
    """Draw the detectable share of each effect, and how well every other effect imitates it; fine effects come first.

    The matrix is not symmetric: the row is the effect that is present, at typical parameters; the column is the effect
    it may be mistaken for, at its best-fitting parameters. `detectability` is "fine", "aliased" or "invisible";
    `cosines`, (n_effects, n_effects), 0 where not compared, has the detectable share on the diagonal; from the cosine
    `alias` on two effects are aliased, and marked. Return the axes, (1, 2), which share the y axis.
    """
    order = sorted(range(len(names)), key=lambda k: (list(_DETECTABILITY).index(detectability[k]), -cosines[k, k]))
    labels = [spoken_name(names[k]) for k in order]
    at = np.arange(len(order))
    axes = canvas.grid_of_axes(1, 2, size_in=(9.4, 1.5 + 0.25 * len(order)), width_ratios=[1, 2.8], sharey=True)
    bars, matrix = axes[0]
    bars.barh(at, np.diag(cosines)[order], color=[_DETECTABILITY[detectability[k]] for k in order], height=0.7)
    bars.set_yticks(at, labels)
    bars.invert_yaxis()
    bars.set_xlim(0, 1)
    for kind, colour in _DETECTABILITY.items():
        if kind in detectability:
            bars.barh([np.nan], [0], color=colour, label=kind)
    canvas.label_axes(bars, x="detectable share (no unit)", y="")
    if len(order) > _MOST_NAMES:
        bars.set_yticks(at, [f"{name}  {k + 1}" for k, name in enumerate(labels)])
        labels = [str(k + 1) if k % 5 == 4 else "" for k in range(len(labels))]
    _draw_matrix(matrix, cosines[np.ix_(order, order)], labels, alias)
    canvas.legend_below(axes)
    return axes


def _draw_matrix(ax: Axes, cosines: FloatArray, labels: Sequence[str], alias: float) -> None:
    """Draw the cosines of the effects that were compared; rows of the others are blank, and they have no column."""
    shown = np.where(np.eye(len(labels), dtype=np.bool_), np.nan, cosines)
    compared = np.nan_to_num(shown).any(axis=0) | np.nan_to_num(shown).any(axis=1)
    shown[~compared, :] = np.nan
    columns = np.flatnonzero(compared if compared.any() else ~compared).tolist()
    image = ax.imshow(shown[:, columns], cmap=canvas.COPPER, vmin=0, vmax=1, aspect="auto")
    at_row, at_column = np.nonzero(np.nan_to_num(shown[:, columns]) >= alias)
    ax.plot(at_column, at_row, linestyle="none", marker="o", markersize=4, color="white", markeredgecolor="black")
    turned = 0 if labels[0] == "" else 90
    ax.set_xticks(np.arange(len(columns)), [labels[k] for k in columns], rotation=turned, fontsize=canvas.SMALL_PT)
    ax.tick_params(left=False)
    ax.spines["left"].set_visible(False)
    bar = ax.figure.colorbar(image, ax=ax, label="cosine (no unit); circles from the line on", shrink=0.7)
    bar.ax.axhline(alias, color="black", linewidth=1.2)
    title = "row: the effect present; blank: not compared"
    canvas.label_axes(ax, x="effect it may be mistaken for", y="", title=title)
