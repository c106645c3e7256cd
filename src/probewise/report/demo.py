"""The page of the main job: all the paper's figures in one place, and the diagnosis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.calibration import Calibration
from probewise.diagnosis import Diagnosis
from probewise.experiment import Exploration
from probewise.recordings import Prediction, Recording
from probewise.report import calibration as calibration_report
from probewise.report import diagnosis as diagnosis_report
from probewise.report import exploration as exploration_report
from probewise.report.html import Markup, Section, definition_list, figure, page, paragraph, table
from probewise.report.plots import AxesGrid, grid_of_axes, information_gained, png, posterior_widths
from probewise.report.words import number

__all__ = [
    "Search",
    "answer",
    "comparison_lines",
    "comparison_rows",
    "comparison_table",
    "diagnosis_sections",
    "figures",
    "write_page",
]

FIRST = 3  # the paper shows the first three measurements side by side
LATER = 7  # and the map after seven
AFTER_WHITE = 4  # the telling moment: the circle is met, and not yet known
HEADER = (
    "sensor model",
    "readings",
    "until the first white",
    "bits",
    "bits a reading",
    "the paper's count",
    "largest error",
    "errors",
)


@dataclass(frozen=True, eq=False)
class Search:
    """One robot's search: the name of its sensor model, its run, what lay there."""

    model: str
    run: Exploration
    truth: Mapping[str, float]
    truth_mm: FloatArray
    levels: tuple[float, float]

    @property
    def largest_error_mm(self) -> float:
        """Largest absolute error of a parameter in mm."""
        last = self.run.last
        return max(
            abs(float(mean) - self.truth[name])
            for name, mean in zip(last.names, last.mean, strict=True)
            if name in self.truth and name.endswith("_mm")
        )

    @property
    def first_white(self) -> int:
        """Number of the first reading that saw more white than black: until then it is luck, whatever the model."""
        middle = sum(self.levels) / 2
        seen = [r.value > middle for r in self.run.readings]
        return seen.index(True) + 1 if any(seen) else len(seen)

    def readings_to(self, n_steps: int) -> list[tuple[float, float, float]]:
        """Place and value of the first readings."""
        return [(r.pose.x_mm, r.pose.y_mm, r.value) for r in self.run.readings[:n_steps]]


def answer(searches: Sequence[Search]) -> str:
    """Say in one sentence what knowing the sensor was worth in this run."""
    naive, ssf = searches
    n_naive, n_ssf = len(naive.run.steps), len(ssf.run.steps)
    return (
        f"Once it had met the circle, the robot that knows what its sensor sees needed {n_ssf - ssf.first_white} more "
        f"readings, the naive one {n_naive - naive.first_white}; in all {n_ssf} and {n_naive}, with errors up to "
        f"{number(ssf.largest_error_mm, 1)} and {number(naive.largest_error_mm, 1)} mm."
    )


def comparison_rows(searches: Sequence[Search]) -> list[tuple[str, ...]]:
    """Fill the comparison: readings, information, errors, a row each sensor model."""
    return [
        (
            s.model,
            str(len(s.run.steps)),
            str(s.first_white),
            number(s.run.last.bits, 1),
            number(s.run.bits_per_reading, 2),
            number(s.run.paper_bits_per_reading, 2),
            f"{number(s.largest_error_mm, 1)} mm",
            exploration_report.errors_text(s.run.last, s.truth),
        )
        for s in searches
    ]


def comparison_table(searches: Sequence[Search]) -> Markup:
    """Build the table of the comparison."""
    return table(
        HEADER,
        comparison_rows(searches),
        caption=(
            "Bits: prior minus posterior differential entropy of the circle's parameters. The paper counts 25 bits for "
            "the whole search, whatever the run. Errors: estimate minus truth, ± posterior sd (mm). One run each: the "
            "number of readings varies from circle to circle, most of all until the first white reading."
        ),
    )


def figures(
    calibration: Calibration, recording: Recording, prediction: Prediction, searches: Sequence[Search]
) -> dict[str, bytes]:
    """Draw all figures but the diagnosis's: PNG by file name."""
    drawn = calibration_report.figures(calibration, recording, prediction)
    drawn["first_three.png"] = png(_views(searches, [(k, k) for k in range(1, FIRST + 1)]))
    drawn["found.png"] = png(_views(searches, [tuple(s.first_white + AFTER_WHITE for s in searches)]))
    drawn["after_seven.png"] = png(_views(searches, [tuple(min(LATER, len(s.run.steps)) for s in searches)]))
    names = [f"{s.model} model" for s in searches]
    drawn["precision.png"] = png(
        posterior_widths(
            {n: np.array([step.widest_mm for step in s.run.steps]) for n, s in zip(names, searches, strict=True)}
        )
    )
    drawn["information.png"] = png(
        information_gained(
            {n: np.array([step.bits for step in s.run.steps]) for n, s in zip(names, searches, strict=True)}
        )
    )
    return drawn


def _views(searches: Sequence[Search], rows: Sequence[tuple[int, ...]]) -> AxesGrid:
    axes = grid_of_axes(len(rows), len(searches), size_in=(7.2 * len(searches), 4.0 * len(rows)))
    for row, counts in zip(axes, rows, strict=True):
        for ax, search, n in zip(row, searches, counts, strict=True):
            step = search.run.steps[min(n, len(search.run.steps)) - 1]
            exploration_report.view(
                step,
                search.run.experiment,
                search.readings_to(step.number),
                levels=search.levels,
                truth_mm=search.truth_mm,
                title=f"{search.model} model, after {step.number} reading{'s' if step.number > 1 else ''}",
                ax=ax,
            )
    return axes


def write_page(
    calibration: Calibration,
    recording: Recording,
    prediction: Prediction,
    searches: Sequence[Search],
    drawn: Mapping[str, bytes],
    diagnosis: Sequence[Section],
    *,
    seed: int,
    seconds: float,
) -> str:
    """Write the whole page; `diagnosis` holds the sections of its report."""
    shown = calibration_report.sections(calibration.sensor, recording, prediction, drawn, seed=seed)
    robot = [
        Section(
            "The comparison",
            (
                comparison_table(searches),
                figure(drawn["precision.png"], "Widest posterior sd after each reading; a run ends below 4 mm."),
                figure(drawn["information.png"], "Information about the circle after each reading."),
            ),
        ),
        Section(
            "The first three measurements",
            (
                figure(
                    drawn["first_three.png"],
                    "Left the naive model, right the SSF model, as in the paper. With the naive model the hypotheses "
                    "cut the field into cells of equal entropy, at most one bit; with the SSF model their edges "
                    "are worth most.",
                ),
                figure(drawn["after_seven.png"], "The same after seven measurements."),
            ),
        ),
    ]
    sensor = [
        Section("The sensor model", (paragraph(calibration_report.answer(calibration.sensor)),)),
        *shown[:-1],
    ]
    closing = Section(
        "This run",
        (
            definition_list(
                (
                    ("seed", str(seed)),
                    ("time", f"{number(seconds, 0)} s"),
                    ("recordings", "the two that ship with the package, both simulated by an independent world"),
                    ("version", f"probewise {calibration.sensor.version}"),
                )
            ),
        ),
    )
    caption = (
        "The robot's view soon after it met the circle, naive model left, SSF model right: in copper where a "
        "reading would tell most, blue the 50 circles drawn from what is believed, squares the readings by "
        "their brightness, green the place chosen next, dashed white the hidden circle; grey is out of the arm's reach."
    )
    return page(
        "Modeling a sensor to improve its efficacy",
        answer=answer(searches),
        key_figure=figure(drawn["found.png"], caption),
        sections=[*robot, *diagnosis, *sensor, closing],
    )


def comparison_lines(searches: Sequence[Search]) -> list[str]:
    """Lay the comparison out as lines of text."""
    rows = [HEADER, *comparison_rows(searches)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(HEADER))]
    return ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]


def diagnosis_sections(diagnosis: Diagnosis, drawn: Mapping[str, bytes], concealed: str) -> list[Section]:
    """Build the sections on the second recording, and say what really was concealed in it."""
    opening = Section(
        "A second recording, diagnosed",
        (
            paragraph(diagnosis_report.answer(diagnosis)),
            paragraph(f"The world that made the recording concealed: {concealed.replace('_', ' ')}."),
        ),
    )
    return [opening, *diagnosis_report.sections(diagnosis, drawn)]
