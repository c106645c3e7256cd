"""Residuals of the calibrated and of the repaired model: along a covariate, in one scan, scan by scan."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from probewise._arrays import FloatArray
from probewise.recordings import Recording
from probewise.recordings.plan import require_recording
from probewise.report.plots.canvas import (
    BLACK,
    BLUE,
    GREY,
    SKY,
    SMALL_PT,
    VERMILLION,
    AxesGrid,
    label_axes,
    legend_above,
    set_plain_tick_labels,
    stack_of_axes,
)
from probewise.report.residual_means import ResidualMeans, running_mean_curve
from probewise.report.words import number_text, number_unsigned_zero

BEFORE, AFTER = "as calibrated", "repaired"
_CROWDED = 500  # number of dots from which they are paler
_MANY = 1500  # number of dots from which they are an image inside the SVG
_ASIDE = 0.15  # offset of the means before and after from a categorical value's position
_LEAST_SHADE = 0.008  # least width of a shaded interval, as a share of the axes' width
_MOST_SHADE = 0.5  # the largest, from which on the rest of the axis is what stands out
_MOST_SCANS = 12


def mean_residuals_along(
    means: ResidualMeans,
    *,
    label: str,
    unit: str,
    each: tuple[FloatArray, FloatArray] | None = None,
    window: tuple[float, float] | None = None,
    names: Sequence[str] | None = None,
    after: str = AFTER,
    ax: Axes | None = None,
) -> Axes:
    """Draw mean residuals against a covariate, the 95 % band of chance, and the interval that is significant.

    Parameters
    ----------
    means
        From `mean_residuals`.
    label, unit
        Label of the covariate with its unit; unit of the readings.
    each
        Covariate and residual of every reading, (n_points,) each, drawn as dots behind.
    window
        Ends of the significant interval, shaded unless it takes up most of the axis.
    names
        Names of the values 0, 1, 2 ... of a categorical covariate.
    after
        What the later of the two models is called.
    ax
        Axes to draw on; a new figure without.
    """
    ax = ax if ax is not None else stack_of_axes([2.7])[0]
    if each is not None:
        _draw_dots(ax, *each, GREY, "one reading")
    ax.axhline(0, color=BLACK, linewidth=0.7)
    if names:
        ax.bar(means.at, 2 * means.chance, 0.84, -means.chance, color=GREY, alpha=0.3, label=_CHANCE)
    elif len(means.at) == 1:
        ax.errorbar(means.at, [0.0], yerr=means.chance, color=GREY, linewidth=8, alpha=0.3, label=_CHANCE)
    else:
        ax.fill_between(means.at, -means.chance, means.chance, color=GREY, alpha=0.3, linewidth=0, label=_CHANCE)
    aside = _ASIDE if names and means.after is not None else 0.0
    said = "mean, " if each is not None else ""
    drawn = ((means.before, VERMILLION, "o", BEFORE, -aside), (means.after, BLUE, "s", after, aside))
    for values, colour, marker, name, step in drawn:
        if values is not None:
            line = f"{marker}" if names else f"{marker}-"
            ax.plot(means.at + step, values, line, color=colour, ms=4.5, lw=1.4, label=f"{said}{name}")
    if names:
        _label_x_by_name(ax, names)
    if window is not None:
        low, high = ax.get_xlim()
        middle, half = sum(window) / 2, max((window[1] - window[0]) / 2, _LEAST_SHADE * (high - low))
        if 2 * half < _MOST_SHADE * (high - low):  # nothing stands out where nearly all is shaded
            shade: dict[str, Any] = {
                "color": SKY,
                "alpha": 0.25,
                "linewidth": 0,
                "label": "stands out here",
                "zorder": 0,
            }
            ax.axvspan(middle - half, middle + half, **shade)
    averaged = each is None and int(means.size.max(initial=1)) > 1
    label_axes(ax, x=label, y=f"{'mean residual' if averaged else 'residual'} ({unit})")
    set_plain_tick_labels(ax, x=not names)
    legend_above(ax)
    return ax


def scan_with_residuals(
    along: FloatArray,
    readings: FloatArray,
    models: Sequence[tuple[str, FloatArray]],
    *,
    joined: bool = True,
    label: str,
    unit: str,
) -> AxesGrid:
    """Draw the readings of one scan with each model's predictions, and below them the residuals.

    Parameters
    ----------
    along, readings
        Position or time, and readings, (n_rows,); NaN where there is no usable reading.
    models
        Name and predicted readings, (n_rows,), the calibrated model first.
    joined
        Whether the rows lie along a line, so that a curve may join them.
    label, unit
        Label of the x axis with its unit; unit of the readings.

    Returns
    -------
    The two axes, shape (2,).
    """
    axes = stack_of_axes([2.5, 2.0])
    above, below = axes
    above.plot(along, readings, "o", color=BLACK, markersize=3, alpha=0.7, label="recorded", zorder=1)
    below.axhline(0, color=BLACK, linewidth=0.7)
    for (name, predicted), (colour, marker, line) in zip(models, _STYLES, strict=False):
        style = {"color": colour, "marker": marker, "markersize": 3.2, "alpha": 0.8, "linestyle": "none"}
        curve = {"color": colour, "linewidth": 1.6, "linestyle": line} if joined else {**style, "markersize": 6.0}
        above.plot(along, predicted, label=f"predicted, {name}", **curve)
        below.plot(along, readings - predicted, label=f"residual, {name}", **{**style, "alpha": 0.5})
        if joined:
            below.plot(*running_mean_curve(along, readings - predicted), color=colour, linewidth=1.6, linestyle=line)
    below.sharex(above)
    label_axes(above, x="", y=f"reading ({unit})")
    label_axes(below, x=label, y=f"residual ({unit})")
    for ax in axes:
        set_plain_tick_labels(ax)
        legend_above(ax)
    return axes


def readings_in_order(recording: Recording, *, ax: Axes | None = None) -> Axes:
    """Draw usable readings by reading number, for recordings too short for any other figure."""
    require_recording(recording)
    ax = ax if ax is not None else stack_of_axes([2.7])[0]
    usable = np.flatnonzero(recording.usable)
    ax.plot(usable + 1, recording.readings[usable], "o", color=BLUE, markersize=5)
    label_axes(ax, x="reading number", y=f"reading ({recording.plan.instrumentation.unit_after_number})")
    set_plain_tick_labels(ax)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    return ax


def residuals_against_covariates(
    covariates: Sequence[tuple[str, FloatArray]], models: Sequence[tuple[str, FloatArray]], *, unit: str
) -> AxesGrid:
    """Draw all residuals against each covariate, with running means, one panel per covariate.

    Parameters
    ----------
    covariates
        Label with its unit, and values, (n_points,).
    models
        Name and residuals, (n_points,), NaN where there is no usable reading; the calibrated model first.
    unit
        Of the readings.

    Returns
    -------
    The axes, shape (n_covariates,).
    """
    axes = stack_of_axes([2.2] * len(covariates))
    for ax, (label, at) in zip(axes, covariates, strict=True):
        ax.axhline(0, color=BLACK, linewidth=0.7)
        for (name, residuals), (colour, _, line) in zip(models, _STYLES, strict=False):
            _draw_dots(ax, at, residuals, colour, "")
            ax.plot(
                *running_mean_curve(at, residuals),
                color=colour,
                linewidth=2.0,
                linestyle=line,
                label=f"running mean, {name}",
            )
        label_axes(ax, x=label, y=f"residual ({unit})")
        set_plain_tick_labels(ax)
        legend_above(ax)
    return axes


def heldout_gain_by_scan(
    scans: Sequence[tuple[str, float]], mean: float, sd: float, *, part: str = "scan", ax: Axes | None = None
) -> Axes:
    """Draw the gain on each held-out scan in nats per reading, largest on top, and the mean with its standard error.

    Parameters
    ----------
    scans
        Name and gain of each; of more than twelve, only the six largest and the six smallest gains are drawn.
    mean, sd
        Mean over all held-out readings, and its standard error.
    part
        Name of the held-out unit, such as "scan".
    ax
        Axes to draw on; a new figure without.
    """
    ranked = sorted(scans, key=lambda pair: -pair[1])
    if len(ranked) > _MOST_SCANS:
        ranked = [*ranked[: _MOST_SCANS // 2], *ranked[-_MOST_SCANS // 2 :]]
    ax = ax if ax is not None else stack_of_axes([1.0 + 0.28 * max(len(ranked), 3)])[0]
    gains = np.array([gain for _, gain in ranked])
    at = -np.arange(len(ranked), dtype=np.float64)
    ax.barh(at, gains, 0.62, color=[BLUE if gain >= 0 else VERMILLION for gain in gains])
    ax.axvspan(mean - sd, mean + sd, color=GREY, alpha=0.3, linewidth=0, zorder=0)
    said = f"all {part}s: {number_unsigned_zero(mean, 3)} ± {number_text(sd, 3)} nats per reading"
    ax.axvline(mean, color=GREY, linewidth=1.4, label=said)
    ax.axvline(0, color=BLACK, linewidth=0.7)
    ax.set_yticks(at, [name.replace("_", " ") for name, _ in ranked])
    ax.set_ylim(min(at[-1], -2.0) - 0.6, 0.6)
    label_axes(ax, x=f"gain on each held-out {part} (nats per reading)", y=f"held-out {part}")
    set_plain_tick_labels(ax, y=False)
    legend_above(ax)
    return ax


_CHANCE = "95 % by chance alone"
_STYLES = ((VERMILLION, "o", "-"), (BLUE, "s", (0, (4, 1.5))))


def _draw_dots(ax: Axes, x: FloatArray, y: FloatArray, colour: str, label: str) -> None:
    """Draw dots, smaller and paler if there are many."""
    ok = np.isfinite(x) & np.isfinite(y)
    n = max(int(ok.sum()), 1)
    size, alpha = float(np.clip(4000 / n, 4, 16)), 0.35 if n > _CROWDED else 0.7
    ax.scatter(x[ok], y[ok], size, color=colour, alpha=alpha, linewidth=0, label=label or None, rasterized=n > _MANY)


def _label_x_by_name(ax: Axes, names: Sequence[str]) -> None:
    """Label the positions 0, 1, 2 ... of the x axis by name; slanted and thinned where names do not fit."""
    width_in = cast(Figure, ax.figure).get_figwidth()  # none of our figures has subfigures
    fits = sum(len(name) + 2 for name in names) < 12 * width_in
    skip = max(1, round(len(names) / (4 * width_in)))
    slant: dict[str, Any] = {} if fits else {"rotation": 35, "ha": "right", "rotation_mode": "anchor"}
    at = np.arange(len(names))
    ax.set_xticks(at[::skip], [name.replace("_", " ") for name in names[::skip]], fontsize=SMALL_PT, **slant)
    ax.set_xlim(-0.6, len(names) - 0.4)
