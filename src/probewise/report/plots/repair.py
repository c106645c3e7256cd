"""Before and after a repair, on the same axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import FloatArray, IntArray
from probewise.recordings import Recording
from probewise.report.plots.canvas import BLACK, BLUE, GREY, VERMILLION, axes_or_new, tidy
from probewise.report.words import unit_name

__all__ = ["gain_by_scan", "mean_residuals", "readings_before_and_after"]

_STEPS = 24
_LEAST_ROWS = 4


def mean_residuals(
    covariate: FloatArray,
    before: FloatArray,
    after: FloatArray | None,
    *,
    sd: float,
    label: str,
    unit: str,
    span: tuple[float, float] | None = None,
    names: Mapping[float, str] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw what the model misses, averaged in bins of a covariate: as calibrated, and repaired.

    Parameters
    ----------
    covariate, before, after
        Shape (n_points,): the covariate, and recorded minus predicted reading by both models; NaN where there
        is none. Without `after` nothing was repaired.
    sd
        Noise of one reading, for the band that chance alone would fill.
    label, unit
        The covariate with its unit; the unit of a reading.
    span
        Where the mismatch was found, shaded.
    names
        Names of the values of a covariate without a scale.
    ax
        Axes to draw on; a new figure without.
    """
    ax = axes_or_new(ax, size_in=(7.0, 3.6))
    ok = np.flatnonzero(np.isfinite(covariate) & np.isfinite(before))
    groups = _groups(covariate[ok], names)
    at = np.arange(len(groups), dtype=np.float64) if names else np.array([covariate[ok][g].mean() for g in groups])
    sizes = np.array([g.size for g in groups])
    if span is not None and not names:
        ax.axvspan(*span, color=GREY, alpha=0.16, lw=0, label="where it shows")
    chance = 1.96 * sd / np.sqrt(np.maximum(sizes, 1))
    style = {"linestyle": "none"} if names else {"linewidth": 1.6}
    if names:
        ax.bar(at, 2 * chance, bottom=-chance, width=0.7, color=GREY, alpha=0.35, label="chance alone")
        shown = np.unique(covariate[ok])
        ax.set_xticks(at, [names[float(v)] for v in shown], rotation=30 if len(at) > 4 else 0, ha="right")
    else:
        ax.fill_between(at, -chance, chance, color=GREY, alpha=0.35, lw=0, label="chance alone")
    for residual, colour, name in ((before, VERMILLION, "model as calibrated"), (after, BLUE, "repaired model")):
        if residual is not None:
            means = np.array([residual[ok][g].mean() for g in groups])
            ax.plot(at, means, color=colour, marker="o", markersize=4, label=name, **style)
    ax.axhline(0, color=BLACK, linewidth=0.7)
    ax.legend(frameon=False, fontsize="small")
    return tidy(ax, x=label, y=f"recorded − predicted ({unit_name(unit)})")


def _groups(values: FloatArray, names: Mapping[float, str] | None) -> list[IntArray]:
    """Group rows: by value where values have names, else in steps of the covariate, neighbours with too few joined."""
    if names or values.size == 0:
        return [np.flatnonzero(values == value) for value in np.unique(values)]
    step = np.minimum((_STEPS * (values - values.min()) / max(float(np.ptp(values)), 1e-300)).astype(int), _STEPS - 1)
    groups: list[IntArray] = []
    waiting = np.empty(0, dtype=np.int64)
    for k in range(_STEPS):
        waiting = np.concatenate([waiting, np.flatnonzero(step == k)])
        if waiting.size >= _LEAST_ROWS:
            groups.append(waiting)
            waiting = waiting[:0]
    if waiting.size:
        groups = [*groups[:-1], np.concatenate([*groups[-1:], waiting])]
    return groups


def readings_before_and_after(
    recording: Recording,
    before: FloatArray,
    after: FloatArray | None,
    rows: IntArray,
    *,
    along: FloatArray,
    label: str,
    ax: Axes | None = None,
) -> Axes:
    """Draw some recorded readings, and on the same axes what the model expects as calibrated and repaired.

    Parameters
    ----------
    recording
        What was recorded.
    before, after
        Predicted reading of each row, (n_points,).
    rows
        Those to draw, and `along` (n_rows,) where, with its `label`.
    ax
        Axes to draw on; a new figure without.
    """
    ax = axes_or_new(ax, size_in=(7.0, 3.6))
    order = np.argsort(along, kind="stable")
    rows, along = rows[order], along[order]
    ok = recording.usable[rows]
    ax.plot(along[ok], recording.readings[rows][ok], ".", color=BLACK, markersize=4, label="recorded")
    ax.plot(along, before[rows], color=VERMILLION, linewidth=1.5, label="model as calibrated")
    if after is not None:
        ax.plot(along, after[rows], color=BLUE, linewidth=1.5, label="repaired model")
    ax.legend(frameon=False, fontsize="small")
    return tidy(ax, x=label, y=f"reading ({unit_name(recording.plan.instrumentation.unit)})")


def gain_by_scan(
    scans: Sequence[tuple[str, float]], mean: float, sd: float, *, most: int = 12, ax: Axes | None = None
) -> Axes:
    """Draw the gain on each scan that was kept back, nats a reading, and the mean of all with its error.

    Parameters
    ----------
    scans
        Name and gain of each.
    mean, sd
        Over all readings kept back, with the standard error.
    most
        The scans of least and largest gain are kept where there are more.
    ax
        Axes to draw on; a new figure without.
    """
    ranked = sorted(scans, key=lambda pair: pair[1])
    if len(ranked) > most:
        ranked = [*ranked[: most // 2], *ranked[-(most - most // 2) :]]
    ax = axes_or_new(ax, size_in=(6.6, 0.9 + 0.28 * max(len(ranked), 2)))
    at = np.arange(len(ranked))
    ax.axvspan(mean - sd, mean + sd, color=GREY, alpha=0.3, lw=0)
    ax.axvline(mean, color=GREY, linewidth=1.2, label=f"all: {mean:+.3f} ± {sd:.3f}")
    ax.barh(at, [g for _, g in ranked], color=[BLUE if g >= 0 else VERMILLION for _, g in ranked], height=0.6)
    ax.axvline(0, color=BLACK, linewidth=0.7)
    ax.set_yticks(at, [name.replace("_", " ") for name, _ in ranked], fontsize="small")
    ax.legend(frameon=False, fontsize="small", loc="lower right")
    return tidy(ax, x="gain on a scan that the fit had not seen (nats a reading)", y="")
