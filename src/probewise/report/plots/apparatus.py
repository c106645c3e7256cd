"""The apparatus: the arm over its field, and the face of its sensor (figure 1 of the paper)."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, FancyBboxPatch, Rectangle
from matplotlib.transforms import Affine2D

from probewise._arrays import FloatArray
from probewise.arm import Geometry
from probewise.errors import ReachError
from probewise.report.plots.canvas import BLACK, GREY, ORANGE, SMALL_PT, VERMILLION, AxesGrid, grid_of_axes, tidy

__all__ = ["arm_and_sensor", "draw_sensor_face"]

_ROD_MM = 26.0  # between the two rods of each parallelogram, as drawn
_ARROW: dict[str, Any] = {"arrowstyle": "-|>", "color": BLACK}
_LABEL: dict[str, Any] = {"fontsize": SMALL_PT, "textcoords": "offset points", "arrowprops": _ARROW}


def arm_and_sensor(
    geometry: Geometry, place_mm: tuple[float, float], *, outline_mm: FloatArray | None = None
) -> AxesGrid:
    """Draw the arm as it reads at a place, from the side and from above, and its sensor from below (paper, figure 1).

    Parameters
    ----------
    geometry
        Lengths and joints of the arm.
    place_mm
        Place of the sensor on the field.
    outline_mm
        Outline of what lies on the field, (n_vertices, 2).

    Returns
    -------
    Axes, (1, 3).

    Raises
    ------
    ReachError
        If the arm cannot read there.
    """
    place = np.array([place_mm], dtype=np.float64)
    base, shoulder, elbow = geometry.angles_rad(place, geometry.read_height_mm)[0].tolist()
    if not np.isfinite(base):
        raise ReachError("place_mm", place_mm, geometry.sentence())
    axes = grid_of_axes(1, 3, size_in=(9.6, 3.3), width_ratios=[1.75, 1.6, 0.75])
    side, above, face = axes[0]
    lower = shoulder + elbow if geometry.elbow_is_relative else elbow
    _draw_side(side, geometry, shoulder, lower)
    _draw_above(above, geometry, place_mm, outline_mm)
    draw_sensor_face(face, size=1.0)
    face.set_axis_off()
    face.set(xlim=(-0.95, 0.95), ylim=(-0.95, 0.95), aspect="equal")
    face.set_title("sensor, from below", fontsize="medium", loc="left")
    face.annotate("photodiode", (0.0, 0.24), xytext=(0.0, 0.72), ha="center", fontsize=SMALL_PT, arrowprops=_ARROW)
    face.annotate("LED", (0.0, -0.24), xytext=(0.0, -0.8), ha="center", fontsize=SMALL_PT, arrowprops=_ARROW)
    return axes


def draw_sensor_face(
    ax: Axes, *, center: tuple[float, float] = (0.0, 0.0), size: float, turned_rad: float = 0.0, zorder: float = 3.0
) -> None:
    """Draw a sensor's package, its photodiode (white), its LED (red) and the ridge between, turned anticlockwise.

    Parameters
    ----------
    ax
        Axes to draw on.
    center, size
        Middle and width of the package, in the axes' units.
    turned_rad
        Orientation; at 0 the photodiode is at the top.
    zorder
        Of the lowest part.
    """
    turn = Affine2D().scale(size).rotate(turned_rad).translate(*center) + ax.transData
    parts = (
        FancyBboxPatch((-0.42, -0.42), 0.84, 0.84, boxstyle="round,pad=0,rounding_size=0.12", fc="#9a9a9a", ec=BLACK),
        Rectangle((-0.36, -0.035), 0.72, 0.07, fc="#4d4d4d", ec="none"),
        Circle((0.0, 0.21), 0.13, fc="white", ec=BLACK),
        Circle((0.0, -0.21), 0.13, fc="#d62728", ec=BLACK),
    )
    for k, part in enumerate(parts):
        part.set(transform=turn, linewidth=0.8, zorder=zorder + 0.1 * k)
        ax.add_patch(part)


def _draw_side(ax: Axes, geometry: Geometry, shoulder: float, lower: float) -> None:
    forward, height = geometry.shoulder_mm
    joint = np.array([forward, height])
    knee = joint + geometry.links_mm[0] * np.array([np.cos(shoulder), np.sin(shoulder)])
    wrist = knee + geometry.links_mm[1] * np.array([np.cos(lower), np.sin(lower)])
    eye = wrist + np.array([geometry.sensor_mm[0], -geometry.sensor_mm[1]])
    ax.axhline(0.0, color=BLACK, linewidth=1.2)
    ax.add_patch(Rectangle((-45, 0), 90, height - 12, fc="#e3e3e3", ec=GREY, zorder=1))
    ax.plot([0, 0], [-25, knee[1] + 70], color=BLACK, linewidth=1.0, linestyle=(0, (6, 3)), zorder=2)
    rods = np.array([[0.0, 0.0], [0.0, _ROD_MM]])
    for away in rods:
        ax.plot(*np.array([joint + away, knee + away]).T, color=ORANGE, linewidth=3.0, solid_capstyle="round", zorder=3)
        ax.plot(*np.array([knee + away, wrist + away]).T, color=ORANGE, linewidth=3.0, solid_capstyle="round", zorder=3)
    for end in (joint, knee, wrist):
        ax.plot(*np.array([end, end + rods[1]]).T, color=BLACK, linewidth=2.2, zorder=4)
        ax.plot(*end, marker="o", markersize=6, color="white", markeredgecolor=BLACK, zorder=5)
    ax.plot([wrist[0], eye[0]], [wrist[1], wrist[1]], color=BLACK, linewidth=2.2, zorder=4)
    ax.add_patch(Rectangle((eye[0] - 8, eye[1]), 16, geometry.sensor_mm[1] + 6, fc="#9a9a9a", ec=BLACK, zorder=4))
    ax.annotate("base turns about this axis", (0, knee[1] + 40), xytext=(10, 12), **_LABEL)
    ax.annotate("shoulder", (float(joint[0]), float(joint[1])), xytext=(-30, 44), ha="right", **_LABEL)
    ax.annotate("elbow", (float(knee[0]), float(knee[1]) + _ROD_MM), xytext=(30, -2), **_LABEL)
    said = f"sensor, {geometry.read_height_mm:g} mm above\nthe surface when it reads"
    ax.annotate(said, (float(eye[0]), float(eye[1])), xytext=(-16, -40), **_LABEL)
    far = float(eye[0])
    ax.set(xlim=(-120, far + 130), ylim=(-110, float(knee[1]) + 110), aspect="equal")
    ax.set_yticks([tick for tick in ax.get_yticks() if 0 <= tick <= knee[1] + 60])
    tidy(ax, x="distance from the arm's axis (mm)", y="height (mm)", title="from the side")


def _draw_above(ax: Axes, geometry: Geometry, place_mm: tuple[float, float], outline_mm: FloatArray | None) -> None:
    width, height = geometry.field_mm
    ax.add_patch(Rectangle((0, 0), width, height, fc="#222222", ec=BLACK))
    if outline_mm is not None:
        ax.fill(outline_mm[:, 0], outline_mm[:, 1], color="white")
    (x, y), (at_x, at_y) = geometry.axis_mm, place_mm
    ax.plot([x, at_x], [y, at_y], color=ORANGE, linewidth=4.0, solid_capstyle="round")
    ax.plot(x, y, marker="o", markersize=11, color="#e3e3e3", markeredgecolor=BLACK)
    ax.plot(at_x, at_y, marker="s", markersize=7, color="#9a9a9a", markeredgecolor=VERMILLION, markeredgewidth=1.4)
    ax.annotate("base", (x, y), xytext=(12, 0), textcoords="offset points", va="center", fontsize=SMALL_PT)
    ax.set(xlim=(-20, width + 20), ylim=(-20, max(height, y) + 50), aspect="equal")
    tidy(ax, x="x (mm)", y="y (mm)", title="from above, with the field")
