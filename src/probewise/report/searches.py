"""Searches of two robots beside each other: in numbers, in the paper's picture, and what a doubting one believes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import FloatArray
from probewise._words import count_with_noun
from probewise.experiment import Exploration, left_out_after_step
from probewise.inquiry import Grid, UtilityMap, entropy_map
from probewise.report.exploration import draw_robot_view, errors_text
from probewise.report.html import Markup, table
from probewise.report.plots.canvas import PAGE_IN, AxesGrid, grid_of_axes
from probewise.report.plots.probabilities import effect_probabilities_by_reading
from probewise.report.plots.search import draw_field_legend, information_gained, posterior_widths
from probewise.report.words import number_text
from probewise.scene import outlines

HEADER = (
    "sensor model",
    "readings",
    "until the first white",
    "bits",
    "bits per reading",
    "the paper's count",
    "largest error",
    "errors",
)
_FINER = 2  # times as many places per side as the robot's grid, which is coarser than an edge is wide
_MARGIN_MM = 30.0
_OUTLINE = 0.45


@dataclass(frozen=True, eq=False)
class RobotSearch:
    """One robot's search: its sensor model's name, its run, the true shape, and the readings over black and white.

    `truth` holds the shape's parameters by name, `truth_mm` its outline, (n_vertices, 2); `levels` is (black, white).
    """

    model: str
    run: Exploration
    truth: Mapping[str, float]
    truth_mm: FloatArray
    levels: tuple[float, float]

    @property
    def largest_error_mm(self) -> float:
        """Largest absolute error, estimate against truth, of the parameters in mm (places, lengths) at the end."""
        last = self.run.last
        return max(
            abs(float(mean) - self.truth[name])
            for name, mean in zip(last.names, last.mean, strict=True)
            if name in self.truth and name.endswith("_mm")
        )

    @property
    def readings_until_first_white(self) -> int:
        """Number, from 1, of the first reading closer to white than to black; that of the last one if none is."""
        middle = sum(self.levels) / 2
        seen = [r.value > middle for r in self.run.readings]
        return seen.index(True) + 1 if any(seen) else len(seen)

    def step_number_after(self, n: int) -> int:
        """Return the number of the step after `n` readings, or of the last step if the run ended earlier."""
        return min(n, len(self.run.steps))

    def draw_view(self, number: int, *, title: str, ax: Axes, **options: Any) -> Axes:
        """Draw the robot's view after reading `number`, from 1, with the true shape; return the axes."""
        seen = [(r.pose.x_mm, r.pose.y_mm, r.value) for r in self.run.readings[:number]]
        options |= {"levels": self.levels, "truth_mm": self.truth_mm, "title": title, "ax": ax}
        return draw_robot_view(self.run.steps[number - 1], self.run.experiment, seen, **options)


def search_comparison_rows(searches: Sequence[RobotSearch]) -> list[tuple[str, ...]]:
    """Return the cells of the table of searches, in the order of `HEADER`, one row per search."""
    return [
        (
            s.model,
            str(len(s.run.steps)),
            str(s.readings_until_first_white),
            number_text(s.run.last.bits, 1),
            number_text(s.run.bits_per_reading, 2),
            number_text(s.run.paper_bits_per_reading, 2),
            f"{number_text(s.largest_error_mm, 1)} mm",
            errors_text(s.run, s.truth),
        )
        for s in searches
    ]


_CAPTION = (
    "Bits: prior minus posterior differential entropy of the circle's parameters. The paper counts 25 bits for "
    "the whole search, whatever the run. Errors: estimate minus truth, ± posterior sd (mm). One run each: the "
    "number of readings varies from circle to circle, most of all until the first white reading."
)


def search_comparison_table(searches: Sequence[RobotSearch], caption: str = _CAPTION) -> Markup:
    """Build the table that compares the robots' searches, a row each; the default caption explains bits and errors."""
    return table(HEADER, search_comparison_rows(searches), caption=caption)


def search_comparison_lines(searches: Sequence[RobotSearch]) -> list[str]:
    """Write the comparison of searches as lines of text: a table of each one's cost, then another of its errors."""
    rows = [HEADER, *search_comparison_rows(searches)]
    return [
        "A whole search, from an empty field (bits: information gained; the paper's count: 25 bits over the readings)",
        *_aligned_lines([row[:-2] for row in rows]),
        "",
        "Errors of the circle that was found: estimate minus truth, ± posterior sd",
        *_aligned_lines([(row[0], *row[-2:]) for row in rows]),
        "",
    ]


def _aligned_lines(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]


def draw_widths_and_information(searches: Sequence[RobotSearch]) -> AxesGrid:
    """Draw the widest posterior sd, and the information, after each reading of each search; return the axes, (1, 2)."""
    steps = {f"{s.model} model": s.run.steps for s in searches}
    axes = grid_of_axes(1, 2, size_in=(10.0, 3.6))
    posterior_widths({n: np.array([s.largest_sd_mm for s in each]) for n, each in steps.items()}, ax=axes[0, 0])
    information_gained({n: np.array([s.bits for s in each]) for n, each in steps.items()}, ax=axes[0, 1])
    axes[0, 1].set_ylim(top=1.3 * axes[0, 1].get_ylim()[1])  # room for the legend above the lines
    return axes


def draw_paper_views(searches: Sequence[RobotSearch], numbers: Sequence[int]) -> AxesGrid:
    """Draw the paper's view after each of `numbers` readings (rows) of each search (columns); return the axes."""
    window = window_around_runs_mm([s.run for s in searches], numbers[0])
    across, up = window[1] - window[0], window[3] - window[2]
    size = (5.0 * len(searches), (1.2 + 3.9 * up / across) * len(numbers))
    axes = grid_of_axes(len(numbers), len(searches), size_in=size)
    for row, n in zip(axes, numbers, strict=True):
        for ax, search in zip(row, searches, strict=True):
            paper_view(search, search.step_number_after(n), window_mm=window, ax=ax)
    return axes


def paper_view(search: RobotSearch, number: int, *, window_mm: tuple[float, float, float, float], ax: Axes) -> Axes:
    """Draw the robot's view after a reading as the paper does: a fine entropy map, with the sampled circles.

    `number` is that of the reading, from 1; `window_mm` are the limits shown: left, right, lower, upper.
    """
    known = f"sd up to {number_text(search.run.steps[number - 1].largest_sd_mm, 1)} mm"
    title = f"{search.model} model, {count_with_noun(number, 'reading')}: {known}"
    search.draw_view(number, title=title, ax=ax, drawn=fine_entropy_map(search.run, number), lego_scale=True)
    ax.collections[0].set_linewidth(_OUTLINE)
    left, right, low, high = window_mm
    ax.set(xlim=(left, right), ylim=(low, high))
    return ax


def fine_entropy_map(run: Exploration, number: int) -> UtilityMap:
    """Compute the entropy map of the circles sampled after a reading, on a grid twice as fine (paper, figures 2 and 8).

    The run's sensor model has no parameters to learn; `number` is that of the reading, from 1.
    """
    step, coarse = run.steps[number - 1], run.experiment.grid
    grid = Grid(coarse.width_mm, coarse.height_mm, _FINER * coarse.n_x - 1, _FINER * coarse.n_y - 1)
    # A fine place is within reach as the nearest place of the coarse grid is.
    rows = np.rint(np.linspace(0, coarse.n_y - 1, grid.n_y)).astype(np.int64)
    columns = np.rint(np.linspace(0, coarse.n_x - 1, grid.n_x)).astype(np.int64)
    reachable = step.map.reachable[: coarse.n_places].reshape(coarse.n_y, coarse.n_x)[np.ix_(rows, columns)].ravel()
    return entropy_map(run.experiment.model, step.samples, grid, grid.plan("field"), reachable=reachable)


def window_around_runs_mm(runs: Sequence[Exploration], first: int) -> tuple[float, float, float, float]:
    """Return limits (left, right, lower, upper) that hold all readings and each run's circles after reading `first`.

    The runs are over the same field; the margin is 30 mm, inside the field.
    """
    grid = runs[0].experiment.grid
    drawn = [outline for run in runs for outline in outlines(run.experiment.shape.region(run.steps[first - 1].samples))]
    places = [[r.pose.x_mm, r.pose.y_mm] for run in runs for r in run.readings]
    points = np.concatenate([*drawn, np.array(places)])
    (left, low), (right, high) = points.min(axis=0) - _MARGIN_MM, points.max(axis=0) + _MARGIN_MM
    return max(left, 0.0), min(right, grid.width_mm), max(low, 0.0), min(high, grid.height_mm)


def draw_final_posteriors(searches: Sequence[RobotSearch]) -> AxesGrid:
    """Draw each robot's view after its last reading, all of the same part of the field; return the axes, (1, n)."""
    ends = np.array([window_around_runs_mm([s.run], len(s.run.steps)) for s in searches])
    corners = np.concatenate([ends[:, ::2], ends[:, 1::2], *(s.truth_mm for s in searches)])
    (left, low), (right, high) = corners.min(axis=0), corners.max(axis=0)
    axes = grid_of_axes(1, 2, size_in=(PAGE_IN, 1.4 + 3.3 * (high - low) / (right - left)))
    for ax, search in zip(axes[0], searches, strict=True):
        n = len(search.run.steps)
        title = f"{search.model} robot, after {count_with_noun(n, 'reading')}"
        search.draw_view(n, title=title, ax=ax).set(xlim=(left, right), ylim=(low, high))
    draw_field_legend(axes)
    return axes


def draw_effect_probabilities(doubting: Exploration) -> Axes:
    """Draw what a robot that doubts its sensor model believes to be left out after each reading; return the axes."""
    trust = doubting.experiment.trust
    return effect_probabilities_by_reading([left_out_after_step(s, trust).probability for s in doubting.steps])
