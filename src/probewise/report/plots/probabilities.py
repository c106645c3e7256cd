"""Probabilities of hypotheses as bars, from round to round and reading to reading; effects that a plan shows."""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from probewise._arrays import FloatArray
from probewise.effects import spoken_name
from probewise.report.plots import canvas

_SHOWN = 6  # hypotheses with a colour of their own in the bars of rounds
_VISIBLE = 0.02  # probability from which a hypothesis has one
_LETTERS = 44  # of a line of a bar's label
_MOST_NUMBERS = 24  # on an axis
_DETECTABILITY = {"fine": canvas.BLUE, "aliased": canvas.ORANGE, "invisible": canvas.GREY}


def hypothesis_probabilities(
    names: Sequence[str], probabilities: Sequence[float], *, most: int = 8, ax: Axes | None = None
) -> Axes:
    """Draw the probability of each hypothesis, most probable first; beyond `most` bars, one more adds up the others.

    `names` and `probabilities` are one per hypothesis; the probabilities sum to one.
    """
    order = np.argsort(-np.asarray(probabilities), kind="stable")
    shown = [(names[i], float(probabilities[i])) for i in order[:most]]
    if len(order) > most:
        shown.append(
            (f"the {len(order) - most:,} others together", float(np.sum(np.asarray(probabilities)[order[most:]])))
        )
    ax = canvas.axes_or_new(ax, size_in=(canvas.PANEL_IN, height_of_bars_in([name for name, _ in shown])))
    # Labels in lines: the layout gives them the room that they take.
    at, labels = np.arange(len(shown)), [textwrap.fill(name, _LETTERS) for name, _ in shown]
    colours = [canvas.BLUE, *[canvas.GREY] * (len(shown) - 1)]
    bars = ax.barh(at, [p for _, p in shown], height=0.5, color=colours)
    ax.bar_label(bars, fmt="%.3f", padding=4, fontsize=canvas.SMALL_PT)
    ax.set_yticks(at, labels, fontsize=canvas.SMALL_PT)
    ax.set(xlim=(0, 1.08), ylim=(max(len(shown), 3) - 0.5, -0.5))  # a single bar is not too thick
    return canvas.label_axes(ax, x="probability", y="")


def height_of_bars_in(names: Sequence[str]) -> float:
    """Return the height of a drawing of bars with these labels, three or more."""
    lines = [max(len(textwrap.wrap(name, _LETTERS)), 1) for name in names]
    most = max((one + other for one, other in itertools.pairwise(lines)), default=2) / 2  # from one bar to the next
    return 0.6 + 0.16 * max(len(names), 3) * (1 + most)


def _stacked(beliefs: Sequence[Mapping[str, float]], first: Sequence[str] = ()) -> list[tuple[str, str, FloatArray]]:
    """Return name, colour and probability, (n_beliefs,), of each part of stacked bars; these `first`, in light grey.

    The six of the highest probability in any bar have colours, if it is 0.02 or more; the others are one grey part.
    """
    names = dict.fromkeys(name for believed in beliefs for name in believed if name not in first)
    highest = {name: max(believed.get(name, 0.0) for believed in beliefs) for name in names}
    shown = [name for name in sorted(highest, key=lambda name: -highest[name]) if highest[name] >= _VISIBLE][:_SHOWN]
    colours = [*[canvas.OUT_OF_REACH] * len(first), *canvas.CYCLE]
    parts = [
        (name, colour, np.array([believed.get(name, 0.0) for believed in beliefs]))
        for name, colour in zip([*first, *shown], colours, strict=False)
    ]
    rest = np.array([sum(believed.values()) for believed in beliefs]) - sum(share for _, _, share in parts)
    return [*parts, *([("all others", canvas.GREY, rest)] if (rest > 1e-3).any() else [])]


def probabilities_by_round(beliefs: Mapping[str, Mapping[str, float]], *, ax: Axes | None = None) -> Axes:
    """Draw the probabilities of the hypotheses, by name, after each round, by name: one stacked bar each, first on top.

    The six of the highest probability in any round have colours, if it is 0.02 or more; the others share a grey.
    """
    parts = _stacked([*beliefs.values()])
    lines = sum(len(textwrap.wrap(name, _LETTERS)) for name, *_ in parts)
    ax = canvas.axes_or_new(ax, size_in=(canvas.PANEL_IN, 1.1 + 0.5 * len(beliefs) + 0.2 * lines))
    at, left = np.arange(len(beliefs)), np.zeros(len(beliefs))
    for name, colour, share in parts:
        ax.barh(at, share, left=left, color=colour, label=name, height=0.6, edgecolor="white", linewidth=0.5)
        left += share
    ax.set_yticks(at, list(beliefs))
    ax.set(xlim=(0.0, 1.0), ylim=(len(beliefs) - 0.5, -0.5))
    return canvas.finish(ax, x="probability", y="", plain=None)


def effect_probabilities_by_reading(left_out: Sequence[Mapping[str, float]], *, ax: Axes | None = None) -> Axes:
    """Draw one stacked bar per reading: the probability of each effect that the sensor model may leave out, by name.

    The name "clean" stands for nothing. The effects of the highest probability after any reading have colours; the
    others are one part.
    """
    ax = canvas.axes_or_new(ax, size_in=(canvas.PANEL_IN, 4.0))
    number, bottom = np.arange(1, len(left_out) + 1), np.zeros(len(left_out))
    for name, colour, share in _stacked(left_out, first=["clean"]):
        label = "nothing left out" if name == "clean" else name.replace("_", " ")
        ax.bar(number, share, bottom=bottom, width=0.9, color=colour, label=label)
        bottom += share
    ax.set(ylim=(0, 1), xlim=(0.4, len(left_out) + 0.6))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    return canvas.finish(ax, x="reading", y="probability", plain=None)


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
    at, shares = np.arange(len(order)), np.diag(cosines)[order]
    axes = canvas.grid_of_axes(1, 2, size_in=(9.4, 1.5 + 0.25 * len(order)), width_ratios=[1, 2.8], sharey=True)
    bars, matrix = axes[0]
    for kind, colour in _DETECTABILITY.items():
        own = np.array([detectability[k] == kind for k in order], dtype=np.bool_)
        if own.any():
            bars.barh(at[own], shares[own], color=colour, height=0.7, label=kind)
    bars.set_yticks(at, [f"{spoken_name(names[k])}  {place}" for place, k in enumerate(order, start=1)])
    bars.set(xlim=(0, 1), ylim=(len(order) - 0.5, -0.5))
    canvas.label_axes(bars, x="detectable share (no unit)", y="")
    shown = np.where(cosines > 0, cosines, np.nan)[np.ix_(order, order)]
    np.fill_diagonal(shown, np.nan)
    is_compared = np.isfinite(shown).any(axis=0)
    compared = np.flatnonzero(is_compared) if is_compared.any() else at
    shown = shown[:, compared]
    image = matrix.imshow(shown, cmap=canvas.COPPER, vmin=0, vmax=1, aspect="auto")
    row, column = np.nonzero(shown >= alias)
    matrix.plot(column, row, "o", markersize=4, color="white", markeredgecolor=canvas.BLACK)
    ticks = np.arange(len(compared))[:: 1 + len(compared) // _MOST_NUMBERS]
    matrix.set_xticks(ticks, [str(place) for place in compared[ticks] + 1], fontsize=canvas.SMALL_PT)
    canvas.add_colour_bar(matrix, image, f"cosine (no unit); circles: aliased, {alias:.2f} or more")
    title = "row: the effect present; blank: not compared"
    canvas.label_axes(matrix, x="number of the effect it may be mistaken for", y="", title=title)
    canvas.legend_below(axes)
    return axes
