"""The apparatus: the arm over its field, its lengths and reach, and its sensor from below (figure 1 of the paper)."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, FancyBboxPatch, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, MaxNLocator, MultipleLocator
from matplotlib.transforms import Affine2D

from probewise._arrays import FloatArray
from probewise.arm import Geometry
from probewise.errors import ReachError
from probewise.report.plots import canvas
from probewise.report.words import number_text

_ROD_MM = 26.0  # distance between the two rods of each parallelogram, as drawn
_LINES_DEG = 15.0  # step between contours of equal orientation
_ARROW: dict[str, Any] = {"arrowstyle": "-|>", "color": canvas.BLACK}
_LABEL: dict[str, Any] = {"fontsize": canvas.SMALL_PT, "textcoords": "offset points", "arrowprops": _ARROW}


def arm_and_sensor(
    geometry: Geometry, place_mm: tuple[float, float], *, outline_mm: FloatArray | None = None
) -> canvas.AxesGrid:
    """Draw the arm as it reads at a place, from the side and from above, and its sensor from below (paper, figure 1).

    `outline_mm`, (n_vertices, 2), is the target's. Return the axes, (1, 3). ReachError if `place_mm` is out of reach.
    """
    base, shoulder, elbow = geometry.angles_rad(np.array([place_mm]), geometry.read_height_mm)[0].tolist()
    if not np.isfinite(base):
        raise ReachError("place_mm", place_mm, geometry.sentence())
    axes = canvas.grid_of_axes(1, 3, size_in=(9.6, 3.3), width_ratios=[1.75, 1.6, 0.75])
    side, above, face = axes[0]
    _draw_arm_from_side(side, geometry, shoulder, elbow)
    _draw_arm_from_above(above, geometry, place_mm, outline_mm)
    draw_sensor_face(face, size=1.0)
    face.set_axis_off()
    face.set(xlim=(-0.95, 0.95), ylim=(-0.95, 0.95), aspect="equal")
    face.set_title("sensor, from below", **canvas.TITLE)
    face.annotate(
        "photodiode", (0.0, 0.24), xytext=(0.0, 0.72), ha="center", fontsize=canvas.SMALL_PT, arrowprops=_ARROW
    )
    face.annotate("LED", (0.0, -0.24), xytext=(0.0, -0.8), ha="center", fontsize=canvas.SMALL_PT, arrowprops=_ARROW)
    return axes


def draw_arm_lengths(geometry: Geometry) -> Axes:
    """Draw the arm, in the middle of its reach, from the side with its lengths, motors and gear ratios."""
    away = sum(geometry.radii_in_reach_mm()) / 2
    middle = (geometry.base.low_rad + geometry.base.high_rad) / 2
    place = np.array([geometry.axis_mm]) + away * np.array([[np.cos(middle), np.sin(middle)]])
    _, shoulder, elbow = geometry.angles_rad(place, geometry.read_height_mm)[0].tolist()
    ax = canvas.axes_or_new(None, size_in=(8.2, 5.4))
    _draw_arm_from_side(ax, geometry, shoulder, elbow, named=False)
    _draw_lengths(ax, geometry, shoulder, elbow)
    joint, knee, *_ = geometry.joints_from_side_mm(shoulder, elbow)
    motors = (
        ("base", geometry.base, np.array([0.0, joint[1] + 110.0]), (-12, 16), "right"),
        ("shoulder", geometry.shoulder, joint, (40, -22), "left"),
        ("elbow", geometry.elbow, knee, (30, 26), "left"),
    )
    for name, mechanics, at, off, ha in motors:
        text = f"{name}: motor {'ABC'[mechanics.port]}, {abs(mechanics.gear_ratio):g} : 1"
        ax.annotate(text, tuple(at.tolist()), xytext=off, ha=ha, **_LABEL)
    ax.set(xlim=(-260, away + 290), ylim=(-110, float(knee[1]) + 110), title="")
    return ax


def _draw_lengths(ax: Axes, geometry: Geometry, shoulder: float, elbow: float) -> None:
    """Draw a dimension line for each length of the arm, named as in a geometry file."""
    joint, knee, wrist, eye = geometry.joints_from_side_mm(shoulder, elbow)
    (forward, height), (upper_mm, lower_mm), (out_mm, drop_mm) = (
        geometry.shoulder_mm,
        geometry.links_mm,
        geometry.sensor_mm,
    )
    lower = shoulder + elbow if geometry.elbow_is_relative else elbow
    of_upper, of_lower = (40.0 * np.array([-np.sin(turn), np.cos(turn)]) for turn in (shoulder, lower))
    origin, below_eye, low = np.zeros(2), np.array([eye[0], 0.0]), np.array([0.0, -45.0])
    for begin, end, away, text, side in (
        (joint, knee, of_upper, f"upper_mm {upper_mm:g}", "above"),
        (knee, wrist, of_lower, f"lower_mm {lower_mm:g}", "above"),
        (origin, np.array([forward, 0.0]), low, f"shoulder_forward_mm {forward:g}", "left"),
        (origin, np.array([0.0, height]), np.array([-70.0, 0.0]), f"shoulder_height_mm\n{height:g}", "left"),
        (np.array([wrist[0], 0.0]), below_eye, low, f"forward_mm {out_mm:g}", "right"),
        (eye, np.array([eye[0], wrist[1]]), np.array([35.0, 0.0]), f"drop_mm {drop_mm:g}", "right"),
        (below_eye, eye, np.array([75.0, 0.0]), f"read_height_mm {geometry.read_height_mm:g}", "right"),
    ):
        _draw_dimension(ax, begin, end, away, text, side)


def _draw_dimension(ax: Axes, begin: FloatArray, end: FloatArray, away: FloatArray, text: str, side: str) -> None:
    """Draw a dimension line, with arrows and text, parallel to the part from `begin` to `end` and offset by `away`."""
    a, b = begin + away, end + away
    for here, there in ((begin, a), (end, b)):
        ax.plot(*np.array([here, there]).T, color=canvas.GREY, linewidth=0.6, zorder=1)
    arrow: dict[str, Any] = {"arrowstyle": "<|-|>", "linewidth": 0.8, "shrinkA": 0.0, "shrinkB": 0.0}
    ax.annotate("", tuple(b), xytext=tuple(a), arrowprops={**arrow, "color": canvas.BLACK, "mutation_scale": 7})
    (x, y), turn, ha = (a + b) / 2, 0.0, "center"
    if side == "above":
        turn = float(np.degrees(np.arctan2(*(b - a)[::-1])))
        turn = turn - 180 if turn > 90 else turn
        x, y = (a + b) / 2 + 12.0 * away / np.hypot(*away)
    elif side == "left":
        x, ha = min(a[0], b[0]) - 6, "right"
    else:
        x, y, ha = max(a[0], b[0]) + 6, y + 2, "left"
    ax.text(float(x), float(y), text, rotation=turn, ha=ha, va="center", fontsize=canvas.SMALL_PT)


def draw_sensor_face(
    ax: Axes, *, center: tuple[float, float] = (0.0, 0.0), size: float, turned_rad: float = 0.0, zorder: float = 3.0
) -> None:
    """Draw the sensor seen from below: package, photodiode (white), LED (red) and the ridge between them.

    `size` is the width of the package in the axes' units, `turned_rad` its anticlockwise turn from the photodiode on
    top.
    """
    turn = Affine2D().scale(size).rotate(turned_rad).translate(*center) + ax.transData
    parts = (
        FancyBboxPatch(
            (-0.42, -0.42), 0.84, 0.84, boxstyle="round,pad=0,rounding_size=0.12", fc="#9a9a9a", ec=canvas.BLACK
        ),
        Rectangle((-0.36, -0.035), 0.72, 0.07, fc="#4d4d4d", ec="none"),
        Circle((0.0, 0.21), 0.13, fc="white", ec=canvas.BLACK),
        Circle((0.0, -0.21), 0.13, fc="#d62728", ec=canvas.BLACK),
    )
    for k, part in enumerate(parts):
        part.set(transform=turn, linewidth=0.8, zorder=zorder + 0.1 * k)
        ax.add_patch(part)


def _draw_arm_from_side(ax: Axes, geometry: Geometry, shoulder: float, elbow: float, *, named: bool = True) -> None:
    joint, knee, wrist, eye = geometry.joints_from_side_mm(shoulder, elbow)
    ax.axhline(0.0, color=canvas.BLACK, linewidth=1.2)
    ax.add_patch(Rectangle((-45, 0), 90, joint[1] - 12, fc="#e3e3e3", ec=canvas.GREY, zorder=1))
    ax.plot([0, 0], [-25, knee[1] + 70], color=canvas.BLACK, linewidth=1.0, linestyle=(0, (6, 3)), zorder=2)
    rods = np.array([[0.0, 0.0], [0.0, _ROD_MM]])
    for away in rods:
        for ends in ([joint + away, knee + away], [knee + away, wrist + away]):
            ax.plot(*np.array(ends).T, color=canvas.ORANGE, linewidth=3.0, solid_capstyle="round", zorder=3)
    for end in (joint, knee, wrist):
        ax.plot(*np.array([end, end + rods[1]]).T, color=canvas.BLACK, linewidth=2.2, zorder=4)
        ax.plot(*end, marker="o", markersize=6, color="white", markeredgecolor=canvas.BLACK, zorder=5)
    ax.plot([wrist[0], eye[0]], [wrist[1], wrist[1]], color=canvas.BLACK, linewidth=2.2, zorder=4)
    ax.add_patch(
        Rectangle((eye[0] - 8, eye[1]), 16, geometry.sensor_mm[1] + 6, fc="#9a9a9a", ec=canvas.BLACK, zorder=4)
    )
    canvas.label_axes(
        ax, x="distance from the arm's axis (mm)", y="height (mm)", title="from the side" if named else ""
    )
    ax.set_aspect("equal")
    if not named:
        return
    ax.annotate("base turns about this axis", (0, knee[1] + 40), xytext=(10, 12), **_LABEL)
    ax.annotate("shoulder", tuple(joint.tolist()), xytext=(30, -22), **_LABEL)
    ax.annotate("elbow", tuple((knee + rods[1]).tolist()), xytext=(30, -2), **_LABEL)
    height = f"sensor, {geometry.read_height_mm:g} mm above\nthe surface when it reads"
    ax.annotate(height, tuple(eye.tolist()), xytext=(-90, -36), **_LABEL)
    ax.set(xlim=(-120, float(eye[0]) + 130), ylim=(-140, float(knee[1]) + 110))
    ax.set_yticks([tick for tick in ax.get_yticks() if 0 <= tick <= knee[1] + 60])


def _draw_arm_from_above(
    ax: Axes, geometry: Geometry, place_mm: tuple[float, float], outline_mm: FloatArray | None
) -> None:
    width, height = geometry.field_mm
    ax.add_patch(Rectangle((0, 0), width, height, fc="#222222", ec=canvas.BLACK))
    if outline_mm is not None:
        ax.fill(*outline_mm.T, color="white")
    (x, y), (at_x, at_y) = geometry.axis_mm, place_mm
    ax.plot([x, at_x], [y, at_y], color=canvas.ORANGE, linewidth=4.0, solid_capstyle="round")
    ax.plot(x, y, marker="o", markersize=11, color="#e3e3e3", markeredgecolor=canvas.BLACK)
    ax.plot(
        at_x, at_y, marker="s", markersize=7, color="#9a9a9a", markeredgecolor=canvas.VERMILLION, markeredgewidth=1.4
    )
    ax.annotate("base", (x, y), xytext=(12, 0), textcoords="offset points", va="center", fontsize=canvas.SMALL_PT)
    ax.set(xlim=(-20, width + 20), ylim=(-20, max(height, y) + 50), aspect="equal")
    canvas.label_axes(ax, x="x (mm)", y="y (mm)", title="from above, with the field")


def reach_map(
    orientation_rad: FloatArray,
    x_mm: FloatArray,
    y_mm: FloatArray,
    *,
    axis_mm: tuple[float, float],
    ax: Axes | None = None,
) -> Axes:
    """Draw an arm's reach over the field, coloured by the sensor's orientation.

    `orientation_rad`, (n_y, n_x), lower row first, at the places `x_mm` and `y_mm`, is NaN out of reach; `axis_mm` is
    the place of the arm's axis.
    """
    ax = canvas.axes_or_new(ax, size_in=(8.2, 5.0))
    degrees = np.degrees(orientation_rad)
    known = degrees[np.isfinite(degrees)]
    # Within 180 of their mean, so that 179 and -179 have similar colours.
    middle = float(np.degrees(np.angle(np.exp(1j * np.radians(known)).sum()))) if known.size else 0.0
    degrees = middle + np.mod(degrees - middle + 180.0, 360.0) - 180.0
    image = canvas.draw_map(ax, degrees, x_mm, y_mm, cmap="cividis")
    levels = known = degrees[np.isfinite(degrees)]
    if known.size:  # multiples of 15 degrees within the range of the angles
        levels = np.arange(np.ceil(known.min() / _LINES_DEG) * _LINES_DEG, known.max(), _LINES_DEG)
    if levels.size:
        style: dict[str, Any] = {"colors": "white", "linewidths": 0.8, "linestyles": "solid"}
        lines = ax.contour(x_mm, y_mm, np.ma.masked_invalid(degrees), levels, **style)
        for label in ax.clabel(lines, fmt=_angle_text, fontsize=canvas.SMALL_PT):
            label.set_path_effects([withStroke(linewidth=2.0, foreground=canvas.BLACK)])
    left, right, low, high = image.get_extent()
    canvas.paint_out_of_reach(ax)
    bar = canvas.add_colour_bar(ax, image, "orientation of the sensor (degrees)").yaxis
    bar.set_major_locator(MultipleLocator(_LINES_DEG) if levels.size else MaxNLocator())
    bar.set_major_formatter(FuncFormatter(lambda angle, _: _angle_text(angle)))
    ax.add_patch(Rectangle((left, low), right - left, high - low, fill=False, edgecolor=canvas.BLACK, linewidth=0.8))
    ax.plot(*axis_mm, marker="o", markersize=9, color=canvas.BLACK)
    ax.annotate("arm's axis", axis_mm, textcoords="offset points", xytext=(8, 0), va="center", fontsize=canvas.SMALL_PT)
    (x, y), margin = axis_mm, 20.0
    ax.set(xlim=(min(left, x - margin), max(right, x + margin)), ylim=(min(low, y - margin), max(high, y + margin)))
    ax.set_aspect("equal")
    share = 100 * float(np.isfinite(degrees).mean())
    title = f"{share:.0f} % of the field (framed) within reach; grey is out of reach"
    return canvas.label_axes(ax, x="x (mm)", y="y (mm)", title=title)


def _angle_text(degrees: float) -> str:
    """Write an angle in degrees, taken to -180 to 180, without decimals and with a true minus sign."""
    return number_text((degrees + 180.0) % 360.0 - 180.0, 0)
