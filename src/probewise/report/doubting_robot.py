"""Two robots whose sensor model leaves an effect out: one trusts the model, the other doubts it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes

from probewise._words import count_with_noun
from probewise.experiment import Exploration, left_out_after_step
from probewise.report import exploration as exploration_report
from probewise.report.html import Section, figure, paragraph, table
from probewise.report.paper_view import window_around_runs_mm
from probewise.report.plots.canvas import PAGE_IN, AxesGrid, grid_of_axes, png
from probewise.report.plots.probabilities import effect_probabilities_by_reading
from probewise.report.plots.search import draw_field_legend
from probewise.report.robot_search import RobotSearch
from probewise.report.words import number_text

SATURATION = 40.0
"""Reading at which the concealed effect of the demo, saturation, sets in; the model expects 60 over white."""


def summary_sentence(searches: Sequence[RobotSearch]) -> str:
    """Say in one sentence how both robots ended (readings, largest error, widest sd), the trusting one first."""
    trusting, doubting = (
        f"{count_with_noun(len(s.run.steps), 'reading')}, off by {number_text(s.largest_error_mm, 1)} mm "
        f"(posterior sd up to {number_text(s.run.last.largest_sd_mm, 1)} mm)"
        for s in searches
    )
    return f"The robot that trusts its sensor model took {trusting}; the one that doubts it took {doubting}."


def figure_drawers(searches: Sequence[RobotSearch]) -> dict[str, Callable[[], bytes]]:
    """List the section's figures by file name, as functions that draw PNGs.

    These are both robots' final posteriors, and the doubting one's probabilities of effects.
    """
    return {
        "doubt.png": lambda: png(_draw_final_posteriors(searches)),
        "belief.png": lambda: png(_draw_effect_probabilities(searches[-1].run)),
    }


def _draw_final_posteriors(searches: Sequence[RobotSearch]) -> AxesGrid:
    ends = np.array([window_around_runs_mm([s.run], len(s.run.steps)) for s in searches])
    corners = np.concatenate([ends[:, ::2], ends[:, 1::2], *(s.truth_mm for s in searches)])
    (left, low), (right, high) = corners.min(axis=0), corners.max(axis=0)
    axes = grid_of_axes(1, 2, size_in=(PAGE_IN, 1.4 + 3.3 * (high - low) / (right - left)))
    for ax, search in zip(axes[0], searches, strict=True):
        places = [(r.pose.x_mm, r.pose.y_mm, r.value) for r in search.run.readings]
        title = f"{search.model} robot, after {count_with_noun(len(places), 'reading')}"
        exploration_report.draw_robot_view(
            search.run.last,
            search.run.experiment,
            places,
            levels=search.levels,
            truth_mm=search.truth_mm,
            title=title,
            ax=ax,
        ).set(xlim=(left, right), ylim=(low, high))
    draw_field_legend(axes)
    return axes


def _draw_effect_probabilities(doubting: Exploration) -> Axes:
    beliefs = [left_out_after_step(step, doubting.experiment.trust).probability for step in doubting.steps]
    return effect_probabilities_by_reading(beliefs)


def section(searches: Sequence[RobotSearch], drawn: Mapping[str, bytes]) -> Section:
    """Build the demo's section from both searches, the trusting robot's first, and from `figure_drawers`."""
    doubting = searches[-1].run
    missing = left_out_after_step(doubting.last, doubting.experiment.trust)
    introduction = paragraph(
        f"A third world conceals a fault: its sensor saturates at {SATURATION:g} LEGO units, where white would read "
        f"{number_text(searches[0].levels[1], 0)}. The sensor model leaves that out. One robot trusts the model. "
        f"The other expects with probability {1 - doubting.experiment.trust:.1g} that an effect is missing; "
        "it compares the plain model with each effect that could act, and chooses its readings and its end under all "
        "of them."
    )
    rows = table(
        ("robot", "readings", "largest error", "widest posterior sd", "stopped because"),
        (
            (
                s.model,
                str(len(s.run.steps)),
                f"{number_text(s.largest_error_mm, 1)} mm",
                f"{number_text(s.run.last.largest_sd_mm, 1)} mm",
                s.run.stop_reason,
            )
            for s in searches
        ),
        caption="Both robots look for the circle of the searches above, from the same first reading on it. One run "
        "each; probewise study --concealed repeats it for many circles and effects.",
    )
    fields = figure(
        drawn["doubt.png"],
        "The posterior of each robot at its end: left the trusting robot, right the doubting one. Blue: 50 circles "
        "drawn from the posterior. Dashed white: the hidden circle.",
    )
    belief = figure(
        drawn["belief.png"],
        "What the doubting robot believes about its sensor after each reading. A dashed line marks a reading that "
        "changed the most probable effect.",
    )
    found = paragraph(f"At its end the doubting robot reports: {missing.sentence}")
    return Section(
        "A robot that doubts its sensor",
        (introduction, paragraph(summary_sentence(searches)), fields, rows, belief, found),
    )
