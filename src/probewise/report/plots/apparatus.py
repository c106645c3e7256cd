"""The apparatus: the arm over its field, and its sensor seen from below (figure 1 of the paper)."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, FancyBboxPatch, Rectangle
from matplotlib.transforms import Affine2D

from probewise._arrays import FloatArray
from probewise.arm import Geometry
from probewise.errors import ReachError
from probewise.report.plots.canvas import (
    BLACK,
    GREY,
    ORANGE,
    SMALL_PT,
    VERMILLION,
    AxesGrid,
    axes_or_new,
    grid_of_axes,
    label_axes,
)

_ROD_MM = 26.0  # distance between the two rods of each parallelogram, as drawn
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
        Outline of the target on the field, (n_vertices, 2).

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
    _draw_arm_from_side(side, geometry, shoulder, lower)
    _draw_arm_from_above(above, geometry, place_mm, outline_mm)
    draw_sensor_face(face, size=1.0)
    face.set_axis_off()
    face.set(xlim=(-0.95, 0.95), ylim=(-0.95, 0.95), aspect="equal")
    face.set_title("sensor, from below", fontsize="medium", loc="left")
    face.annotate("photodiode", (0.0, 0.24), xytext=(0.0, 0.72), ha="center", fontsize=SMALL_PT, arrowprops=_ARROW)
    face.annotate("LED", (0.0, -0.24), xytext=(0.0, -0.8), ha="center", fontsize=SMALL_PT, arrowprops=_ARROW)
    return axes


def draw_arm_lengths(geometry: Geometry, away_mm: float | None = None, *, ax: Axes | None = None) -> Axes:
    """Draw the arm from the side with its lengths, motors and gear ratios, for building or measuring; return the axes.

    Parameters
    ----------
    geometry
        Lengths and joints of the arm.
    away_mm
        Distance from the base's axis at which the sensor reads; None: in the middle of its reach.
    ax
        Axes to draw on; a new figure without.

    Raises
    ------
    ReachError
        If the arm cannot read at that distance.
    """
    away = (geometry.nearest_mm + geometry.farthest_mm) / 2 if away_mm is None else away_mm
    middle = (geometry.base.low_rad + geometry.base.high_rad) / 2
    place = np.array([geometry.axis_mm]) + away * np.array([[np.cos(middle), np.sin(middle)]])
    _, shoulder, elbow = geometry.angles_rad(place, geometry.read_height_mm)[0].tolist()
    if not np.isfinite(shoulder):
        raise ReachError("away_mm", away, f"{geometry.nearest_mm:.0f} to {geometry.farthest_mm:.0f} mm")
    lower = shoulder + elbow if geometry.elbow_is_relative else elbow
    ax = axes_or_new(ax, size_in=(8.2, 5.4))
    (forward, height), (upper_mm, lower_mm), (out_mm, drop_mm) = (
        geometry.shoulder_mm,
        geometry.links_mm,
        geometry.sensor_mm,
    )
    joint = np.array([forward, height])
    knee = joint + upper_mm * np.array([np.cos(shoulder), np.sin(shoulder)])
    wrist = knee + lower_mm * np.array([np.cos(lower), np.sin(lower)])
    _draw_arm_from_side(ax, geometry, shoulder, lower, named=False)
    across = 40.0 * np.array([-np.sin(shoulder), np.cos(shoulder)])
    _draw_dimension(ax, joint, knee, across, f"upper_mm {upper_mm:g}")
    _draw_dimension(ax, knee, wrist, 40.0 * np.array([-np.sin(lower), np.cos(lower)]), f"lower_mm {lower_mm:g}")
    low = np.array([0.0, -45.0])
    _draw_dimension(
        ax, np.array([0.0, 0.0]), np.array([forward, 0.0]), low, f"shoulder_forward_mm {forward:g}", side="left"
    )
    up = np.array([-70.0, 0.0])
    _draw_dimension(
        ax, np.array([0.0, 0.0]), np.array([0.0, height]), up, f"shoulder_height_mm\n{height:g}", side="left"
    )
    eye = wrist + np.array([out_mm, -drop_mm])
    _draw_dimension(ax, np.array([wrist[0], 0.0]), np.array([eye[0], 0.0]), low, f"forward_mm {out_mm:g}", side="right")
    _draw_dimension(ax, eye, np.array([eye[0], wrist[1]]), np.array([35.0, 0.0]), f"drop_mm {drop_mm:g}", side="right")
    said = f"read_height_mm {geometry.read_height_mm:g}"
    _draw_dimension(ax, np.array([eye[0], 0.0]), eye, np.array([75.0, 0.0]), said, side="right")
    x, y = joint.tolist()
    named = (
        ("base", geometry.base, (0.0, height + 110.0), (-12, 16), "right"),
        ("shoulder", geometry.shoulder, (x, y), (40, -22), "left"),
        ("elbow", geometry.elbow, (float(knee[0]), float(knee[1])), (30, 26), "left"),
    )
    for name, mechanics, at, off, ha in named:
        told = f"{name}: motor {'ABC'[mechanics.port]}, {abs(mechanics.gear_ratio):g} : 1"
        ax.annotate(told, at, xytext=off, ha=ha, **_LABEL)
    ax.set(xlim=(-260, away + 290), ylim=(-110, float(knee[1]) + 110), title="")
    return ax


def _draw_dimension(
    ax: Axes, begin: FloatArray, end: FloatArray, away: FloatArray, text: str, *, side: str = "above"
) -> None:
    """Draw a dimension line, with arrows and text, parallel to the part from `begin` to `end` and offset by `away`."""
    a, b = begin + away, end + away
    for here, there in ((begin, a), (end, b)):
        ax.plot([here[0], there[0]], [here[1], there[1]], color=GREY, linewidth=0.6, zorder=1)
    arrow = {
        "arrowstyle": "<|-|>",
        "color": BLACK,
        "linewidth": 0.8,
        "shrinkA": 0.0,
        "shrinkB": 0.0,
        "mutation_scale": 7,
    }
    ax.annotate("", tuple(b), xytext=tuple(a), arrowprops=arrow)
    middle = (a + b) / 2
    if side == "above":
        turn = float(np.degrees(np.arctan2(*(b - a)[::-1])))
        turn = turn - 180 if turn > 90 else turn
        off = 12.0 * away / np.hypot(*away)
        x, y = (middle + off).tolist()
        ax.text(x, y, text, rotation=turn, ha="center", va="center", fontsize=SMALL_PT)
    elif side == "left":
        ax.text(min(a[0], b[0]) - 6, middle[1], text, ha="right", va="center", fontsize=SMALL_PT)
    else:
        ax.text(max(a[0], b[0]) + 6, middle[1] + 2, text, ha="left", va="center", fontsize=SMALL_PT)


def draw_sensor_face(
    ax: Axes, *, center: tuple[float, float] = (0.0, 0.0), size: float, turned_rad: float = 0.0, zorder: float = 3.0
) -> None:
    """Draw the sensor seen from below: package, photodiode (white), LED (red) and the ridge between them.

    Parameters
    ----------
    ax
        Axes to draw on.
    center, size
        Middle and width of the package, in the axes' units.
    turned_rad
        Orientation, anticlockwise in the drawing; at 0 the photodiode is at the top.
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


def _draw_arm_from_side(ax: Axes, geometry: Geometry, shoulder: float, lower: float, *, named: bool = True) -> None:
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
    if not named:
        label_axes(ax, x="distance from the arm's axis (mm)", y="height (mm)")
        ax.set_aspect("equal")
        return
    ax.annotate("base turns about this axis", (0, knee[1] + 40), xytext=(10, 12), **_LABEL)
    ax.annotate("shoulder", (float(joint[0]), float(joint[1])), xytext=(30, -22), **_LABEL)
    ax.annotate("elbow", (float(knee[0]), float(knee[1]) + _ROD_MM), xytext=(30, -2), **_LABEL)
    said = f"sensor, {geometry.read_height_mm:g} mm above\nthe surface when it reads"
    ax.annotate(said, (float(eye[0]), float(eye[1])), xytext=(-90, -36), **_LABEL)
    far = float(eye[0])
    ax.set(xlim=(-120, far + 130), ylim=(-140, float(knee[1]) + 110), aspect="equal")
    ax.set_yticks([tick for tick in ax.get_yticks() if 0 <= tick <= knee[1] + 60])
    label_axes(ax, x="distance from the arm's axis (mm)", y="height (mm)", title="from the side")


def _draw_arm_from_above(
    ax: Axes, geometry: Geometry, place_mm: tuple[float, float], outline_mm: FloatArray | None
) -> None:
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
    label_axes(ax, x="x (mm)", y="y (mm)", title="from above, with the field")
