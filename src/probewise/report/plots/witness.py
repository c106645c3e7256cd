"""The witness of a mismatch: residuals against the covariate in which it shows."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import FloatArray
from probewise.report.plots.canvas import BLACK, BLUE, GREY, VERMILLION, axes_or_new, tidy
from probewise.report.words import unit_name

__all__ = ["witness"]


def witness(
    at: FloatArray,
    mean: FloatArray,
    sd: FloatArray,
    *,
    label: str,
    unit: str,
    span: tuple[float, float] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the mean residual in bins of a covariate, with the band that noise alone would fill.

    Parameters
    ----------
    at, mean, sd
        Shape (n_bins,): place of the bin, mean of recorded minus predicted reading in it, sd of that mean.
    label, unit
        The covariate with its unit; the unit of a reading.
    span
        Where the mismatch was found, shaded.
    ax
        Axes to draw on; a new figure without.
    """
    ax = axes_or_new(ax, size_in=(7.2, 3.0))
    if span is not None:
        ax.axvspan(*span, color=GREY, alpha=0.2, lw=0, label="where it shows")
    ax.fill_between(at, -1.96 * sd, 1.96 * sd, color=BLUE, alpha=0.18, lw=0, label="95 % of noise alone")
    ax.plot(at, mean, color=VERMILLION, marker="o", markersize=3.5, linewidth=1.4, label="mean residual")
    ax.axhline(0, color=BLACK, linewidth=0.7)
    if np.size(at):
        ax.legend(frameon=False, fontsize="small")
    return tidy(ax, x=label, y=f"recorded − predicted ({unit_name(unit)})")
