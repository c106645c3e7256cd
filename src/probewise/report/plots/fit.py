"""Recorded readings against a simulator's predictions."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import FloatArray
from probewise.report.plots.canvas import BLACK, BLUE, label_axes, legend_above, stack_of_axes


def recorded_against_predicted(
    readings: FloatArray, predicted: FloatArray, sd: FloatArray, *, label: str, unit: str, ax: Axes | None = None
) -> Axes:
    """Draw each reading against its prediction, with an error bar of one sd of a new reading.

    Parameters
    ----------
    readings, predicted, sd
        Shape (n_points,); missing readings are NaN.
    label, unit
        Of the readings.
    ax
        Axes to draw on; a new figure without.
    """
    ax = ax if ax is not None else stack_of_axes([4.2])[0]
    there = np.isfinite(readings)
    ax.errorbar(
        predicted[there],
        readings[there],
        yerr=sd[there],
        fmt="o",
        ms=3,
        lw=0.8,
        color=BLUE,
        alpha=0.6,
        label="readings, ± 1 sd",
    )
    ends = [min(predicted[there].min(), readings[there].min()), max(predicted[there].max(), readings[there].max())]
    ax.plot(ends, ends, color=BLACK, lw=0.9, label="as predicted")
    label_axes(ax, x=f"predicted {label} ({unit})", y=f"recorded {label} ({unit})")
    legend_above(ax)
    return ax
