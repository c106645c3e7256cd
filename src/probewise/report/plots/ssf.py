"""The spatial sensitivity function (SSF) seen from above, also for each number of Gaussians with its evidence."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes

from probewise._kinds import require_kind
from probewise._words import count_with_noun
from probewise.report.plots import canvas
from probewise.report.words import value_with_error
from probewise.sensor import SSFField


def spatial_sensitivity(field: SSFField, *, ax: Axes | None = None, title: str = "") -> Axes:
    """Draw an SSF in the sensor frame, with contours at 1/2 and 1/10 of its peak; a cross at the package's centre."""
    require_kind("field", field, SSFField, "an SSFField: the .field of a FittedSensor")
    ax = canvas.axes_or_new(ax, size_in=(4.8, 4.0))
    values, x, y = np.asarray(field.values), field.u_mm, field.v_mm
    peak = float(values.max())
    ax.set_facecolor(colormaps["cividis"](0.0))  # beyond the field's pixels the SSF is zero
    image = canvas.draw_map(ax, values / peak, x, y, cmap="cividis", vmin=0.0, vmax=1.0)
    canvas.add_colour_bar(ax, image, "sensitivity (share of its peak)")
    ax.contour(x, y, values, levels=[0.1 * peak, 0.5 * peak], colors="white", linewidths=[0.8, 1.4])
    ax.plot([0], [0], marker="+", color="white", markersize=10, markeredgewidth=1.5)
    # A square about the origin that holds the SSF above 1 % of its peak, its half width rounded up.
    matters = values > 0.01 * values.max()
    far = 1.1 * max(np.abs(x[matters.any(axis=0)]).max(), np.abs(y[matters.any(axis=1)]).max(), field.pixel_mm)
    unit = 0.5 * 10 ** np.floor(np.log10(far))
    _set_half_width(ax, float(unit * np.ceil(far / unit)))
    ax.set_aspect("equal")
    return canvas.label_axes(ax, x="x' (mm)", y="y' (mm)", title=title)


def _set_half_width(ax: Axes, reach_mm: float) -> None:
    ax.set(xlim=(-reach_mm, reach_mm), ylim=(-reach_mm, reach_mm))


def ssf_by_n_gaussians(
    fields: Mapping[int, SSFField], log_z: Mapping[int, float], log_z_error: Mapping[int, float]
) -> canvas.AxesGrid:
    """Draw the mean SSF of each number of Gaussians with its log evidence and standard error (paper, figure 6).

    Return the axes, (n_rows, 2), or (1, 1) for a single number of Gaussians.
    """
    orders = sorted(fields)
    n_columns = min(len(orders), 2)
    n_rows = -(-len(orders) // n_columns)
    axes = canvas.grid_of_axes(n_rows, n_columns, size_in=(4.6 * n_columns, 3.9 * n_rows))
    best = max(orders, key=lambda n: log_z[n])
    drawn = list(axes.flat)[: len(orders)]
    for ax, n in zip(drawn, orders, strict=True):
        name = count_with_noun(n, "Gaussian") + (", most probable" if n == best and len(orders) > 1 else "")
        spatial_sensitivity(fields[n], ax=ax, title=f"{name}\nln Z = {value_with_error(log_z[n], log_z_error[n])}")
    for ax in list(axes.flat)[len(orders) :]:
        ax.set_visible(False)
    widest = max(ax.get_xlim()[1] for ax in drawn)
    for ax in drawn:
        _set_half_width(ax, widest)
    return axes
