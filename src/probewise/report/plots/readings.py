"""Readings of a recording by a light sensor, scan by scan: as recorded (paper, figure 5), as predicted (figure 7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import FloatArray, IntArray
from probewise.recordings import HalfPlane, Plan, Recording
from probewise.recordings.plan import require_recording
from probewise.report.plots import canvas

_MARKERS = ("o", "s", "D", "^", "v", "P", "X")
_MOST_NAMED = 8  # tracks in the legend, panels, and names of single readings; with more there is none
_SD_95 = 1.96
_ALONG_EDGE, _ALONG_SCAN = "distance from the edge{} (mm)", "place along the scan (mm)"


@dataclass(frozen=True, eq=False)
class Track:
    """Rows of one scan over one pattern, which a curve may join: `rows`, (n_rows,), are row numbers of the plan.

    `along_mm`, (n_rows,), is the signed distance from a half-plane's edge, positive on its brighter side (`from_edge`
    True); over another pattern, the position along the scan from its mean.
    """

    label: str
    rows: IntArray
    along_mm: FloatArray
    from_edge: bool


def tracks_and_single_rows(plan: Plan) -> tuple[list[Track], IntArray]:
    """Split a plan into tracks, one per scan and pattern with three or more positions, and the rows of no track."""
    tracks: list[Track] = []
    single = [np.empty(0, dtype=np.int64)]
    for scan_rows in plan.rows_by_scan():
        for code in np.unique(plan.pattern[scan_rows]):
            rows = scan_rows[plan.pattern[scan_rows] == code]
            pattern = plan.patterns.get(plan.pattern_names[code])
            along = _signed_position_mm(plan, rows, pattern)
            if np.unique(np.round(along, 6)).size < 3:
                single.append(rows)
            else:
                tracks.append(Track(_track_label(plan, rows), rows, along, isinstance(pattern, HalfPlane)))
    names = [t.label for t in tracks]
    if len(set(names)) < len(names):  # several scans at one orientation: the scan's name tells them apart
        tracks = [replace(t, label=f"{t.label} ({plan.scan_names[plan.scan[t.rows[0]]]})") for t in tracks]
    return tracks, np.concatenate(single)


def _signed_position_mm(plan: Plan, rows: IntArray, pattern: object) -> FloatArray:
    x, y = plan.x_mm[rows], plan.y_mm[rows]
    if isinstance(pattern, HalfPlane):
        inwards = x * np.cos(pattern.normal_rad) + y * np.sin(pattern.normal_rad) - pattern.offset_mm
        return np.asarray(inwards if pattern.inside >= pattern.outside else -inwards)
    dx, dy = x - x.mean(), y - y.mean()
    angle = 0.5 * np.arctan2(2 * (dx @ dy), dx @ dx - dy @ dy)  # principal direction of the places
    return np.asarray(dx * np.cos(angle) + dy * np.sin(angle))


def _track_label(plan: Plan, rows: IntArray) -> str:
    degrees = np.unique(np.round(np.degrees(plan.orientation_rad[rows]), 1) % 360)
    label = f"{degrees[0]:g}°" if degrees.size == 1 else plan.scan_names[plan.scan[rows[0]]]
    pattern = plan.pattern_names[plan.pattern[rows[0]]]
    if len(plan.rows_by_pattern()) > 1 and not isinstance(plan.patterns.get(pattern), HalfPlane):
        label += f" over {pattern}"
    return label


def _along_label(tracks: Sequence[Track], side: str = "") -> str:
    return _ALONG_EDGE.format(side) if all(t.from_edge for t in tracks) else _ALONG_SCAN


def readings_by_orientation(recording: Recording, *, ax: Axes | None = None) -> Axes:
    """Draw readings against distance from the edge, a symbol for each orientation (paper, figure 5).

    Rows over half-planes are drawn by signed distance from the edge, others by position along the scan. Single rows
    (the quadrants) are drawn by `predicted_and_recorded_by_scan` only.
    """
    require_recording(recording)
    ax = canvas.axes_or_new(ax, size_in=(canvas.PANEL_IN, 4.2))
    tracks, _ = tracks_and_single_rows(recording.plan)
    size = 4 if len(tracks) <= _MOST_NAMED else 2
    for k, track in enumerate(tracks):
        ok = recording.usable[track.rows]
        along, readings = track.along_mm[ok], recording.readings[track.rows][ok]
        (drawn,) = ax.plot(along, readings, _MARKERS[k % len(_MARKERS)], markersize=size, label=track.label)
        drawn.set(color=canvas.CYCLE[k % len(canvas.CYCLE)], markerfacecolor="none", markeredgewidth=1.0)
    if 0 < len(tracks) <= _MOST_NAMED:
        turned = all("°" in track.label for track in tracks)
        canvas.legend_above(ax, title="orientation of the sensor" if turned else "scan")
    unit = recording.plan.instrumentation.unit_after_number
    return canvas.label_axes(ax, x=_along_label(tracks, ", white side positive"), y=f"reading ({unit})")


def predicted_and_recorded_by_scan(recording: Recording, mean: FloatArray, sd: FloatArray) -> canvas.AxesGrid:
    """Draw recorded and predicted readings with the 95 % band of new readings (paper, figure 7).

    Each panel shows a scan over one pattern, the last one all single readings; of more than eight panels, evenly spaced
    ones are drawn. `mean` is the predicted reading of each row and `sd` that of one new reading, (n_points,). Return
    the axes, (n_rows, 3), or of as many columns as there are panels.
    """
    require_recording(recording)
    tracks, alone = tracks_and_single_rows(recording.plan)
    most = min(len(tracks), _MOST_NAMED - bool(alone.size))
    evenly = np.unique(np.linspace(0, max(len(tracks) - 1, 0), most).round().astype(np.int64))
    shown = [tracks[i] for i in evenly]
    n_panels = max(len(shown) + bool(alone.size), 1)
    n_columns = min(n_panels, 3)
    n_rows = -(-n_panels // n_columns)
    axes = canvas.grid_of_axes(n_rows, n_columns, size_in=(canvas.PAGE_IN, 0.6 + 2.4 * n_rows), sharey=True)
    for ax, track in zip(axes.flat, shown, strict=False):
        _draw_track(ax, recording, track, mean, sd)
        canvas.label_axes(ax, x=_along_label([track]), y="", title=track.label)
    if alone.size:
        ax = axes.flat[len(shown)]
        _draw_single_readings(ax, recording, alone, mean, sd)
        canvas.label_axes(ax, x="", y="", title="single readings")
    for ax in list(axes.flat)[n_panels:]:
        ax.set_visible(False)
    for ax in axes[:, 0]:
        ax.set_ylabel(f"reading ({recording.plan.instrumentation.unit_after_number})")
    canvas.legend_below(axes)
    return axes


def _draw_track(ax: Axes, recording: Recording, track: Track, mean: FloatArray, sd: FloatArray) -> None:
    order = np.argsort(track.along_mm, kind="stable")
    rows, along = track.rows[order], track.along_mm[order]
    ok, half = recording.usable[rows], _SD_95 * sd[rows]
    band = (mean[rows] - half, mean[rows] + half)
    ax.fill_between(along, *band, label="holds 95 % of new readings", **canvas.BAND)
    if ok.any():
        ax.plot(along[ok], recording.readings[rows][ok], ".", color=canvas.VERMILLION, markersize=3.5, label="recorded")
    ax.plot(along, mean[rows], color=canvas.BLACK, linewidth=1.1, label="predicted")


def _draw_single_readings(ax: Axes, recording: Recording, rows: IntArray, mean: FloatArray, sd: FloatArray) -> None:
    at, ok, plan = np.arange(len(rows)), recording.usable[rows], recording.plan
    ax.errorbar(at, mean[rows], yerr=_SD_95 * sd[rows], fmt="_", color=canvas.BLACK, capsize=4, markersize=12)
    ax.plot(at[ok], recording.readings[rows][ok], "o", color=canvas.VERMILLION, markersize=5)
    if len(rows) <= _MOST_NAMED:
        names = [plan.pattern_names[code].replace("_", " ") for code in plan.pattern[rows]]
        ax.set_xticks(at, names, rotation=30, ha="right", fontsize=canvas.SMALL_PT)
    ax.margins(x=0.15)


def standardised_residuals(recording: Recording, mean: FloatArray, sd: FloatArray, *, ax: Axes | None = None) -> Axes:
    """Draw (recorded minus predicted) / sd, (n_points,), by reading number; dashed lines at ±1.96 should hold 95 %."""
    require_recording(recording)
    ax = canvas.axes_or_new(ax, size_in=(7.2, 2.8))
    ok = np.flatnonzero(recording.usable)
    ax.plot(ok + 1, (recording.readings[ok] - mean[ok]) / sd[ok], ".", color=canvas.BLUE, markersize=3)
    for level in (-_SD_95, 0.0, _SD_95):
        ax.axhline(level, color=canvas.GREY, linewidth=0.8, linestyle="-" if level == 0 else "--")
    return canvas.label_axes(ax, x="reading number", y="(recorded − predicted) / sd")
