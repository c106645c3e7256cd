"""The spatial sensitivity function (SSF) seen from above, also for each number of Gaussians with its evidence."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes

from probewise._arrays import FloatArray
from probewise._kinds import require_kind
from probewise.report.plots.canvas import AxesGrid, axes_or_grid, axes_or_new, label_axes
from probewise.report.plots.scene import add_colour_bar
from probewise.report.words import value_with_error
from probewise.sensor import SSFField


def spatial_sensitivity(field: SSFField, *, ax: Axes | None = None, title: str = "") -> Axes:
    """Draw an SSF in the sensor frame, with contours at 1/2 and 1/10 of its peak.

    The cross marks the centre of the sensor package.

    Parameters
    ----------
    field
        The SSF.
    ax
        Axes to draw on; a new figure without.
    title
        Its title.
    """
    require_kind("field", field, SSFField, "an SSFField: the .field of a FittedSensor")
    ax = axes_or_new(ax, size_in=(4.8, 4.0))
    values = np.asarray(field.values)
    x, y = field.u_mm, field.v_mm
    half = field.pixel_mm / 2
    ax.set_facecolor(colormaps["cividis"](0.0))  # beyond the field's pixels the SSF is zero
    peak = float(values.max())
    image = ax.imshow(
        values / peak,
        origin="lower",
        extent=(x[0] - half, x[-1] + half, y[0] - half, y[-1] + half),
        cmap="cividis",
        vmin=0.0,
        vmax=1.0,
        interpolation="nearest",
    )
    add_colour_bar(ax, image, "sensitivity (share of its peak)")
    ax.contour(x, y, values, levels=[0.1 * peak, 0.5 * peak], colors="white", linewidths=[0.8, 1.4])
    ax.plot([0], [0], marker="+", color="white", markersize=10, markeredgewidth=1.5)
    reach = _visible_half_width(values, x, y, field.pixel_mm)
    ax.set_xlim(-reach, reach)
    ax.set_ylim(-reach, reach)
    ax.set_aspect("equal")
    ax.spines[["top", "right"]].set_visible(True)
    return label_axes(ax, x="x' (mm)", y="y' (mm)", title=title)


def _visible_half_width(values: FloatArray, x: FloatArray, y: FloatArray, pixel_mm: float) -> float:
    """Return the half width (mm) of a square about the origin that holds the SSF above 1 % of its peak.

    It has a tenth to spare, and is rounded up to a multiple of half the power of ten below it.
    """
    matters = values > 0.01 * values.max()
    far = 1.1 * max(np.abs(x[matters.any(axis=0)]).max(), np.abs(y[matters.any(axis=1)]).max(), pixel_mm)
    unit = 0.5 * 10 ** np.floor(np.log10(far))
    return float(unit * np.ceil(far / unit))


def ssf_by_n_gaussians(
    fields: Mapping[int, SSFField],
    log_z: Mapping[int, float],
    log_z_error: Mapping[int, float],
    *,
    axes: AxesGrid | None = None,
) -> AxesGrid:
    """Draw the mean SSF of each number of Gaussians with its log-evidence (paper, figure of the four MoG models).

    Parameters
    ----------
    fields, log_z, log_z_error
        By number of Gaussians: mean field, natural log of the evidence and its standard error.
    axes
        Axes to draw on, of the shape returned; a new figure without.

    Returns
    -------
    Axes, (n_rows, 2), or (1, 1) for a single number of Gaussians.
    """
    orders = sorted(fields)
    n_columns = min(len(orders), 2)
    n_rows = -(-len(orders) // n_columns)
    axes = axes_or_grid(axes, n_rows, n_columns, size_in=(4.6 * n_columns, 3.9 * n_rows))
    best = max(orders, key=lambda n: log_z[n])
    for ax, n in zip(axes.flat, orders, strict=False):
        name = "1 Gaussian" if n == 1 else f"{n} Gaussians"
        mark = ", most probable" if n == best and len(orders) > 1 else ""
        spatial_sensitivity(
            fields[n], ax=ax, title=f"{name}{mark}\nln Z = {value_with_error(log_z[n], log_z_error[n])}"
        )
    for ax in list(axes.flat)[len(orders) :]:
        ax.set_visible(False)
    widest = max(ax.get_xlim()[1] for ax in list(axes.flat)[: len(orders)])
    for ax in list(axes.flat)[: len(orders)]:
        ax.set_xlim(-widest, widest)
        ax.set_ylim(-widest, widest)
    return axes
