"""HTML of results in notebooks, registered by type with `render_html`: a sentence, a picture, sometimes a table."""

from __future__ import annotations

import html

import numpy as np

from probewise._display import render_html
from probewise._words import count_with_noun, unit_after_number, unit_of_name
from probewise.calibration import Calibration, FittedSensor
from probewise.diagnosis import Diagnosis, PlanAudit, SystemFit
from probewise.diagnosis.words import effect_in_words, hypothesis_in_words
from probewise.experiment import Exploration, Step
from probewise.investigation import Investigation
from probewise.nested import NestedResult, Weighted
from probewise.recordings import Prediction, Recording
from probewise.report import audit as audit_report
from probewise.report import calibration as calibration_report
from probewise.report import diagnosis as diagnosis_report
from probewise.report import exploration as exploration_report
from probewise.report import fit as fit_report
from probewise.report import investigation as investigation_report
from probewise.report.html import Markup, element, figure, paragraph, table
from probewise.report.plots.canvas import png
from probewise.report.plots.nested import corner_plot
from probewise.report.plots.probabilities import hypothesis_probabilities
from probewise.report.plots.readings import predicted_and_recorded_by_scan, readings_by_orientation
from probewise.report.plots.residuals import recorded_against_predicted
from probewise.report.plots.search import posterior_widths
from probewise.report.plots.ssf import spatial_sensitivity
from probewise.report.words import value_with_error, words_without_unit
from probewise.sensor import SSFField
from probewise.systems import SystemPrediction
from probewise.systems.table import RunRecording

__all__: list[str] = []

DPI = 96  # as large as drawn, so that 9 point type is 9 point; notebooks keep every picture, so no larger
SSF_CAPTION = "Spatial sensitivity function, seen from above; white lines at a half and a tenth of its peak"
MOST_PARAMETERS = 6  # of a run's picture in a notebook: compact; `corner_plot` draws all of them


def _div(*parts: Markup) -> str:
    return element("div", *parts)


def _pre(text: str) -> Markup:
    return Markup(f"<pre>{html.escape(text)}</pre>")


@render_html.register
def _ssf_field_html(value: SSFField) -> str:
    return _div(
        figure(
            png(spatial_sensitivity(value), dpi=DPI),
            SSF_CAPTION,
        )
    )


@render_html.register
def _recording_html(value: Recording) -> str:
    taken, scans = count_with_noun(len(value), "reading"), count_with_noun(len(value.plan.scan_names), "scan")
    said = f"{taken}, {int(value.usable.sum())} usable, {scans}"
    return _div(figure(png(readings_by_orientation(value), dpi=DPI), said))


@render_html.register
def _run_recording_html(value: RunRecording) -> str:
    return _div(paragraph(f"{value.summary()}; {count_with_noun(len(value.plan.scan_names), 'run')}"))


@render_html.register
def _fitted_sensor_html(value: FittedSensor) -> str:
    picture = figure(png(spatial_sensitivity(value.field), dpi=DPI), "Mean SSF field")
    return _div(
        paragraph(calibration_report.summary_sentence(value)), picture, calibration_report.parameter_table(value)
    )


@render_html.register
def _calibration_html(value: Calibration) -> str:
    drawn = calibration_report.draw_ssf_by_n_gaussians(value)
    return _div(
        paragraph(calibration_report.summary_sentence(value.sensor)),
        figure(png(drawn, dpi=DPI), "Mean SSF by number of Gaussians"),
        calibration_report.evidence_table(value.sensor),
    )


@render_html.register
def _nested_result_html(value: NestedResult) -> str:
    text = _pre(value.summary())
    if not value.names:
        return _div(text)
    drawn = corner_plot(value, parameters=value.names[:MOST_PARAMETERS])
    left_out = len(value.names) - MOST_PARAMETERS
    of = f" of the first {MOST_PARAMETERS} of {len(value.names)} parameters" if left_out > 0 else ""
    return _div(figure(png(drawn, dpi=DPI), f"Posterior{of}: each by itself, and each pair"), text)


@render_html.register
def _weighted_html(value: Weighted) -> str:
    names = value.names[:MOST_PARAMETERS]
    believed = zip(names, value.mean(), value.sd(), strict=False)
    known = ", ".join(
        f"{words_without_unit(n)} {value_with_error(float(m), float(s), unit_of_name(n))}" for n, m, s in believed
    )
    drawn = corner_plot(value, parameters=names)
    return _div(
        figure(png(drawn, dpi=DPI), "Posterior: each parameter by itself, and each pair"),
        paragraph(f"{known}; {count_with_noun(len(value.theta), 'sample')}, effective sample size {value.n_eff:.0f}."),
    )


@render_html.register
def _step_html(value: Step) -> str:
    pose = value.reading.pose
    return _div(paragraph(value.summary()), paragraph(f"Taken at ({pose.x_mm:g}, {pose.y_mm:g}) mm."))


@render_html.register
def _exploration_html(value: Exploration) -> str:
    readings = [(r.pose.x_mm, r.pose.y_mm, r.value) for r in value.readings]
    seen = [r.value for r in value.readings]
    truth_mm = None if value.hidden is None else value.hidden.outline_mm
    picture = exploration_report.robot_view_png(
        value.last, value.experiment, readings, levels=(min(seen), max(seen)), truth_mm=truth_mm
    )
    widths = posterior_widths(
        {"run": np.array([s.largest_sd_mm for s in value.steps])}, target_mm=value.experiment.stop_sd_mm
    )
    return _div(
        paragraph(exploration_report.summary_sentence(value)),
        figure(picture, "The robot's view at the end"),
        figure(png(widths, dpi=DPI), "Widest posterior sd after each reading"),
    )


@render_html.register
def _prediction_html(value: Prediction) -> str:
    recording = Recording(value.plan, value.readings)
    drawn = predicted_and_recorded_by_scan(recording, value.mean, value.sd)
    said = value.summary().replace("\n", "; ")
    return _div(paragraph(said), figure(png(drawn, dpi=DPI), "Predicted readings, each with its 95 % band"))


@render_html.register
def _plan_audit_html(value: PlanAudit) -> str:
    drawn = png(audit_report.draw_detectability_and_aliases(value), dpi=DPI)
    text = _pre(value.summary())
    return _div(
        paragraph(audit_report.summary_sentence(value)), figure(drawn, "Detectability of effects, and aliases"), text
    )


@render_html.register
def _diagnosis_html(value: Diagnosis) -> str:
    hypotheses = [h for h in value.hypotheses if h.probability > 1e-3]
    bars = hypothesis_probabilities(
        [hypothesis_in_words(h.effects) for h in hypotheses], [h.probability for h in hypotheses]
    )
    rows = [
        (effect_in_words(e.name), f"{e.probability:.3f}", e.sentence) for e in value.effects if e.probability > 0.05
    ]
    return _div(
        paragraph(diagnosis_report.summary_sentence(value)),
        figure(png(bars, dpi=DPI), "Probability of each hypothesis"),
        *((table(("effect", "probability", "what it does"), rows),) if rows else ()),
    )


@render_html.register
def _system_fit_html(value: SystemFit) -> str:
    own = value.fitted.simulator
    readings = np.where(value.recording.usable, value.recording.readings, np.nan)
    unit = unit_after_number(own.unit)
    drawn = recorded_against_predicted(readings, value.predicted, value.sd, label=own.reading, unit=unit)
    return _div(
        paragraph(fit_report.summary_sentence(value)),
        figure(png(drawn, dpi=DPI), "Recorded against predicted readings; on the line they agree."),
        _pre(value.summary()),
    )


@render_html.register
def _system_prediction_html(value: SystemPrediction) -> str:
    said = _pre(value.summary())
    if not np.isfinite(value.readings).any():
        return _div(said)
    unit = value.table.instrumentation.unit_after_number
    drawn = recorded_against_predicted(value.readings, value.mean, value.sd, label="reading", unit=unit)
    return _div(figure(png(drawn, dpi=DPI), "Recorded against predicted readings; on the line they agree."), said)


@render_html.register
def _investigation_html(value: Investigation) -> str:
    said = _pre(value.summary())
    return _div(
        paragraph(investigation_report.summary_sentence(value)),
        investigation_report.probabilities_figure_html(investigation_report.probabilities_png(value)),
        said,
    )
