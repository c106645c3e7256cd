"""Residuals of two models: one panel per scan, and one scan in detail."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.lines import Line2D

from probewise._arrays import FloatArray, IntArray
from probewise.errors import ParameterError
from probewise.recordings import Recording
from probewise.recordings.plan import require_recording
from probewise.report.plots.canvas import BLACK, BLUE, SMALL_PT, VERMILLION, AxesGrid, grid_of_axes, label_axes
from probewise.report.plots.readings import Track, tracks_and_single_rows

_MOST_GROUPS, _LEAST_ROWS = 18, 5  # number of groups of neighbours in a running mean
_TELLING = 0.3  # share of the repair's largest change: the figure shows where the change exceeds it
_BEFORE, _AFTER = "calibrated model", "repaired model"
_ALONG = "distance from the edge (mm)"
_ALONG_OTHERS = "place along the scan (mm)"


def residuals_by_scan(
    recording: Recording, before: FloatArray, after: FloatArray, *, most: int = 9, columns: int = 3
) -> AxesGrid:
    """Draw the residuals of two models along each scan, one panel per scan, all with the same scales.

    Parameters
    ----------
    recording
        The recording.
    before, after
        Predicted readings by the calibrated and by the repaired model, (n_points,).
    most
        Number of scans drawn: those that the repair changes most (mean square), in the plan's order.
    columns
        Panels per row.

    Returns
    -------
    Axes, (n_rows, columns); those without a scan are hidden.
    """
    require_recording(recording)
    found, _ = tracks_and_single_rows(recording.plan)
    change = [float(np.mean((after[track.rows] - before[track.rows]) ** 2)) for track in found]
    shown = [found[k] for k in sorted(np.argsort(change, kind="stable")[::-1][:most].tolist())]
    n_rows = max(-(-len(shown) // columns), 1)
    axes = grid_of_axes(n_rows, columns, size_in=(3.2 * columns, 1.75 * n_rows + 0.7), sharex=True, sharey=True)
    for ax, track in zip(axes.flat, shown, strict=False):
        for predicted, colour in ((before, VERMILLION), (after, BLUE)):
            along, residual = _positions_and_residuals(recording, track, predicted)
            ax.plot(along, residual, ".", color=colour, markersize=2.2, alpha=0.4)
            ax.plot(*_running_mean_by_position(along, residual), color=colour, linewidth=1.8)
        ax.axhline(0.0, color=BLACK, linewidth=0.7)
        label_axes(ax, x="", y="", title=_scan_title(recording, track))
    for ax in list(axes.flat)[len(shown) :]:
        ax.set_visible(False)
    sheet = axes.flat[0].figure
    sheet.supxlabel(_ALONG if all(track.from_edge for track in shown) else f"{_ALONG}, or {_ALONG_OTHERS}", fontsize=10)
    sheet.supylabel(f"recorded − predicted ({recording.plan.instrumentation.unit_after_number})", fontsize=10)
    lines = [Line2D([], [], color=colour, linewidth=1.8) for colour in (VERMILLION, BLUE)]
    sheet.legend(lines, [_BEFORE, _AFTER], loc="outside upper left", ncols=2, frameon=False, fontsize=SMALL_PT)
    return axes


def readings_before_and_after_repair(
    recording: Recording, rows: IntArray, before: FloatArray, after: FloatArray, *, name: str = ""
) -> AxesGrid:
    """Draw readings with the curves of two models, and below them the residuals, around where the models differ.

    Parameters
    ----------
    recording
        The recording.
    rows
        Row numbers, (n_rows,): one scan, or several over one pattern in one orientation.
    before, after
        Predicted readings by the calibrated and by the repaired model, (n_points,).
    name
        Title.

    Returns
    -------
    Axes, (2, 1).

    Raises
    ------
    ParameterError
        If no three of the readings lie along a line.
    """
    require_recording(recording)
    found, _ = tracks_and_single_rows(recording.plan.take(rows))
    if not found:
        raise ParameterError("rows", rows.tolist(), "readings at three places or more along one line")
    axes = grid_of_axes(2, 1, size_in=(7.4, 5.0), sharex=True, height_ratios=[1.7, 1.0])
    above, below = axes[:, 0]
    for k, track in enumerate(found):
        order = np.argsort(track.along_mm, kind="stable")
        at, along = rows[track.rows[order]], track.along_mm[order]
        ok = recording.usable[at]
        above.plot(along[ok], recording.readings[at][ok], ".", color=BLACK, markersize=4, label="" if k else "recorded")
        for predicted, colour, said in ((before, VERMILLION, _BEFORE), (after, BLUE, _AFTER)):
            above.plot(along, predicted[at], color=colour, linewidth=1.5, label="" if k else said)
    low, high = _x_limits_around_change(found, rows, np.abs(after - before))
    for predicted, colour in ((before, VERMILLION), (after, BLUE)):
        sides = [
            _positions_and_residuals(recording, Track("", rows[t.rows], t.along_mm, t.from_edge), predicted)
            for t in found
        ]
        along, residual = (np.concatenate(parts) for parts in zip(*sides, strict=True))
        shown = (along >= low) & (along <= high)
        below.plot(along[shown], residual[shown], ".", color=colour, markersize=4, alpha=0.5)
        below.plot(*_running_mean_by_position(along[shown], residual[shown]), color=colour, linewidth=1.8)
    below.axhline(0.0, color=BLACK, linewidth=0.7)
    below.set_xlim(low, high)
    unit = recording.plan.instrumentation.unit_after_number
    above.legend(frameon=False, fontsize=SMALL_PT)
    label_axes(above, x="", y=f"reading ({unit})", title=name)
    from_edge = all(track.from_edge for track in found)
    label_axes(below, x=_ALONG if from_edge else _ALONG_OTHERS, y=f"recorded − predicted\n({unit})")
    return axes


def _x_limits_around_change(found: Sequence[Track], rows: IntArray, change: FloatArray) -> tuple[float, float]:
    """Return limits of the x axis (mm): where models differ by 30 % of the most or more, with as wide a margin."""
    along = np.concatenate([track.along_mm for track in found])
    by_place = np.concatenate([change[rows[track.rows]] for track in found])
    differs = along[by_place >= _TELLING * max(float(by_place.max()), 1e-300)]
    margin = float(np.ptp(differs)) + 1.0
    return max(float(along.min()), float(differs.min()) - margin), min(
        float(along.max()), float(differs.max()) + margin
    )


def _positions_and_residuals(
    recording: Recording, track: Track, predicted: FloatArray
) -> tuple[FloatArray, FloatArray]:
    ok = recording.usable[track.rows]
    rows = track.rows[ok]
    return track.along_mm[ok], np.asarray(recording.readings[rows] - predicted[rows])


def _running_mean_by_position(along: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean position and mean residual, (n_bins,) each, in up to 18 bins of equal width, none of them empty."""
    if along.size == 0:
        return along, residual
    edges = np.linspace(along.min(), along.max(), min(_MOST_GROUPS, max(along.size // _LEAST_ROWS, 1)) + 1)
    group = np.clip(np.searchsorted(edges, along, side="right") - 1, 0, len(edges) - 2)
    count = np.bincount(group, minlength=len(edges) - 1)
    some = count > 0
    middle = np.bincount(group, along, minlength=len(count))[some] / count[some]
    return middle, np.bincount(group, residual, minlength=len(count))[some] / count[some]


def _scan_title(recording: Recording, track: Track) -> str:
    return recording.plan.scan_names[int(recording.plan.scan[track.rows[0]])].replace("_", " ")
