"""An arm's reach, and the sensor's orientation at each place."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, MaxNLocator, MultipleLocator

from probewise._arrays import FloatArray
from probewise.report.plots.canvas import BLACK, SMALL_PT, axes_or_new, label_axes
from probewise.report.plots.scene import add_colour_bar, paint_out_of_reach
from probewise.report.words import number_text

_LINES_DEG = 15.0  # step between contours of equal orientation


def reach_map(
    orientation_rad: FloatArray,
    x_mm: FloatArray,
    y_mm: FloatArray,
    *,
    axis_mm: tuple[float, float],
    ax: Axes | None = None,
) -> Axes:
    """Draw an arm's reach over the field, coloured by the sensor's orientation.

    Parameters
    ----------
    orientation_rad
        Orientation at each place, shape (n_y, n_x), lower row first; NaN out of reach.
    x_mm, y_mm
        Places of the columns and rows, shapes (n_x,) and (n_y,).
    axis_mm
        Place of the arm's axis.
    ax
        Axes to draw on; a new figure without.
    """
    ax = axes_or_new(ax, size_in=(8.2, 5.0))
    dx, dy = (x_mm[1] - x_mm[0]) / 2, (y_mm[1] - y_mm[0]) / 2
    degrees = _unwrapped_about_mean_deg(np.degrees(orientation_rad))
    image = ax.imshow(
        np.ma.masked_invalid(degrees),
        origin="lower",
        extent=(x_mm[0] - dx, x_mm[-1] + dx, y_mm[0] - dy, y_mm[-1] + dy),
        cmap="cividis",
        interpolation="nearest",
    )
    levels = _contour_levels_deg(degrees)
    if levels.size:
        style: dict[str, Any] = {"colors": "white", "linewidths": 0.8, "linestyles": "solid"}
        lines = ax.contour(x_mm, y_mm, np.ma.masked_invalid(degrees), levels, **style)
        for label in ax.clabel(lines, fmt=_angle_text, fontsize=SMALL_PT):
            label.set_path_effects([withStroke(linewidth=2.0, foreground=BLACK)])
    left, right, low, high = image.get_extent()
    paint_out_of_reach(ax)
    add_colour_bar(ax, image, "orientation of the sensor (degrees)")
    bar = ax.child_axes[-1].yaxis
    bar.set_major_locator(MultipleLocator(_LINES_DEG) if levels.size else MaxNLocator())
    bar.set_major_formatter(FuncFormatter(lambda angle, _: _angle_text(angle)))
    ax.add_patch(Rectangle((left, low), right - left, high - low, fill=False, edgecolor=BLACK, linewidth=0.8))
    ax.plot(*axis_mm, marker="o", markersize=9, color=BLACK)
    ax.annotate("arm's axis", axis_mm, textcoords="offset points", xytext=(8, 0), va="center", fontsize=SMALL_PT)
    ax.set_xlim(min(left, axis_mm[0] - 20.0), max(right, axis_mm[0] + 20.0))
    ax.set_ylim(min(low, axis_mm[1] - 20.0), max(high, axis_mm[1] + 20.0))
    ax.set_aspect("equal")
    share = 100 * float(np.isfinite(degrees).mean())
    title = f"{share:.0f} % of the field (framed) within reach; grey is out of reach"
    return label_axes(ax, x="x (mm)", y="y (mm)", title=title)


def _unwrapped_about_mean_deg(degrees: FloatArray) -> FloatArray:
    """Shift angles (degrees) by full turns to within 180 of their mean, so that 179 and -179 have similar colours."""
    known = np.radians(degrees[np.isfinite(degrees)])
    middle = float(np.degrees(np.angle(np.exp(1j * known).sum()))) if known.size else 0.0
    return np.asarray(middle + np.mod(degrees - middle + 180.0, 360.0) - 180.0)


def _contour_levels_deg(degrees: FloatArray) -> FloatArray:
    """Return the multiples of 15 degrees within the range of the angles, (n_lines,); none if no angle is finite."""
    known = degrees[np.isfinite(degrees)]
    if not known.size:
        return known
    return np.arange(np.ceil(known.min() / _LINES_DEG) * _LINES_DEG, known.max(), _LINES_DEG)


def _angle_text(degrees: float) -> str:
    """Write an angle in degrees, taken to -180 to 180, without decimals and with a true minus sign."""
    return number_text((degrees + 180.0) % 360.0 - 180.0, 0)
