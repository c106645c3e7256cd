"""The readings of a recording along its scans: the paper's figure of four orientations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import FloatArray, IntArray
from probewise.recordings import Plan, Recording
from probewise.recordings.patterns import HalfPlane
from probewise.recordings.plan import require_recording
from probewise.report.plots.canvas import CYCLE, axes_or_new, label_axes, legend_above

MARKERS = ("o", "s", "D", "^", "v", "P", "X")
MAX_NAMED = 8  # tracks in the legend; with more there is none


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
    """Split the rows of a plan into tracks and single rows.

    Returns
    -------
    The tracks, one per scan and pattern with three or more distinct positions; and the row numbers of all other rows.
    """
    found: list[Track] = []
    single: list[IntArray] = []
    for scan_rows in plan.rows_by_scan():
        for code in np.unique(plan.pattern[scan_rows]):
            rows = scan_rows[plan.pattern[scan_rows] == code]
            pattern = plan.patterns.get(plan.pattern_names[code])
            along = _signed_position_mm(plan, rows, pattern)
            if np.unique(np.round(along, 6)).size < 3:
                single.append(rows)
                continue
            found.append(Track(_track_label(plan, rows), rows, along, isinstance(pattern, HalfPlane)))
    names = [t.label for t in found]
    if len(set(names)) < len(names):  # several scans at one orientation: the scan's name tells them apart
        found = [
            Track(f"{t.label} ({plan.scan_names[plan.scan[t.rows[0]]]})", t.rows, t.along_mm, t.from_edge)
            for t in found
        ]
    return found, np.concatenate(single) if single else np.empty(0, dtype=np.int64)


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
    if len(plan.rows_by_pattern()) > 1 and not isinstance(
        plan.patterns.get(plan.pattern_names[plan.pattern[rows[0]]]), HalfPlane
    ):
        label += f" over {plan.pattern_names[plan.pattern[rows[0]]]}"
    return label


def track_axis_label(found: Sequence[Track]) -> str:
    """Return the horizontal axis's label: distance from the edge if all tracks cross one, else place along the scan."""
    if all(t.from_edge for t in found):
        return "distance from the edge, white side positive (mm)"
    return "place along the scan (mm)"


def readings_by_orientation(recording: Recording, *, ax: Axes | None = None) -> Axes:
    """Draw readings against distance from the edge, a symbol for each orientation (paper, figure of the data).

    Parameters
    ----------
    recording
        Rows over half-planes are drawn by signed distance from the edge, others by position along the scan. Single rows
        (the quadrants) are drawn by `predicted_and_recorded_by_scan` only.
    ax
        Axes to draw on; a new figure without.
    """
    require_recording(recording)
    ax = axes_or_new(ax)
    found, _ = tracks_and_single_rows(recording.plan)
    for k, track in enumerate(found):
        ok = recording.usable[track.rows]
        ax.plot(
            track.along_mm[ok],
            recording.readings[track.rows][ok],
            linestyle="none",
            marker=MARKERS[k % len(MARKERS)],
            markersize=4 if len(found) <= MAX_NAMED else 2,
            markerfacecolor="none",
            markeredgewidth=1.0,
            color=CYCLE[k % len(CYCLE)],
            label=track.label,
        )
    if 0 < len(found) <= MAX_NAMED:
        legend_above(ax, title="orientation of the sensor")
    return label_axes(ax, x=track_axis_label(found), y=f"reading ({recording.plan.instrumentation.unit_after_number})")
