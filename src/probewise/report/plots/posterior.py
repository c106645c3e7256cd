"""Posterior samples, each parameter and each pair."""

from __future__ import annotations

from collections.abc import Sequence

from probewise._arrays import FloatArray
from probewise.report.plots.canvas import BLUE, AxesGrid, grid_of_axes

__all__ = ["posterior_pairs"]


def posterior_pairs(names: Sequence[str], theta: FloatArray, weight: FloatArray, *, most: int = 6) -> AxesGrid:
    """Draw weighted samples: a histogram for each parameter, the density for each pair.

    Parameters
    ----------
    names
        Parameters, their units at the end of the name.
    theta, weight
        Samples, shape (n_samples, n_params), and their weights, (n_samples,).
    most
        No more than the first so many parameters are drawn.
    """
    n = min(len(names), most)
    axes = grid_of_axes(n, n, size_in=(1.5 * n + 1, 1.5 * n + 0.6))
    kept = weight > 1e-4 * weight.max()
    theta, weight = theta[kept], weight[kept]
    for row in range(n):
        for column in range(n):
            ax = axes[row, column]
            if column > row:
                ax.set_visible(False)
                continue
            if row == column:
                ax.hist(theta[:, row], bins=25, weights=weight, color=BLUE)
                ax.set_yticks([])
            else:
                ax.hist2d(theta[:, column], theta[:, row], bins=25, weights=weight, cmap="cividis")
            ax.tick_params(labelsize="x-small")
            ax.locator_params(nbins=3)
            if row == n - 1:
                ax.set_xlabel(names[column], fontsize="small")
            else:
                ax.set_xticklabels([])
            if column == 0 and row > 0:
                ax.set_ylabel(names[row], fontsize="small")
            elif column > 0:
                ax.set_yticklabels([])
    return axes
