"""The apparatus: the arm from the side with its lengths, and its reach over the field."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, MultipleLocator

from probewise._arrays import FloatArray
from probewise.arm import Geometry
from probewise.arm.geometry import JOINTS
from probewise.report.plots import canvas
from probewise.report.words import number_text

_LINES_DEG = 15.0  # step between contours of equal orientation
_NEAR: dict[str, Any] = {"fontsize": canvas.SMALL_PT, "textcoords": "offset points", "va": "center"}


def draw_arm_lengths(geometry: Geometry) -> Axes:
    """Draw the arm, in the middle of its reach, from the side with its lengths, motors and gear ratios.

    The lengths are named as in a geometry file.
    """
    away = sum(geometry.radii_in_reach_mm()) / 2
    middle = (geometry.base.low_rad + geometry.base.high_rad) / 2
    place = np.array([geometry.axis_mm]) + away * np.array([[np.cos(middle), np.sin(middle)]])
    _, shoulder, elbow = geometry.angles_rad(place, geometry.read_height_mm)[0].tolist()
    joint, knee, wrist, eye = geometry.joints_from_side_mm(shoulder, elbow)
    home = np.array(geometry.joints_from_side_mm(geometry.shoulder.home_rad, geometry.elbow.home_rad))
    ax = canvas.axes_or_new(None, size_in=(8.2, 5.4))
    ax.axhline(0.0, **canvas.THIN)
    ax.axvline(0.0, color=canvas.BLACK, linestyle="--")
    ends = np.array([joint, knee, wrist, [eye[0], wrist[1]], eye])
    ax.plot(*ends.T, color=canvas.ORANGE, linewidth=4.0)
    ax.plot(*ends[:3].T, "o", color="white", markeredgecolor=canvas.BLACK)
    ax.plot(*eye, "s", color=canvas.BLACK)
    ax.plot(*home.T, color=canvas.OUT_OF_REACH, linewidth=4.0, zorder=1)
    (forward, height), (upper, lower), (out, drop) = geometry.shoulder_mm, geometry.links_mm, geometry.sensor_mm
    far = eye[0] + 40.0
    lengths: tuple[tuple[Any, Any, str, tuple[int, int]], ...] = (
        (joint, knee, f"upper_mm {upper:g}", (8, -10)),
        (knee, wrist, f"lower_mm {lower:g}", (8, 8)),
        ((-60.0, 0.0), (-60.0, height), f"shoulder_height_mm {height:g}", (-6, 0)),
        ((0.0, -45.0), (forward, -45.0), f"shoulder_forward_mm {forward:g}", (-12, -12)),
        ((wrist[0], -45.0), (eye[0], -45.0), f"forward_mm {out:g}", (12, -12)),
        ((far, eye[1]), (far, wrist[1]), f"drop_mm {drop:g}", (6, 0)),
        ((far, 0.0), (far, eye[1]), f"read_height_mm {geometry.read_height_mm:g}", (6, -17)),
    )
    for begin, end, text, beside in lengths:
        ax.annotate("", begin, xytext=end, arrowprops={"arrowstyle": "<->", "shrinkA": 0, "shrinkB": 0})
        x, y = np.add(begin, end) / 2
        ax.annotate(text, (x, y), xytext=beside, ha="right" if beside[0] < 0 else "left", **_NEAR)
    joints = dict(zip(JOINTS, geometry.joints, strict=True))
    for name, (x, y), beside in (
        ("base", (0.0, joint[1] + 110.0), (-8, 0)),
        ("shoulder", joint, (14, -8)),
        ("elbow", knee, (14, 12)),
        ("sensor", eye, (-8, 0)),
        ("at home", home[2], (8, 0)),
    ):
        gear = f": motor {'ABC'[joints[name].port]}, {abs(joints[name].gear_ratio):g} : 1" if name in joints else ""
        ax.annotate(name + gear, (x, y), xytext=beside, ha="right" if beside[0] < 0 else "left", **_NEAR)
    ax.set(xlim=(-320, away + 290), ylim=(-110, max(float(knee[1]), home[:, 1].max()) + 60), aspect="equal")
    return canvas.label_axes(ax, x="distance from the arm's axis (mm)", y="height (mm)")


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
    canvas.paint_out_of_reach(ax)
    bar = canvas.add_colour_bar(ax, image, "orientation of the sensor (degrees)").yaxis
    bar.set_major_locator(MultipleLocator(_LINES_DEG))
    # An angle is taken to -180 to 180.
    bar.set_major_formatter(FuncFormatter(lambda angle, _: number_text((angle + 180.0) % 360.0 - 180.0, 0)))
    left, right, low, high = image.get_extent()
    ax.add_patch(Rectangle((left, low), right - left, high - low, fill=False, edgecolor=canvas.BLACK))
    ax.plot(*axis_mm, "o", color=canvas.BLACK)
    ax.annotate("arm's axis", axis_mm, xytext=(8, 0), **_NEAR)
    (x, y), margin = axis_mm, 20.0
    ax.set(xlim=(min(left, x) - margin, max(right, x) + margin), ylim=(min(low, y) - margin, max(high, y) + margin))
    ax.set_aspect("equal")
    share = 100 * float(np.isfinite(degrees).mean())
    title = f"{share:.0f} % of the field (framed) within reach; grey is out of reach"
    return canvas.label_axes(ax, x="x (mm)", y="y (mm)", title=title)
