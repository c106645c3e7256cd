"""The page of the demo: calibration, a search with each sensor model, a diagnosis with its repair, a doubting robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.axes import Axes

from probewise._words import count_with_noun
from probewise.arm import Geometry
from probewise.calibration import Calibration
from probewise.diagnosis import Diagnosis
from probewise.experiment import Exploration, Step, left_out_after_step
from probewise.recordings import Prediction, Recording
from probewise.report import calibration as calibration_report
from probewise.report import diagnosis as diagnosis_report
from probewise.report.diagnosis_figures import before_and_after
from probewise.report.exploration import draw_view_after, draw_widths_and_information
from probewise.report.html import Section, element, figures, page, paragraph, table
from probewise.report.plots.apparatus import draw_arm_lengths
from probewise.report.plots.canvas import PAGE_IN, AxesGrid, grid_of_axes, png
from probewise.report.plots.probabilities import effect_probabilities_by_reading
from probewise.report.plots.search import draw_field_legend
from probewise.report.words import number_text, typeset_numbers
from probewise.scene import outlines

SATURATION = 40.0
"""Reading at which the concealed effect of the third world, saturation, sets in; the model expects 60 over white."""
_MARGIN_MM = 30.0
_SENSOR = (
    "The sensor sees a blurred patch of the surface. Its spatial sensitivity function (SSF) is the weight that each "
    "point of the patch has in a reading; a calibration infers it from readings over patterns that are known."
)
_CAPTIONS = {
    "arm.png": "The arm from the side, with the lengths of its geometry file (paper, figure 1): one motor turns the "
    "base, two move the links.",
    "progress.png": "Left: widest posterior sd after each reading; a run ends below 4 mm. Right: information about the "
    "circle, prior minus posterior differential entropy; the paper counts 25 bits for the whole search.",
    "doubt.png": "The posterior of each robot at its end: left the trusting robot, right the doubting one. Blue: 50 "
    "circles drawn from the posterior. Dashed white: the hidden circle.",
    "belief.png": "What the doubting robot believes about its sensor after each reading.",
}


def largest_error_mm(run: Exploration) -> float:
    """Return the largest absolute error, posterior mean against truth, of the parameters in mm at the end of a run."""
    last = run.last
    truth = {} if run.hidden is None else run.hidden.parameters_by_hypothesis_name(last.names)
    mean = dict(zip(last.names, last.mean, strict=True))
    return max(abs(float(mean[name]) - true) for name, true in truth.items() if name.endswith("_mm"))


def _sd_text(step: Step) -> str:
    return f"{number_text(step.largest_sd_mm, 1)} mm"


_HEADER = ("robot", "readings", "bits", "bits per reading", "largest error", "widest posterior sd", "stopped because")


def _comparison_rows(searches: Mapping[str, Exploration]) -> list[tuple[str, ...]]:
    """Return the cells of the table of searches, in the order of `_HEADER`, one row per search."""
    return [
        (
            name,
            str(len(run.steps)),
            number_text(run.last.bits, 1),
            number_text(run.bits_per_reading, 2),
            f"{number_text(largest_error_mm(run), 1)} mm",
            _sd_text(run.last),
            run.stop_reason,
        )
        for name, run in searches.items()
    ]


def draw_views(searches: Mapping[str, Exploration], n: int) -> AxesGrid:
    """Draw each robot's view after `n` readings (or its last), side by side, of one part of the field; return the axes.

    The part holds all readings, the circles drawn from each posterior and the true ones.
    """
    steps = {name: run.steps[:n][-1] for name, run in searches.items()}
    grid = next(iter(searches.values())).experiment.grid
    points = []
    for name, run in searches.items():
        points += [np.array([[r.pose.x_mm, r.pose.y_mm] for r in run.readings])]
        points += outlines(run.experiment.shape.region(steps[name].samples))
        points += [] if run.hidden is None else [run.hidden.outline_mm]
    (left, low), (right, high) = (end(np.concatenate(points), axis=0) for end in (np.min, np.max))
    left, low = max(left - _MARGIN_MM, 0.0), max(low - _MARGIN_MM, 0.0)
    right, high = min(right + _MARGIN_MM, grid.width_mm), min(high + _MARGIN_MM, grid.height_mm)
    sides = ((grid.x_mm, left, right), (grid.y_mm, low, high))
    axes = grid_of_axes(1, len(searches), size_in=(PAGE_IN, 1.6 + 3.6 * (high - low) / (right - left)))
    for ax, (name, run) in zip(axes[0], searches.items(), strict=True):
        step = steps[name]
        done = ", done" if step is run.last else ""
        title = f"{name}, {count_with_noun(step.number, 'reading')}{done}: sd up to {_sd_text(step)}"
        draw_view_after(run, step.number, title=title, ax=ax).set(xlim=(left, right), ylim=(low, high))
        (columns,), (rows,) = (np.nonzero((at >= a) & (at <= b)) for at, a, b in sides)
        if np.isfinite(step.map.image[np.ix_(rows, columns)]).all():
            for patch in ax.patches:  # no place out of reach is in this part
                patch.set_label("")
    draw_field_legend(axes)
    return axes


@dataclass(frozen=True, eq=False)
class DemoRun:
    """Everything that a demo has found.

    `searches` are the naive and the SSF robot's from the same first reading, with places chosen by the paper's rule;
    `doubt` are those of a trusting and of a doubting robot; by name, the hidden circle included. `diagnosis` is that of
    the second recording, whose simulated world `concealed` the effect of that name.
    """

    calibration: Calibration
    recording: Recording
    prediction: Prediction
    searches: Mapping[str, Exploration]
    doubt: Mapping[str, Exploration]
    diagnosis: Diagnosis
    geometry: Geometry
    concealed: str
    seed: int


def summary_sentence(searches: Mapping[str, Exploration]) -> str:
    """State in one sentence how many readings the SSF and the naive robot needed after the same first reading."""
    naive, ssf = (len(run.steps) - 1 for run in searches.values())
    how = "" if all(run.target_reached for run in searches.values()) else " (not every run reached that)"
    return (
        f"After the same first reading on white, the robot that knows what its sensor sees needed {ssf} more readings "
        f"to know the circle to 4 mm; the naive robot needed {naive}{how}."
    )


def _sds_after_equal_readings_text(searches: Mapping[str, Exploration]) -> str:
    """Compare both robots' widest posterior sds (mm) after as many readings as the SSF robot, the second, needed."""
    naive, ssf = (run.steps for run in searches.values())
    return (
        f"After {count_with_noun(len(ssf), 'reading')} each, the naive robot knows the circle to "
        f"{_sd_text(naive[: len(ssf)][-1])}, the other to {_sd_text(ssf[-1])} (widest posterior sd)."
    )


def main_findings_by_key(run: DemoRun) -> dict[str, str | int]:
    """Return what other pages quote of the demo, by key: seed, verdict, its effects, the concealed one, sentences."""
    return {
        "seed": run.seed,
        "search": summary_sentence(run.searches),
        "equal_readings": _sds_after_equal_readings_text(run.searches),
        "verdict": run.diagnosis.verdict,
        "combination": "+".join(run.diagnosis.combination),
        "concealed": run.concealed,
        "diagnosis": diagnosis_report.summary_sentence(run.diagnosis),
        "reason": typeset_numbers(run.diagnosis.reason),
        "doubt": doubt_sentence(run.doubt),
    }


def figure_drawers(run: DemoRun) -> dict[str, Callable[[], bytes]]:
    """List all figures of the demo by file name, as functions that draw PNGs."""
    *_, searched = (len(each.steps) for each in run.searches.values())
    *_, doubting = run.doubt.values()
    beliefs = [left_out_after_step(step, doubting.experiment.trust).probability for step in doubting.steps]
    drawings: dict[str, Callable[[], Axes | AxesGrid]] = {
        "arm.png": lambda: draw_arm_lengths(run.geometry),
        "equal_readings.png": lambda: draw_views(run.searches, searched),
        "progress.png": lambda: draw_widths_and_information({f"{k} model": v.steps for k, v in run.searches.items()}),
        "before_after.png": lambda: before_and_after(run.diagnosis),
        "doubt.png": lambda: draw_views(run.doubt, max(len(each.steps) for each in run.doubt.values())),
        "belief.png": lambda: effect_probabilities_by_reading(beliefs),
    }
    return calibration_report.figure_drawers(run.calibration, run.recording, run.prediction) | {
        name: partial(lambda draw: png(draw()), draw) for name, draw in drawings.items()
    }


def page_html(run: DemoRun, drawn: Mapping[str, bytes], *, seconds: float) -> str:
    """Return the HTML of the demo's page; `drawn` is from `figure_drawers`."""
    captions = {
        "equal_readings.png": f"{_sds_after_equal_readings_text(run.searches)} Left the naive model, right the "
        "SSF model. Blue: 50 circles drawn from the posterior. Copper: entropy of the readings that these circles "
        "predict (paper, figures 2 and 8); brighter places promise more information. Squares: readings by their "
        "brightness. Green: the next place. Dashed white: the hidden circle.",
        "before_after.png": diagnosis_report.before_and_after_caption(run.diagnosis),
    }
    shown, sensor = figures(drawn, _CAPTIONS | captions), run.calibration.sensor
    facts = {
        "seed": str(run.seed),
        "time": f"{number_text(seconds, 0)} s",
        "recordings": "the two that ship with the package, both simulated by a world that shares no code with "
        "the models",
        "version": f"probewise {sensor.version}",
    }
    of_sensor = (
        Section("The arm", (shown["arm.png"],)),
        *calibration_report.sections(sensor, run.recording, run.prediction, drawn, seed=run.seed)[:-1],
    )
    searching = (
        "A simulated circle lies on the field. The naive robot takes each reading for that of a point; the other one "
        "uses the calibrated SSF. Both begin with the same reading on white, read where the entropy is highest, and "
        "stop when centre and radius are known to 4 mm each. One run each: the number of readings varies from circle "
        "to circle.",
        table(_HEADER, _comparison_rows(run.searches)),
        shown["progress.png"],
    )
    link = element("a", "the full report of the diagnosis", href="diagnosis/report.html")
    diagnosed = (
        diagnosis_report.summary_sentence(run.diagnosis),
        f"The simulated world that made this recording concealed: {run.concealed.replace('_', ' ')}. The diagnosis did "
        "not know that.",
        shown["before_after.png"],
        paragraph("Probabilities, held-out readings, aliased effects and what to measure next: ", link, "."),
    )
    sections = [
        Section("The sensor", (_SENSOR, calibration_report.summary_sentence(sensor)), of_sensor),
        Section("The search", searching),
        Section("A mismatch, found and repaired", diagnosed),
        doubt_section(run.doubt, drawn, white=sensor.mean()["I_max"]),
        Section("This run", (facts,)),
    ]
    title, answer = "Modeling a sensor to improve its efficacy", summary_sentence(run.searches)
    return page(title, answer=answer, key_figure=shown["equal_readings.png"], sections=sections)


def doubt_sentence(searches: Mapping[str, Exploration]) -> str:
    """Say in one sentence how both robots ended (readings, largest error, widest sd), the trusting one first."""
    trusting, doubting = (
        f"{count_with_noun(len(run.steps), 'reading')}, off by {number_text(largest_error_mm(run), 1)} mm "
        f"(posterior sd up to {_sd_text(run.last)})"
        for run in searches.values()
    )
    return f"The robot that trusts its sensor model took {trusting}; the one that doubts it took {doubting}."


def doubt_section(searches: Mapping[str, Exploration], drawn: Mapping[str, bytes], *, white: float) -> Section:
    """Build the demo's section from both searches, the trusting robot's first, and from `figure_drawers`.

    `white` is the reading over white that the sensor model expects.
    """
    (*_, doubting), shown = searches.values(), figures(drawn, _CAPTIONS)
    introduction = (
        f"A third world conceals a fault: its sensor saturates at {SATURATION:g} LEGO units, where white would read "
        f"{number_text(white, 0)}. The sensor model leaves that out. One robot trusts the model. "
        f"The other expects with probability {1 - doubting.experiment.trust:.1g} that an effect is missing; "
        "it compares the plain model with each effect that could act, and chooses its readings and its end under all "
        "of them."
    )
    reported = left_out_after_step(doubting.last, doubting.experiment.trust).sentence
    body = (
        introduction,
        shown["doubt.png"],
        table(_HEADER, _comparison_rows(searches)),
        shown["belief.png"],
        f"At its end the doubting robot reports: {reported}",
    )
    return Section("A robot that doubts its sensor", body)
