"""The main picture of each type of result, for `plot`, and its HTML in notebooks: a sentence, a picture, a table."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from probewise._display import render_html
from probewise._words import count_with_noun, unit_of_name
from probewise.calibration import Calibration, FittedSensor
from probewise.diagnosis import Diagnosis, PlanAudit, SystemFit
from probewise.diagnosis.words import effect_in_words, hypothesis_in_words
from probewise.errors import ParameterError
from probewise.experiment import Exploration, Step
from probewise.investigation import Investigation
from probewise.nested import NestedResult, Weighted
from probewise.nested.result import Samples
from probewise.recordings import Prediction, Recording
from probewise.report import audit, calibration, diagnosis, exploration, fit, investigation
from probewise.report.covariates import ResidualNoise
from probewise.report.diagnosis_figures import draw_first_figure
from probewise.report.html import Markup, element, figure, paragraph, table
from probewise.report.plots.canvas import AxesGrid, lay_out, png
from probewise.report.plots.nested import corner_plot
from probewise.report.plots.probabilities import hypothesis_probabilities
from probewise.report.plots.readings import predicted_and_recorded_by_scan, readings_by_orientation
from probewise.report.plots.residuals import readings_in_order, recorded_against_predicted
from probewise.report.plots.search import posterior_widths
from probewise.report.plots.ssf import spatial_sensitivity
from probewise.report.words import value_with_error, words_without_unit
from probewise.sensor import SSFField
from probewise.systems import SystemPrediction
from probewise.systems.table import RunRecording

__all__: list[str] = []

_DPI = 96  # as large as drawn, so that 9 point type is 9 point; notebooks keep every picture, so no larger
_MOST_PARAMETERS = 6  # of a run's picture in a notebook: compact; `corner_plot` draws all of them
_ON_THE_LINE = "Recorded against predicted readings; on the line they agree."


def _div(*parts: str | Markup) -> str:
    """Join parts; text becomes a paragraph."""
    return element("div", *(part if isinstance(part, Markup) else paragraph(part) for part in parts))


def _picture(drawing: Axes | AxesGrid, caption: str) -> Markup:
    return figure(png(drawing, dpi=_DPI), caption)


def _pre(value: Any) -> Markup:
    return element("pre", value.summary())


def _draw_recorded_against_predicted(value: SystemPrediction) -> Axes:
    unit = value.table.instrumentation.unit_after_number
    return recorded_against_predicted(value.readings, value.mean, value.sd, label="reading", unit=unit)


# In the HTML an exploration's is a PNG as in its report, and a diagnosis's has the probabilities alone.
_DRAWINGS: dict[type, Callable[[Any], Axes | AxesGrid]] = {
    SSFField: spatial_sensitivity,
    FittedSensor: lambda value: spatial_sensitivity(value.field),
    Calibration: calibration.draw_ssf_by_n_gaussians,
    Recording: readings_by_orientation,
    RunRecording: readings_in_order,
    Prediction: lambda value: predicted_and_recorded_by_scan(
        Recording(value.plan, value.readings), value.mean, value.sd
    ),
    Samples: lambda value: corner_plot(value, parameters=value.names[:_MOST_PARAMETERS]),
    Exploration: exploration.draw_last_view,
    Diagnosis: lambda value: lay_out(draw_first_figure(ResidualNoise(value))),
    SystemFit: fit.draw_recorded_against_predicted,
    SystemPrediction: _draw_recorded_against_predicted,
    PlanAudit: audit.draw_detectability_and_aliases,
    Investigation: investigation.draw_probabilities_by_round,
}


def drawing_of(value: object) -> Axes | AxesGrid:
    """Draw a result's main picture; return its axes. ParameterError if a result of this type has none."""
    draw = next((_DRAWINGS[kind] for kind in type(value).__mro__ if kind in _DRAWINGS), None)
    if draw is None:
        raise ParameterError("result", value, f"one with a picture: {', '.join(k.__name__ for k in _DRAWINGS)}")
    return draw(value)


def _drawn(value: object, caption: str) -> Markup:
    return _picture(drawing_of(value), caption)


def _recording_parts(value: Recording) -> tuple[str, ...]:
    taken, scans = count_with_noun(len(value), "reading"), count_with_noun(len(value.plan.scan_names), "scan")
    return (_drawn(value, f"{taken}, {int(value.usable.sum())} usable, {scans}"),)


def _nested_result_parts(value: NestedResult) -> tuple[str, ...]:
    if not value.names:
        return (_pre(value),)
    left_out = len(value.names) - _MOST_PARAMETERS
    of = f" of the first {_MOST_PARAMETERS} of {len(value.names)} parameters" if left_out > 0 else ""
    return _drawn(value, f"Posterior{of}: each by itself, and each pair"), _pre(value)


def _weighted_parts(value: Weighted) -> tuple[str, ...]:
    names = value.names[:_MOST_PARAMETERS]
    known = ", ".join(
        f"{words_without_unit(n)} {value_with_error(float(m), float(s), unit_of_name(n))}"
        for n, m, s in zip(names, value.mean(), value.sd(), strict=False)
    )
    picture = _drawn(value, "Posterior: each parameter by itself, and each pair")
    count = count_with_noun(len(value.theta), "sample")
    return picture, f"{known}; {count}, effective sample size {value.n_eff:.0f}."


def _exploration_parts(value: Exploration) -> tuple[str, ...]:
    picture = exploration.frame_png(value, len(value.steps))
    sds = {"run": np.array([s.largest_sd_mm for s in value.steps])}
    widths = posterior_widths(sds, target_mm=value.experiment.stop_sd_mm)
    return (
        exploration.summary_sentence(value),
        figure(picture, "The robot's view at the end"),
        _picture(widths, "Widest posterior sd after each reading"),
    )


def _diagnosis_parts(value: Diagnosis) -> tuple[str, ...]:
    shown = [h for h in value.hypotheses if h.probability > 1e-3]
    rows = [
        (effect_in_words(e.name), f"{e.probability:.3f}", e.sentence) for e in value.effects if e.probability > 0.05
    ]
    bars = hypothesis_probabilities([hypothesis_in_words(h.effects) for h in shown], [h.probability for h in shown])
    effects = (table(("effect", "probability", "what it does"), rows),) if rows else ()
    return diagnosis.summary_sentence(value), _picture(bars, "Probability of each hypothesis"), *effects


def _system_prediction_parts(value: SystemPrediction) -> tuple[str, ...]:
    if not np.isfinite(value.readings).any():
        return (_pre(value),)
    return _drawn(value, _ON_THE_LINE), _pre(value)


_PARTS: dict[type, Callable[[Any], tuple[str, ...]]] = {
    SSFField: lambda value: (
        _drawn(value, "Spatial sensitivity function, seen from above; white lines at a half and a tenth of its peak"),
    ),
    Recording: _recording_parts,
    RunRecording: lambda value: (f"{value.summary()}; {count_with_noun(len(value.plan.scan_names), 'run')}",),
    FittedSensor: lambda value: (
        calibration.summary_sentence(value),
        _drawn(value, "Mean SSF field"),
        calibration.parameter_table(value),
    ),
    Calibration: lambda value: (
        calibration.summary_sentence(value.sensor),
        _drawn(value, "Mean SSF by number of Gaussians"),
        calibration.evidence_table(value.sensor),
    ),
    NestedResult: _nested_result_parts,
    Weighted: _weighted_parts,
    Step: lambda value: (value.summary(), f"Taken at ({value.reading.pose.x_mm:g}, {value.reading.pose.y_mm:g}) mm."),
    Exploration: _exploration_parts,
    Prediction: lambda value: (
        value.summary().replace("\n", "; "),
        _drawn(value, "Predicted readings, each with its 95 % band"),
    ),
    PlanAudit: lambda value: (
        audit.summary_sentence(value),
        _drawn(value, "Detectability of effects, and aliases"),
        _pre(value),
    ),
    Diagnosis: _diagnosis_parts,
    SystemFit: lambda value: (
        fit.summary_sentence(value),
        _drawn(value, _ON_THE_LINE),
        _pre(value),
    ),
    SystemPrediction: _system_prediction_parts,
    Investigation: lambda value: (
        investigation.summary_sentence(value),
        investigation.probabilities_figure_html(investigation.probabilities_png(value)),
        _pre(value),
    ),
}
for _kind, _parts in _PARTS.items():
    render_html.register(_kind, lambda value, parts=_parts: _div(*parts(value)))
