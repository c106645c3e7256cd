"""Predicted and recorded readings, and their residuals."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import FloatArray, IntArray
from probewise._words import unit_after_number
from probewise.recordings import Recording
from probewise.recordings.plan import require_recording
from probewise.report.plots.canvas import (
    BLACK,
    BLUE,
    GREY,
    PAGE_IN,
    SMALL_PT,
    VERMILLION,
    AxesGrid,
    axes_or_grid,
    axes_or_new,
    label_axes,
    legend_above,
    legend_below,
)
from probewise.report.plots.readings import Track, track_axis_label, tracks_and_single_rows
from probewise.report.residual_means import running_mean_curve

MAX_PANELS = 8


def predicted_and_recorded_by_scan(
    recording: Recording, mean: FloatArray, sd: FloatArray, *, axes: AxesGrid | None = None
) -> AxesGrid:
    """Draw recorded and predicted readings with the 95 % band of new readings (paper, figure 7).

    Each panel shows a scan over one pattern, the last one all single readings. Of more than eight panels, evenly spaced
    ones are drawn.

    Parameters
    ----------
    recording
        The recording.
    mean, sd
        Predicted reading of each row and the sd of one new reading, shape (n_points,).
    axes
        Axes to draw on, of the shape returned; a new figure without.

    Returns
    -------
    Axes, (n_rows, 3) (two columns where there are two or four panels, one for one panel).
    """
    require_recording(recording)
    found, alone = tracks_and_single_rows(recording.plan)
    shown = [found[i] for i in _evenly_spaced_indices(len(found), MAX_PANELS - bool(alone.size))]
    n_panels = max(len(shown) + bool(alone.size), 1)
    n_columns = min(n_panels, 2 if n_panels in (2, 4) else 3)
    n_rows = -(-n_panels // n_columns)
    width = 4.4 * n_columns if n_columns < 3 else PAGE_IN
    own = axes is None
    axes = axes_or_grid(axes, n_rows, n_columns, size_in=(width, 0.4 + 2.4 * n_rows), sharey=True)
    unit = recording.plan.instrumentation.unit
    for ax, track in zip(axes.flat, shown, strict=False):
        _draw_track(ax, recording, track, mean, sd)
        label_axes(ax, x="", y="", title=track.label)
    if alone.size:
        ax = axes.flat[len(shown)]
        _draw_single_readings(ax, recording, alone, mean, sd)
        label_axes(ax, x="", y="", title="single readings")
    for ax in list(axes.flat)[n_panels:]:
        ax.set_visible(False)
    for ax in axes[:, 0]:
        ax.set_ylabel(f"reading ({unit_after_number(unit)})")
    for k in range(max(n_panels - n_columns, 0), len(shown)):
        axes.flat[k].set_xlabel(track_axis_label(shown).replace(", white side positive", ""))
    if own:
        legend_below(axes)
    else:
        axes.flat[0].legend(frameon=False, fontsize=SMALL_PT)
    return axes


def _evenly_spaced_indices(n: int, most: int) -> IntArray:
    """Return at most `most` of the indices 0 to n - 1, evenly spaced."""
    return np.unique(np.linspace(0, max(n - 1, 0), min(n, most)).round().astype(np.int64))[:n]


def _draw_track(ax: Axes, recording: Recording, track: Track, mean: FloatArray, sd: FloatArray) -> None:
    order = np.argsort(track.along_mm, kind="stable")
    rows, along = track.rows[order], track.along_mm[order]
    ok = recording.usable[rows]
    low, high = mean[rows] - 1.96 * sd[rows], mean[rows] + 1.96 * sd[rows]
    ax.fill_between(along, low, high, color=GREY, alpha=0.35, lw=0, label="holds 95 % of new readings")
    if ok.any():
        ax.plot(along[ok], recording.readings[rows][ok], ".", color=VERMILLION, markersize=3.5, label="recorded")
    ax.plot(along, mean[rows], color=BLACK, linewidth=1.1, label="predicted")


def _draw_single_readings(ax: Axes, recording: Recording, rows: IntArray, mean: FloatArray, sd: FloatArray) -> None:
    at = np.arange(len(rows))
    ax.errorbar(at, mean[rows], yerr=1.96 * sd[rows], fmt="_", color=BLACK, capsize=4, markersize=12)
    ok = recording.usable[rows]
    ax.plot(at[ok], recording.readings[rows][ok], "o", color=VERMILLION, markersize=5)
    names = [recording.plan.pattern_names[recording.plan.pattern[r]].replace("_", " ") for r in rows]
    if len(rows) <= 8:
        ax.set_xticks(at, names, rotation=30, ha="right", fontsize=SMALL_PT)
    ax.margins(x=0.15)


def standardised_residuals(recording: Recording, mean: FloatArray, sd: FloatArray, *, ax: Axes | None = None) -> Axes:
    """Draw recorded minus predicted readings over their sd, by reading number; dashed lines at ±1.96 should hold 95 %.

    Parameters
    ----------
    recording, mean, sd
        As for `predicted_and_recorded_by_scan`.
    ax
        Axes to draw on; a new figure without.
    """
    require_recording(recording)
    ax = axes_or_new(ax, size_in=(7.2, 2.8))
    ok = np.flatnonzero(recording.usable)
    ax.plot(ok + 1, (recording.readings[ok] - mean[ok]) / sd[ok], ".", color=BLUE, markersize=3)
    for level in (-1.96, 0.0, 1.96):
        ax.axhline(level, color=GREY, linewidth=0.8, linestyle="-" if level == 0 else "--")
    return label_axes(ax, x="reading number", y="(recorded − predicted) / sd")


def residuals_against(
    covariate: FloatArray,
    before: FloatArray,
    after: FloatArray,
    *,
    label: str,
    unit: str,
    span: tuple[float, float] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw residuals against a covariate, before and after the repair, with their running means.

    Parameters
    ----------
    covariate, before, after
        Shape (n_points,): the covariate, and recorded minus predicted reading by the null and the repaired model.
    label, unit
        The covariate with its unit; the unit of a reading.
    span
        Interval of the covariate in which the mismatch was found, shaded.
    ax
        Axes to draw on; a new figure without.
    """
    ax = axes_or_new(ax, size_in=(7.2, 3.2))
    if span is not None:
        ax.axvspan(*span, color=GREY, alpha=0.2, lw=0)
    for residual, colour, name in ((before, VERMILLION, "model as calibrated"), (after, BLUE, "repaired model")):
        ok = np.isfinite(residual) & np.isfinite(covariate)
        ax.plot(covariate[ok], residual[ok], ".", color=colour, markersize=2.5, alpha=0.45)
        center, average = running_mean_curve(covariate[ok], residual[ok])
        ax.plot(center, average, color=colour, linewidth=2.0, label=name)
    ax.axhline(0, color=BLACK, linewidth=0.7)
    legend_above(ax)
    return label_axes(ax, x=label, y=f"recorded − predicted ({unit_after_number(unit)})")
