"""The patterns of a recording: sensor orientations over the boundary, and the quadrants (paper, figures 3 and 4)."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from probewise.errors import ParameterError
from probewise.recordings import HalfPlane, Quadrant, Recording
from probewise.recordings.plan import require_recording
from probewise.report.plots.apparatus import draw_sensor_face
from probewise.report.plots.canvas import BLACK, CYCLE, GREY, AxesGrid, axes_or_new, grid_of_axes
from probewise.report.plots.readings import MARKERS, tracks_and_single_rows
from probewise.report.words import decimals_to_show, number_text, number_unsigned_zero

_DARK, _BRIGHT = "#1b1b1b", "#ffffff"
_AROUND_MM = 16.0


def sensor_orientations(recording: Recording, *, ax: Axes | None = None) -> Axes:
    """Draw the sensor in each orientation of the scans over the boundary, with its symbol (paper, figure 3).

    Parameters
    ----------
    recording
        Its scans over half-planes are shown, one per orientation, with the symbols of `readings_by_orientation`.
    ax
        Axes to draw on; a new figure without.

    Raises
    ------
    ParameterError
        If no scan crosses a half-plane.
    """
    require_recording(recording)
    plan = recording.plan
    lines = [(k, track) for k, track in enumerate(tracks_and_single_rows(plan)[0]) if track.from_edge]
    if not lines:
        raise ParameterError("recording", recording.source or "as given", "one with a scan over a half_plane")
    turns = {track.label: (k, float(plan.orientation_rad[track.rows[0]]), track) for k, track in lines}
    n = len(turns)
    ax = axes_or_new(ax, size_in=(1.55 * n, 2.9))
    edge = plan.patterns[plan.pattern_names[int(plan.pattern[lines[0][1].rows[0]])]]
    assert isinstance(edge, HalfPlane)
    left, right = (_DARK, _BRIGHT) if edge.inside >= edge.outside else (_BRIGHT, _DARK)
    ax.add_patch(Rectangle((0.0, 0.0), n / 2, 1.0, fc=left, ec=BLACK))
    ax.add_patch(Rectangle((n / 2, 0.0), n / 2, 1.0, fc=right, ec=BLACK))
    for place, (label, (k, turn, _)) in enumerate(turns.items()):
        at = place + 0.5
        draw_sensor_face(ax, center=(at, 0.5), size=0.62, turned_rad=turn)
        draw_sensor_face(ax, center=(at, 1.75), size=0.9, turned_rad=turn)
        ax.plot(
            at - 0.16,
            2.42,
            linestyle="none",
            marker=MARKERS[k % len(MARKERS)],
            markersize=7,
            markerfacecolor="none",
            markeredgewidth=1.4,
            color=CYCLE[k % len(CYCLE)],
        )
        ax.text(at - 0.02, 2.42, label, va="center")
    along = np.concatenate([track.along_mm for _, track in lines])
    ax.annotate("", (n - 0.3, -0.2), xytext=(0.3, -0.2), arrowprops={"arrowstyle": "-|>", "color": BLACK})
    span = f"{number_unsigned_zero(along.min(), 0)} to {number_unsigned_zero(along.max(), 0)} mm"
    ax.text(n / 2, -0.28, f"every scan runs across the edge, {span}", ha="center", va="top")
    ax.set(xlim=(-0.05, n + 0.05), ylim=(-0.62, 2.65), aspect="equal")
    ax.set_axis_off()
    return ax


def quadrant_patterns(recording: Recording) -> AxesGrid:
    """Draw each quadrant pattern with its corner and the reading taken there (paper, figure 4).

    Parameters
    ----------
    recording
        A recording with readings over quadrants; usable ones over one quadrant are averaged.

    Returns
    -------
    Axes, (n_rows, 2).

    Raises
    ------
    ParameterError
        If it has no readings over quadrants.
    """
    require_recording(recording)
    plan = recording.plan
    found = [
        (name, pattern, rows[recording.usable[rows]])
        for name, rows in plan.rows_by_pattern()
        if isinstance(pattern := plan.patterns.get(name), Quadrant)
    ]
    if not found:
        raise ParameterError("recording", recording.source or "as given", "one with readings over a quadrant")
    n_rows = -(-len(found) // 2)
    axes = grid_of_axes(n_rows, 2, size_in=(4.6, 2.35 * n_rows + 0.1))
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, (name, pattern, rows) in zip(axes.flat, found, strict=False):
        _draw_quadrant(ax, pattern)
        mean = float(recording.readings[rows].mean()) if rows.size else float("nan")
        (x, y), (dx, dy) = pattern.corner_mm, pattern.direction
        middle = ((x + dx * _AROUND_MM) / 2, (y + dy * _AROUND_MM) / 2)
        inside, around = (BLACK, "white") if pattern.inside >= pattern.outside else ("white", BLACK)
        ax.text(
            *middle,
            number_text(mean, decimals_to_show(mean, 1)),
            ha="center",
            va="center",
            color=inside,
            fontsize="large",
        )
        said = f"({number_unsigned_zero(x, 0)}, {number_unsigned_zero(y, 0)}) mm"
        ax.text(x - dx * 1.2, y - dy * 1.2, said, ha="right" if dx > 0 else "left", va="top", color=around)
        ax.plot(0.0, 0.0, marker="+", markersize=10, markeredgewidth=1.4, color=GREY)
        ax.set(xlim=(-_AROUND_MM, _AROUND_MM), ylim=(-_AROUND_MM, _AROUND_MM), aspect="equal")
        ax.set_title(
            f"{name.replace('_', ' ')} ({plan.instrumentation.unit_after_number})", fontsize="medium", loc="left"
        )
    return axes


def _draw_quadrant(ax: Axes, pattern: Quadrant) -> None:
    shades = (_DARK, _BRIGHT) if pattern.inside >= pattern.outside else (_BRIGHT, _DARK)
    whole = ((-_AROUND_MM, -_AROUND_MM), 2 * _AROUND_MM, 2 * _AROUND_MM)
    ax.add_patch(Rectangle(*whole, fc=shades[0], ec="none"))
    spans = [
        sorted((corner, side * _AROUND_MM)) for corner, side in zip(pattern.corner_mm, pattern.direction, strict=True)
    ]
    (x0, x1), (y0, y1) = spans
    ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fc=shades[1], ec="none"))
    ax.add_patch(Rectangle(*whole, fc="none", ec=BLACK, clip_on=False))
