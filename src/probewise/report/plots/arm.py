"""Where an arm can put its sensor, and how the sensor then stands."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import FloatArray
from probewise.report.plots.canvas import BLACK, axes_or_new, tidy

__all__ = ["reach_map"]


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
        Where the arm stands.
    ax
        Axes to draw on; a new figure without.
    """
    ax = axes_or_new(ax, size_in=(8.2, 5.0))
    dx, dy = (x_mm[1] - x_mm[0]) / 2, (y_mm[1] - y_mm[0]) / 2
    degrees = np.degrees(orientation_rad)
    image = ax.imshow(
        np.ma.masked_invalid(degrees),
        origin="lower",
        extent=(x_mm[0] - dx, x_mm[-1] + dx, y_mm[0] - dy, y_mm[-1] + dy),
        cmap="twilight",
        vmin=-180.0,
        vmax=180.0,
        interpolation="nearest",
    )
    ax.set_facecolor("#d9d9d9")  # out of reach
    ax.figure.colorbar(image, ax=ax, label="orientation of the sensor (degrees)", shrink=0.8, pad=0.015)
    ax.plot(*axis_mm, marker="o", markersize=9, color=BLACK)
    ax.annotate("arm", axis_mm, textcoords="offset points", xytext=(8, 0), va="center")
    ax.set_aspect("equal")
    return tidy(ax, x="x (mm)", y="y (mm)", title=f"within reach: {np.isfinite(degrees).mean():.0%} of the field")
