"""The paper's figure of a search: the entropy map of the sampled circles, with the circles drawn on it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import BoolArray, FloatArray
from probewise._words import count_with_noun
from probewise.experiment import Exploration
from probewise.inquiry import Grid, UtilityMap, entropy_map
from probewise.report.plots.search import playing_field
from probewise.scene import outlines

_FINER = 2  # times as many places per side as the robot's grid, which is coarser than an edge is wide
_MARGIN_MM = 30.0
_OUTLINE = 0.45


def fine_entropy_map(run: Exploration, number: int) -> UtilityMap:
    """Compute the entropy map of the circles sampled after a reading, on a grid twice as fine (paper, figures 2 and 8).

    Parameters
    ----------
    run
        A run whose sensor model has no parameters to learn.
    number
        Number of the reading, from 1.
    """
    step, coarse = run.steps[number - 1], run.experiment.grid
    grid = Grid(coarse.width_mm, coarse.height_mm, _FINER * coarse.n_x - 1, _FINER * coarse.n_y - 1)
    within = _reachable_on_fine_grid(coarse, grid, step.map.reachable[: coarse.n_places])
    model, noise_sd = run.experiment.model, run.experiment.noise_sd
    return entropy_map(model, step.samples, grid, grid.plan("field"), reachable=within, noise_sd=noise_sd)


def paper_view(
    run: Exploration,
    number: int,
    *,
    levels: tuple[float, float],
    truth_mm: FloatArray,
    window_mm: tuple[float, float, float, float],
    title: str = "",
    ax: Axes | None = None,
) -> Axes:
    """Draw the robot's view after a reading as the paper does: a fine entropy map, with the sampled circles.

    Return the axes.

    Parameters
    ----------
    run, number
        See `fine_entropy_map`.
    levels
        Readings over black and white.
    truth_mm
        Outline of the true shape, (n_vertices, 2).
    window_mm
        Limits of the part shown: left, right, lower, upper.
    title
        Title; by default the number of readings.
    ax
        Axes to draw on; a new figure without.
    """
    step, drawn = run.steps[number - 1], fine_entropy_map(run, number)
    seen = np.array([(r.pose.x_mm, r.pose.y_mm, r.value) for r in run.readings[:number]])
    pose = step.next_pose
    ax = playing_field(
        drawn.image,
        drawn.grid.x_mm,
        drawn.grid.y_mm,
        outlines_mm=outlines(run.experiment.shape.region(step.samples)),
        places_mm=seen[:, :2],
        readings=seen[:, 2],
        levels=levels,
        next_mm=None if pose is None else (pose.x_mm, pose.y_mm),
        truth_mm=truth_mm,
        utility_label=drawn.label,
        title=title or f"after {count_with_noun(number, 'reading')}",
        lego_scale=True,
        ax=ax,
    )
    ax.collections[0].set_linewidth(_OUTLINE)
    left, right, low, high = window_mm
    ax.set(xlim=(left, right), ylim=(low, high))
    return ax


def window_around_runs_mm(runs: Sequence[Exploration], first: int) -> tuple[float, float, float, float]:
    """Return limits of a window that holds all readings and each run's circles sampled after reading `first`.

    Parameters
    ----------
    runs
        Over the same field.
    first
        Number of the first reading shown, from 1.

    Returns
    -------
    Left, right, lower and upper end in mm, with a margin of 30 mm inside the field.
    """
    grid = runs[0].experiment.grid
    drawn = [outline for run in runs for outline in outlines(run.experiment.shape.region(run.steps[first - 1].samples))]
    places = [[r.pose.x_mm, r.pose.y_mm] for run in runs for r in run.readings]
    points = np.concatenate([*drawn, np.array(places)])
    (left, low), (right, high) = points.min(axis=0) - _MARGIN_MM, points.max(axis=0) + _MARGIN_MM
    return max(left, 0.0), min(right, grid.width_mm), max(low, 0.0), min(high, grid.height_mm)


def _reachable_on_fine_grid(coarse: Grid, fine: Grid, reachable: BoolArray) -> BoolArray:
    """Return the mask of the fine grid's reachable places, (n_places,): each as the nearest place of the coarse one."""
    rows = np.rint(np.linspace(0, coarse.n_y - 1, fine.n_y)).astype(np.int64)
    columns = np.rint(np.linspace(0, coarse.n_x - 1, fine.n_x)).astype(np.int64)
    return np.asarray(reachable.reshape(coarse.n_y, coarse.n_x)[np.ix_(rows, columns)].ravel())
