"""The page of the demo: calibration, searches with each sensor model, a diagnosis with its repair, a doubting robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import FloatArray
from probewise._words import count_with_noun
from probewise.arm import Geometry
from probewise.calibration import Calibration
from probewise.diagnosis import Diagnosis
from probewise.diagnosis.words import hypothesis_in_words
from probewise.experiment import Exploration, Step, left_out_after_step
from probewise.inquiry import Grid, entropy_map
from probewise.recordings import Prediction, Recording
from probewise.report import calibration as calibration_report
from probewise.report import diagnosis as diagnosis_report
from probewise.report.diagnosis_figures import before_and_after
from probewise.report.exploration import draw_robot_view, draw_widths_and_information, errors_text
from probewise.report.html import Markup, Section, element, figures, fragment, page, paragraph, slideshow, table
from probewise.report.pictures import join_side_by_side
from probewise.report.plots.apparatus import arm_and_sensor
from probewise.report.plots.canvas import PAGE_IN, AxesGrid, grid_of_frames, lay_out, png
from probewise.report.plots.probabilities import effect_probabilities_by_reading, hypothesis_probabilities
from probewise.report.plots.readings import quadrant_patterns, residuals_by_scan, sensor_orientations
from probewise.report.plots.search import draw_field_legend
from probewise.report.words import number_text, typeset_numbers
from probewise.scene import outlines

SATURATION = 40.0
"""Reading at which the concealed effect of the third world, saturation, sets in; the model expects 60 over white."""
_FIRST = 3  # as in the paper's figure
_FINER = 2  # times as many places per side as the robot's grid, which is coarser than an edge is wide
_MARGIN_MM = 30.0
_OUTLINE = 0.45
_HEADER = (
    *("sensor model", "readings", "until the first white", "bits", "bits per reading", "the paper's count"),
    *("largest error", "errors"),
)
_SENSOR = (
    "The sensor sees a blurred patch of the surface. Its spatial sensitivity function (SSF) is the weight that each "
    "point of the patch has in a reading; a calibration infers it from readings over patterns that are known."
)
_CAPTIONS = {
    "arm.png": "The arm as its geometry file describes it (paper, figure 1): one motor turns the base, two move the "
    "links, and parallel rods keep the sensor level. A LED lights the surface; a ridge keeps its light from the "
    "photodiode.",
    "orientations.png": "The sensor in its four orientations, seen from above through its package, and the symbols of "
    "their readings below (paper, figure 3). It crosses the edge between black and white in steps of 1 mm.",
    "quadrants.png": "Four patterns that tell the SSF from its mirror images (paper, figure 4): one reading each at "
    "the cross, with the sensor at 0°. The number in the white part is the reading.",
    "first_three.png": "Both robots start with the same reading on white, then follow the paper's rule: read where the "
    "entropy is highest (paper, figures 2 and 8). With the naive model (left) the circles cut the field into cells of "
    "uniform entropy, at most 1 bit. With the SSF model (right) the circles' edges are bright: a reading there also "
    "measures how much white the sensor sees. The inference differs from the paper's: posterior samples are reweighted "
    "after each reading. The paper's own, a new nested sampling run after each reading, is probewise explore --method "
    "paper.",
    "progress.png": "Left: widest posterior sd after each reading; a run ends below 4 mm. Right: information about the "
    "circle.",
    "explanations.png": "Probability of each explanation; they sum to one.",
    "scans.png": "Residuals (recorded minus predicted) along the scans that the repair changes most: each reading, and "
    "running means. Orange: the calibrated model. Blue: the repaired model.",
    "doubt.png": "The posterior of each robot at its end: left the trusting robot, right the doubting one. Blue: 50 "
    "circles drawn from the posterior. Dashed white: the hidden circle.",
    "belief.png": "What the doubting robot believes about its sensor after each reading. A dashed line marks a reading "
    "that changed the most probable effect.",
}


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
    def n(self) -> int:
        """Number of readings."""
        return len(self.run.steps)

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
        seen = [r.value > sum(self.levels) / 2 for r in self.run.readings]
        return seen.index(True) + 1 if any(seen) else len(seen)

    def step_after(self, n: int) -> Step:
        """Return the step after `n` readings, or the last one if the run ended earlier."""
        return self.run.steps[min(n, self.n) - 1]

    def draw_view(self, number: int, *, title: str, ax: Axes, **options: Any) -> Axes:
        """Draw the robot's view after reading `number`, from 1, with the true shape; return the axes."""
        seen = [(r.pose.x_mm, r.pose.y_mm, r.value) for r in self.run.readings[:number]]
        options |= {"levels": self.levels, "truth_mm": self.truth_mm, "title": title, "ax": ax}
        return draw_robot_view(self.run.steps[number - 1], self.run.experiment, seen, **options)


def _sd_text(step: Step) -> str:
    return f"{number_text(step.largest_sd_mm, 1)} mm"


def _comparison_rows(searches: Sequence[RobotSearch]) -> list[tuple[str, ...]]:
    """Return the cells of the table of searches, in the order of `_HEADER`, one row per search."""
    return [
        (
            s.model,
            str(s.n),
            str(s.readings_until_first_white),
            number_text(s.run.last.bits, 1),
            number_text(s.run.bits_per_reading, 2),
            number_text(s.run.paper_bits_per_reading, 2),
            f"{number_text(s.largest_error_mm, 1)} mm",
            errors_text(s.run, s.truth),
        )
        for s in searches
    ]


def search_comparison_lines(searches: Sequence[RobotSearch]) -> list[str]:
    """Write the comparison of searches as lines of text: a table of each one's cost, then another of its errors."""
    rows = [_HEADER, *_comparison_rows(searches)]
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


def _draw_paper_views(searches: Sequence[RobotSearch], numbers: Sequence[int]) -> AxesGrid:
    """Draw the paper's view after each of `numbers` readings (rows) of each search (columns); return the axes."""
    window = window_around_runs_mm([s.run for s in searches], numbers[0])
    across, up = window[1] - window[0], window[3] - window[2]
    size, margins = (5.0, 1.3 + 3.5 * up / across), (0.65, 0.5, 0.85, 0.8)
    axes = grid_of_frames(len(numbers), len(searches), size_in=size, margins_in=margins)
    for row, n in zip(axes, numbers, strict=True):
        for ax, search in zip(row, searches, strict=True):
            paper_view(search, min(n, search.n), window_mm=window, ax=ax)
    return axes


def paper_view(search: RobotSearch, number: int, *, window_mm: tuple[float, float, float, float], ax: Axes) -> Axes:
    """Draw the robot's view after a reading as the paper does (figures 2 and 8): a fine entropy map, and the circles.

    `number` is that of the reading, from 1; `window_mm` are the limits shown: left, right, lower, upper. The run's
    sensor model has no parameters to learn.
    """
    step, experiment = search.run.steps[number - 1], search.run.experiment
    coarse = experiment.grid
    grid = Grid(coarse.width_mm, coarse.height_mm, _FINER * coarse.n_x - 1, _FINER * coarse.n_y - 1)
    # A fine place is within reach as the nearest place of the coarse grid is.
    sides = ((coarse.n_y, grid.n_y), (coarse.n_x, grid.n_x))
    nearest = np.ix_(*(np.rint(np.linspace(0, few - 1, many)).astype(np.int64) for few, many in sides))
    reachable = step.map.reachable[: coarse.n_places].reshape(coarse.n_y, coarse.n_x)[nearest].ravel()
    drawn = entropy_map(experiment.model, step.samples, grid, grid.plan("field"), reachable=reachable)
    title = f"{search.model} model, {count_with_noun(number, 'reading')}: sd up to {_sd_text(step)}"
    search.draw_view(number, title=title, ax=ax, drawn=drawn, lego_scale=True)
    ax.collections[0].set_linewidth(_OUTLINE)
    ax.set(xlim=window_mm[:2], ylim=window_mm[2:])
    return ax


def window_around_runs_mm(runs: Sequence[Exploration], first: int) -> tuple[float, float, float, float]:
    """Return limits (left, right, lower, upper) that hold all readings and each run's circles after reading `first`.

    The runs are over the same field; the margin is 30 mm, inside the field.
    """
    grid = runs[0].experiment.grid
    drawn = [outline for run in runs for outline in outlines(run.experiment.shape.region(run.steps[first - 1].samples))]
    points = np.concatenate([*drawn, np.array([[r.pose.x_mm, r.pose.y_mm] for run in runs for r in run.readings])])
    (left, low), (right, high) = points.min(axis=0) - _MARGIN_MM, points.max(axis=0) + _MARGIN_MM
    return max(left, 0.0), min(right, grid.width_mm), max(low, 0.0), min(high, grid.height_mm)


def draw_final_posteriors(searches: Sequence[RobotSearch]) -> AxesGrid:
    """Draw each robot's view after its last reading, all of the same part of the field; return the axes, (1, n)."""
    ends = np.array([window_around_runs_mm([s.run], s.n) for s in searches])
    corners = np.concatenate([ends[:, ::2], ends[:, 1::2], *(s.truth_mm for s in searches)])
    (left, low), (right, high) = corners.min(axis=0), corners.max(axis=0)
    size, margins = (PAGE_IN / 2, 1.3 + 3.2 * (high - low) / (right - left)), (0.65, 1.0, 0.95, 0.3)
    axes = grid_of_frames(1, 2, size_in=size, margins_in=margins)
    for ax, s in zip(axes[0], searches, strict=True):
        title = f"{s.model} robot, after {count_with_noun(s.n, 'reading')}"
        s.draw_view(s.n, title=title, ax=ax).set(xlim=(left, right), ylim=(low, high))
    draw_field_legend(axes)
    return axes


def draw_effect_probabilities(doubting: Exploration) -> Axes:
    """Draw what a robot that doubts its sensor model believes to be left out after each reading; return the axes."""
    trust = doubting.experiment.trust
    return effect_probabilities_by_reading([left_out_after_step(s, trust).probability for s in doubting.steps])


@dataclass(frozen=True, eq=False)
class DemoRun:
    """Everything that a demo has found.

    `searches` are the naive and the SSF robot's from an empty field, `started_alike` from the same first reading, with
    places chosen by the paper's rule; `doubt` is the search of a trusting and of a doubting robot. `diagnosis` is that
    of the second recording, whose simulated world `concealed` the effect of that name.
    """

    calibration: Calibration
    recording: Recording
    prediction: Prediction
    searches: Sequence[RobotSearch]
    started_alike: Sequence[RobotSearch]
    doubt: Sequence[RobotSearch]
    diagnosis: Diagnosis
    geometry: Geometry
    concealed: str
    seed: int


def summary_sentence(searches: Sequence[RobotSearch]) -> str:
    """State in one sentence how many readings the SSF and the naive robot needed after the same first reading."""
    naive, ssf = (s.n - 1 for s in searches)
    how = "" if all(s.run.target_reached for s in searches) else " (not every run reached that)"
    return (
        f"After the same first reading on white, the robot that knows what its sensor sees needed {ssf} more readings "
        f"to know the circle to 4 mm; the naive robot needed {naive}{how}."
    )


def _sds_after_equal_readings_text(searches: Sequence[RobotSearch]) -> str:
    """Compare both robots' widest posterior sds (mm) after as many readings as the SSF robot, the second, needed."""
    naive, ssf = searches
    return (
        f"After {count_with_noun(ssf.n, 'reading')} each, the naive robot knows the circle to "
        f"{_sd_text(naive.step_after(ssf.n))}, the other to {_sd_text(ssf.run.last)} (widest posterior sd)."
    )


def main_findings_by_key(run: DemoRun) -> dict[str, str | int]:
    """Return what other pages quote of the demo, by key: seed, verdict, its effects, the concealed one, sentences."""
    return {
        "seed": run.seed,
        "search": summary_sentence(run.started_alike),
        "equal_readings": _sds_after_equal_readings_text(run.started_alike),
        "verdict": run.diagnosis.verdict,
        "combination": "+".join(run.diagnosis.combination),
        "concealed": run.concealed,
        "diagnosis": diagnosis_report.summary_sentence(run.diagnosis),
        "reason": typeset_numbers(run.diagnosis.reason),
        "doubt": doubt_sentence(run.doubt),
    }


def figure_drawers(run: DemoRun) -> dict[str, Callable[[], bytes]]:
    """List all figures of the demo by file name, as functions that draw PNGs."""
    recording, diagnosis, started_alike, doubt = run.recording, run.diagnosis, run.started_alike, run.doubt
    hidden = started_alike[0].truth_mm
    n_first = [k for k in range(1, _FIRST + 1) if all(k < s.n for s in started_alike)]
    names = [hypothesis_in_words(h.effects) for h in diagnosis.hypotheses]
    before, after = diagnosis.before.readings, diagnosis.after.readings
    drawings: dict[str, Callable[[], Any]] = {
        "arm.png": lambda: arm_and_sensor(run.geometry, (float(hidden[0, 0]), float(hidden[0, 1])), outline_mm=hidden),
        "orientations.png": lambda: sensor_orientations(recording),
        "quadrants.png": lambda: quadrant_patterns(recording),
        "first_three.png": lambda: _draw_paper_views(started_alike, n_first),
        "equal_readings.png": lambda: _draw_paper_views(started_alike, [started_alike[-1].n]),
        "progress.png": lambda: draw_widths_and_information({f"{s.model} model": s.run.steps for s in run.searches}),
        "explanations.png": lambda: hypothesis_probabilities(names, [h.probability for h in diagnosis.hypotheses]),
        "scans.png": lambda: residuals_by_scan(diagnosis.recording, before, after),
        "before_after.png": lambda: lay_out(before_and_after(diagnosis)),
        "doubt.png": lambda: draw_final_posteriors(doubt),
        "belief.png": lambda: draw_effect_probabilities(doubt[-1].run),
    }
    return calibration_report.figure_drawers(run.calibration, recording, run.prediction) | {
        name: partial(lambda draw: png(draw()), draw) for name, draw in drawings.items()
    }


def page_html(run: DemoRun, drawn: Mapping[str, bytes], *, frames: Sequence[Sequence[bytes]], seconds: float) -> str:
    """Return the HTML of the demo's page; `drawn` is from `figure_drawers`, `frames` has a PNG of each step."""
    captions = {
        "equal_readings.png": f"{_sds_after_equal_readings_text(run.started_alike)} Left the naive model, right the "
        "SSF model. Blue: 50 circles drawn from the posterior; where errors of centre and radius add up, their edges "
        "spread over several sds. Copper: entropy of the readings that these circles predict; brighter places promise "
        "more information. Squares: readings by their brightness. Green: the next place. Dashed white: the hidden "
        "circle.",
        "before_after.png": diagnosis_report.before_and_after_caption(run.diagnosis),
    }
    shown = figures(drawn, _CAPTIONS | captions)
    facts = {
        "seed": str(run.seed),
        "time": f"{number_text(seconds, 0)} s",
        "recordings": "the two that ship with the package, both simulated by a world that shares no code with "
        "the models",
        "version": f"probewise {run.calibration.sensor.version}",
    }
    return page(
        "Modeling a sensor to improve its efficacy",
        answer=summary_sentence(run.started_alike),
        key_figure=shown["equal_readings.png"],
        sections=[
            _sensor_section(run, drawn, shown),
            _search_section(run, frames, shown),
            _diagnosis_section(run.diagnosis, shown, run.concealed),
            doubt_section(run.doubt, drawn),
            Section("This run", (facts,)),
        ],
    )


def _sensor_section(run: DemoRun, drawn: Mapping[str, bytes], shown: Mapping[str, Markup]) -> Section:
    sensor = run.calibration.sensor
    parts = (
        Section("The arm and its sensor", (shown["arm.png"],)),
        Section("How the recording was taken", (shown["orientations.png"], shown["quadrants.png"])),
        *calibration_report.sections(sensor, run.recording, run.prediction, drawn, seed=run.seed)[:-1],
    )
    return Section("The sensor", (_SENSOR, calibration_report.summary_sentence(sensor)), parts)


def _search_section(run: DemoRun, frames: Sequence[Sequence[bytes]], shown: Mapping[str, Markup]) -> Section:
    searches = naive, ssf = run.searches
    introduction = (
        "A white circle lies somewhere on the black field. The naive robot believes that its sensor sees a point, "
        "black or white. The other predicts each reading with the calibrated SSF. Both choose their own readings and "
        "stop when centre and radius are known to 4 mm each."
    )
    counted = (
        "Bits: prior minus posterior differential entropy of the circle's parameters. The paper counts 25 bits for "
        "the whole search, whatever the run. Errors: estimate minus truth, ± posterior sd (mm). One run each: the "
        "number of readings varies from circle to circle, most of all until the first white reading."
    )
    texts = [
        "; ".join(
            f"{s.model} model, {count_with_noun(min(n, s.n), 'reading')}: {_sd_text(s.step_after(n))}"
            + (" (ended)" if n > s.n else "")
            for s in searches
        )
        for n in range(1, max(naive.n, ssf.n) + 1)
    ]
    whole = (
        f"From an empty field, finding the circle at all takes luck, whatever the model: the naive robot met "
        f"it at reading {naive.readings_until_first_white} of {naive.n}, the SSF robot at reading "
        f"{ssf.readings_until_first_white} of {ssf.n}. These robots choose by the default rule: the expected "
        "information of a reading or, near the end, the probability that it ends the run. The colour bar names the one "
        "shown.",
        slideshow(
            list(zip(join_side_by_side(*frames), texts, strict=True)),
            "Each step of both searches; the length below the picture is the widest posterior sd.",
        ),
        shown["progress.png"],
        table(_HEADER, _comparison_rows(searches), caption="From an empty field; columns as in the table above."),
    )
    alike = table(_HEADER, _comparison_rows(run.started_alike), caption=counted)
    parts = (
        Section("As in the paper: the first three readings", (shown["first_three.png"], alike)),
        Section("A whole search, step by step", whole),
    )
    return Section("The search", (introduction,), parts)


def _diagnosis_section(diagnosis: Diagnosis, shown: Mapping[str, Markup], concealed: str) -> Section:
    gain = diagnosis.improvement
    held = (
        f"On scans that were held out of the fit, the repaired model gains "
        f"{number_text(gain.heldout_log_density_per_reading, 3)} ± {number_text(gain.heldout_sd, 3)} "
        "nats per reading. (A nat is a unit of log probability: "
        "one nat more makes a reading e = 2.7 times as probable.)"
    )
    link = element("a", "the full report of the diagnosis", href="diagnosis/report.html")
    repair = (
        shown["before_after.png"],
        *((held,) if diagnosis.repair_changes_predictions and gain.heldout_by_scan else ()),
        shown["scans.png"],
        paragraph(
            fragment("Where the residuals lie, which effects are aliased and what to measure next:  ", link, ".")
        ),
    )
    said = (
        f"The simulated world that made this recording concealed: {concealed.replace('_', ' ')}. The diagnosis did "
        "not know that."
    )
    return Section(
        "A mismatch, found and repaired",
        (diagnosis_report.summary_sentence(diagnosis), said),
        (Section("What it could be", (shown["explanations.png"],)), Section("The repair", repair)),
    )


def doubt_sentence(searches: Sequence[RobotSearch]) -> str:
    """Say in one sentence how both robots ended (readings, largest error, widest sd), the trusting one first."""
    trusting, doubting = (
        f"{count_with_noun(s.n, 'reading')}, off by {number_text(s.largest_error_mm, 1)} mm "
        f"(posterior sd up to {_sd_text(s.run.last)})"
        for s in searches
    )
    return f"The robot that trusts its sensor model took {trusting}; the one that doubts it took {doubting}."


def doubt_section(searches: Sequence[RobotSearch], drawn: Mapping[str, bytes]) -> Section:
    """Build the demo's section from both searches, the trusting robot's first, and from `figure_drawers`."""
    doubting, shown = searches[-1].run, figures(drawn, _CAPTIONS)
    introduction = (
        f"A third world conceals a fault: its sensor saturates at {SATURATION:g} LEGO units, where white would read "
        f"{number_text(searches[0].levels[1], 0)}. The sensor model leaves that out. One robot trusts the model. "
        f"The other expects with probability {1 - doubting.experiment.trust:.1g} that an effect is missing; "
        "it compares the plain model with each effect that could act, and chooses its readings and its end under all "
        "of them."
    )
    rows = table(
        ("robot", "readings", "largest error", "widest posterior sd", "stopped because"),
        (
            (s.model, str(s.n), f"{number_text(s.largest_error_mm, 1)} mm", _sd_text(s.run.last), s.run.stop_reason)
            for s in searches
        ),
        caption="Both robots look for the circle of the searches above, from the same first reading on it. One run "
        "each; probewise study --concealed repeats it for many circles and effects.",
    )
    reported = left_out_after_step(doubting.last, doubting.experiment.trust).sentence
    return Section(
        "A robot that doubts its sensor",
        (
            introduction,
            doubt_sentence(searches),
            shown["doubt.png"],
            rows,
            shown["belief.png"],
            f"At its end the doubting robot reports: {reported}",
        ),
    )
