"""Readings of a recording by a light sensor, scan by scan: as recorded, as predicted, before and after a repair.

The paper's figures 3 (the sensor over the edge), 4 (quadrants), 5 (data of the four orientations) and 7 (predicted).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from probewise._arrays import FloatArray, IntArray
from probewise.errors import require
from probewise.recordings import HalfPlane, Plan, Quadrant, Recording
from probewise.recordings.plan import require_recording
from probewise.report.plots import canvas
from probewise.report.plots.apparatus import draw_sensor_face
from probewise.report.plots.residuals import draw_running_mean
from probewise.report.words import decimals_to_show, number_text, number_unsigned_zero

_MARKERS = ("o", "s", "D", "^", "v", "P", "X")
_MOST_NAMED = 8  # tracks in the legend, panels, and names of single readings; with more there is none
_SD_95 = 1.96
_ALONG_EDGE, _ALONG_SCAN = "distance from the edge{} (mm)", "place along the scan (mm)"
_DARK, _BRIGHT = "#1b1b1b", "#ffffff"
_AROUND_MM = 16.0  # half width of the drawing of a quadrant


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
    """Return the label of the axis of positions: distance from the edge if all tracks cross one."""
    return _ALONG_EDGE.format(side) if all(t.from_edge for t in tracks) else _ALONG_SCAN


def _symbol_of_track(k: int) -> dict[str, Any]:
    marker, colour = _MARKERS[k % len(_MARKERS)], canvas.CYCLE[k % len(canvas.CYCLE)]
    return {"linestyle": "none", "marker": marker, "color": colour, "markerfacecolor": "none"}


def readings_by_orientation(recording: Recording, *, ax: Axes | None = None) -> Axes:
    """Draw readings against distance from the edge, a symbol for each orientation (paper, figure 5).

    Rows over half-planes are drawn by signed distance from the edge, others by position along the scan. Single rows
    (the quadrants) are drawn by `predicted_and_recorded_by_scan` only.
    """
    require_recording(recording)
    ax = canvas.axes_or_new(ax)
    tracks, _ = tracks_and_single_rows(recording.plan)
    size = 4 if len(tracks) <= _MOST_NAMED else 2
    for k, track in enumerate(tracks):
        ok = recording.usable[track.rows]
        along, readings = track.along_mm[ok], recording.readings[track.rows][ok]
        ax.plot(along, readings, markersize=size, markeredgewidth=1.0, label=track.label, **_symbol_of_track(k))
    if 0 < len(tracks) <= _MOST_NAMED:
        turned = all("°" in track.label for track in tracks)
        canvas.legend_above(ax, title="orientation of the sensor" if turned else "scan")
    unit = recording.plan.instrumentation.unit_after_number
    return canvas.label_axes(ax, x=_along_label(tracks, ", white side positive"), y=f"reading ({unit})")


def sensor_orientations(recording: Recording, *, ax: Axes | None = None) -> Axes:
    """Draw the sensor in each orientation of the scans over half-planes, with its symbol (paper, figure 3).

    The symbols are those of `readings_by_orientation`. ParameterError if no scan crosses a half-plane.
    """
    require_recording(recording)
    plan = recording.plan
    lines = [(k, track) for k, track in enumerate(tracks_and_single_rows(plan)[0]) if track.from_edge]
    require(lines, "recording", recording.source or "as given", "one with a scan over a half_plane")
    turns = {track.label: (k, float(plan.orientation_rad[track.rows[0]])) for k, track in lines}
    n = len(turns)
    ax = canvas.axes_or_new(ax, size_in=(1.55 * n, 2.9))
    edge = plan.patterns[plan.pattern_names[int(plan.pattern[lines[0][1].rows[0]])]]
    assert isinstance(edge, HalfPlane)
    for left, shade in zip((0.0, n / 2), _shades_out_and_in(edge), strict=True):
        ax.add_patch(Rectangle((left, 0.0), n / 2, 1.0, fc=shade, ec=canvas.BLACK))
    for place, (label, (k, turn)) in enumerate(turns.items()):
        at = place + 0.5
        draw_sensor_face(ax, center=(at, 0.5), size=0.62, turned_rad=turn)
        draw_sensor_face(ax, center=(at, 1.75), size=0.9, turned_rad=turn)
        ax.plot(at - 0.16, 2.42, markersize=7, markeredgewidth=1.4, **_symbol_of_track(k))
        ax.text(at - 0.02, 2.42, label, va="center")
    along = np.concatenate([track.along_mm for _, track in lines])
    ax.annotate("", (n - 0.3, -0.2), xytext=(0.3, -0.2), arrowprops={"arrowstyle": "-|>", "color": canvas.BLACK})
    span = f"{number_unsigned_zero(along.min(), 0)} to {number_unsigned_zero(along.max(), 0)} mm"
    ax.text(n / 2, -0.28, f"every scan runs across the edge, {span}", ha="center", va="top")
    ax.set(xlim=(-0.05, n + 0.05), ylim=(-0.62, 2.65), aspect="equal")
    ax.set_axis_off()
    return ax


def _shades_out_and_in(pattern: HalfPlane | Quadrant) -> tuple[str, str]:
    return (_DARK, _BRIGHT) if pattern.inside >= pattern.outside else (_BRIGHT, _DARK)


def quadrant_patterns(recording: Recording) -> canvas.AxesGrid:
    """Draw each quadrant pattern with its corner and the mean of the usable readings there (paper, figure 4).

    Return the axes, (n_rows, 2). ParameterError if there are no readings over quadrants.
    """
    require_recording(recording)
    plan = recording.plan
    quadrants = [
        (name, pattern, recording.readings[rows[recording.usable[rows]]])
        for name, rows in plan.rows_by_pattern()
        if isinstance(pattern := plan.patterns.get(name), Quadrant)
    ]
    require(quadrants, "recording", recording.source or "as given", "one with readings over a quadrant")
    n_rows = -(-len(quadrants) // 2)
    axes = canvas.grid_of_axes(n_rows, 2, size_in=(4.6, 2.35 * n_rows + 0.1))
    for ax in axes.flat:
        ax.set_axis_off()
    unit = plan.instrumentation.unit_after_number
    for ax, (name, pattern, readings) in zip(axes.flat, quadrants, strict=False):
        mean = float(readings.mean()) if readings.size else float("nan")
        _draw_quadrant(ax, pattern, number_text(mean, decimals_to_show(mean, 1)))
        ax.set_title(f"{name.replace('_', ' ')} ({unit})", **canvas.TITLE)
    return axes


def _draw_quadrant(ax: Axes, pattern: Quadrant, reading: str) -> None:
    outside, inside = _shades_out_and_in(pattern)
    (x, y), (dx, dy) = pattern.corner_mm, pattern.direction
    whole = ((-_AROUND_MM, -_AROUND_MM), 2 * _AROUND_MM, 2 * _AROUND_MM)
    ax.add_patch(Rectangle(*whole, fc=outside, ec="none"))
    (x0, x1), (y0, y1) = sorted((x, dx * _AROUND_MM)), sorted((y, dy * _AROUND_MM))
    ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fc=inside, ec="none"))
    ax.add_patch(Rectangle(*whole, fc="none", ec=canvas.BLACK, clip_on=False))
    ink, ink_around = (canvas.BLACK, "white") if inside == _BRIGHT else ("white", canvas.BLACK)
    middle = ((x + dx * _AROUND_MM) / 2, (y + dy * _AROUND_MM) / 2)
    ax.text(*middle, reading, ha="center", va="center", color=ink, fontsize="large")
    corner = f"({number_unsigned_zero(x, 0)}, {number_unsigned_zero(y, 0)}) mm"
    ax.text(x - dx * 1.2, y - dy * 1.2, corner, ha="right" if dx > 0 else "left", va="top", color=ink_around)
    ax.plot(0.0, 0.0, marker="+", markersize=10, markeredgewidth=1.4, color=canvas.GREY)
    ax.set(xlim=(-_AROUND_MM, _AROUND_MM), ylim=(-_AROUND_MM, _AROUND_MM), aspect="equal")


def predicted_and_recorded_by_scan(recording: Recording, mean: FloatArray, sd: FloatArray) -> canvas.AxesGrid:
    """Draw recorded and predicted readings with the 95 % band of new readings (paper, figure 7).

    Each panel shows a scan over one pattern, the last one all single readings; of more than eight panels, evenly spaced
    ones are drawn. `mean` is the predicted reading of each row and `sd` that of one new reading, (n_points,). Return
    the axes, (n_rows, 3) (two columns where there are two or four panels, one for one panel).
    """
    require_recording(recording)
    tracks, alone = tracks_and_single_rows(recording.plan)
    most = min(len(tracks), _MOST_NAMED - bool(alone.size))
    evenly = np.unique(np.linspace(0, max(len(tracks) - 1, 0), most).round().astype(np.int64))
    shown = [tracks[i] for i in evenly]
    n_panels = max(len(shown) + bool(alone.size), 1)
    n_columns = min(n_panels, 2 if n_panels in (2, 4) else 3)
    n_rows = -(-n_panels // n_columns)
    width = 4.4 * n_columns if n_columns < 3 else canvas.PAGE_IN
    axes = canvas.grid_of_axes(n_rows, n_columns, size_in=(width, 0.4 + 2.4 * n_rows), sharey=True)
    for ax, track in zip(axes.flat, shown, strict=False):
        _draw_track(ax, recording, track, mean, sd)
        canvas.label_axes(ax, x="", y="", title=track.label)
    if alone.size:
        ax = axes.flat[len(shown)]
        _draw_single_readings(ax, recording, alone, mean, sd)
        canvas.label_axes(ax, x="", y="", title="single readings")
    canvas.hide_unused(axes, n_panels)
    for ax in axes[:, 0]:
        ax.set_ylabel(f"reading ({recording.plan.instrumentation.unit_after_number})")
    for ax in list(axes.flat)[max(n_panels - n_columns, 0) : len(shown)]:
        ax.set_xlabel(_along_label(shown))
    canvas.legend_below(axes)
    return axes


def _draw_track(ax: Axes, recording: Recording, track: Track, mean: FloatArray, sd: FloatArray) -> None:
    order = np.argsort(track.along_mm, kind="stable")
    rows, along = track.rows[order], track.along_mm[order]
    ok, half = recording.usable[rows], _SD_95 * sd[rows]
    ax.fill_between(
        along,
        mean[rows] - half,
        mean[rows] + half,
        color=canvas.GREY,
        alpha=0.35,
        lw=0,
        label="holds 95 % of new readings",
    )
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


def residuals_by_scan(recording: Recording, before: FloatArray, after: FloatArray, *, most: int = 9) -> canvas.AxesGrid:
    """Draw the residuals of two models along the `most` scans that the repair changes most, a panel each, on one scale.

    Each usable residual, and running means; `before` and `after` are predictions, (n_points,). Return the axes,
    (n_rows, 3).
    """
    require_recording(recording)
    tracks, _ = tracks_and_single_rows(recording.plan)
    change = [float(np.mean((after[track.rows] - before[track.rows]) ** 2)) for track in tracks]
    shown = [tracks[k] for k in sorted(np.argsort(change, kind="stable")[::-1][:most].tolist())]
    n_rows = max(-(-len(shown) // 3), 1)
    axes = canvas.grid_of_axes(n_rows, 3, size_in=(canvas.PAGE_IN, 1.75 * n_rows + 0.7), sharex=True, sharey=True)
    models = {"calibrated model": (before, canvas.VERMILLION), "repaired model": (after, canvas.BLUE)}
    for ax, track in zip(axes.flat, shown, strict=False):
        ok = recording.usable[track.rows]
        rows, along = track.rows[ok], track.along_mm[ok]
        for predicted, colour in models.values():
            residual = recording.readings[rows] - predicted[rows]
            ax.plot(along, residual, ".", color=colour, markersize=2.2, alpha=0.4)
            draw_running_mean(ax, along, residual, colour=colour, width=1.8)
        ax.axhline(0.0, **canvas.THIN)
        scan = recording.plan.scan_names[int(recording.plan.scan[track.rows[0]])]
        canvas.label_axes(ax, x="", y="", title=scan.replace("_", " "))
    canvas.hide_unused(axes, len(shown))
    sheet, edge = canvas.figure_of(axes), _along_label([])
    sheet.supxlabel(edge if _along_label(shown) == edge else f"{edge}, or {_ALONG_SCAN}", fontsize=10)
    sheet.supylabel(f"recorded − predicted ({recording.plan.instrumentation.unit_after_number})", fontsize=10)
    lines = [Line2D([], [], color=colour, linewidth=1.8) for _, colour in models.values()]
    style = {"ncols": 2, "frameon": False, "fontsize": canvas.SMALL_PT}
    sheet.legend(lines, list(models), loc="outside upper left", **style)
    return axes
