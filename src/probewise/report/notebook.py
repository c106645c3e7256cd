"""HTML of results in notebooks, registered by type with `render_html`: a sentence, a picture, sometimes a table."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from probewise._display import render_html
from probewise._words import count_with_noun, unit_of_name
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
from probewise.report.plots.canvas import AxesGrid, png
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

_DPI = 96  # as large as drawn, so that 9 point type is 9 point; notebooks keep every picture, so no larger
_MOST_PARAMETERS = 6  # of a run's picture in a notebook: compact; `corner_plot` draws all of them
_ON_THE_LINE = "Recorded against predicted readings; on the line they agree."


def _div(*parts: str | Markup) -> str:
    """Join parts; text becomes a paragraph."""
    return element("div", *(part if isinstance(part, Markup) else paragraph(part) for part in parts))


def _picture(drawing: Axes | AxesGrid, caption: str) -> Markup:
    return figure(png(drawing, dpi=_DPI), caption)


def _pre(text: str) -> Markup:
    return element("pre", text)


@render_html.register
def _ssf_field_html(value: SSFField) -> str:
    caption = "Spatial sensitivity function, seen from above; white lines at a half and a tenth of its peak"
    return _div(_picture(spatial_sensitivity(value), caption))


@render_html.register
def _recording_html(value: Recording) -> str:
    taken, scans = count_with_noun(len(value), "reading"), count_with_noun(len(value.plan.scan_names), "scan")
    return _div(_picture(readings_by_orientation(value), f"{taken}, {int(value.usable.sum())} usable, {scans}"))


@render_html.register
def _run_recording_html(value: RunRecording) -> str:
    return _div(f"{value.summary()}; {count_with_noun(len(value.plan.scan_names), 'run')}")


@render_html.register
def _fitted_sensor_html(value: FittedSensor) -> str:
    picture = _picture(spatial_sensitivity(value.field), "Mean SSF field")
    return _div(calibration_report.summary_sentence(value), picture, calibration_report.parameter_table(value))


@render_html.register
def _calibration_html(value: Calibration) -> str:
    picture = _picture(calibration_report.draw_ssf_by_n_gaussians(value), "Mean SSF by number of Gaussians")
    evidence = calibration_report.evidence_table(value.sensor)
    return _div(calibration_report.summary_sentence(value.sensor), picture, evidence)


@render_html.register
def _nested_result_html(value: NestedResult) -> str:
    text = _pre(value.summary())
    if not value.names:
        return _div(text)
    left_out = len(value.names) - _MOST_PARAMETERS
    of = f" of the first {_MOST_PARAMETERS} of {len(value.names)} parameters" if left_out > 0 else ""
    drawn = corner_plot(value, parameters=value.names[:_MOST_PARAMETERS])
    return _div(_picture(drawn, f"Posterior{of}: each by itself, and each pair"), text)


@render_html.register
def _weighted_html(value: Weighted) -> str:
    names = value.names[:_MOST_PARAMETERS]
    known = ", ".join(
        f"{words_without_unit(n)} {value_with_error(float(m), float(s), unit_of_name(n))}"
        for n, m, s in zip(names, value.mean(), value.sd(), strict=False)
    )
    picture = _picture(corner_plot(value, parameters=names), "Posterior: each parameter by itself, and each pair")
    return _div(
        picture, f"{known}; {count_with_noun(len(value.theta), 'sample')}, effective sample size {value.n_eff:.0f}."
    )


@render_html.register
def _step_html(value: Step) -> str:
    pose = value.reading.pose
    return _div(value.summary(), f"Taken at ({pose.x_mm:g}, {pose.y_mm:g}) mm.")


@render_html.register
def _exploration_html(value: Exploration) -> str:
    readings = [(r.pose.x_mm, r.pose.y_mm, r.value) for r in value.readings]
    seen = [r.value for r in value.readings]
    truth_mm = None if value.hidden is None else value.hidden.outline_mm
    picture = exploration_report.robot_view_png(
        value.last, value.experiment, readings, levels=(min(seen), max(seen)), truth_mm=truth_mm
    )
    sds = {"run": np.array([s.largest_sd_mm for s in value.steps])}
    return _div(
        exploration_report.summary_sentence(value),
        figure(picture, "The robot's view at the end"),
        _picture(
            posterior_widths(sds, target_mm=value.experiment.stop_sd_mm), "Widest posterior sd after each reading"
        ),
    )


@render_html.register
def _prediction_html(value: Prediction) -> str:
    drawn = predicted_and_recorded_by_scan(Recording(value.plan, value.readings), value.mean, value.sd)
    return _div(value.summary().replace("\n", "; "), _picture(drawn, "Predicted readings, each with its 95 % band"))


@render_html.register
def _plan_audit_html(value: PlanAudit) -> str:
    picture = _picture(audit_report.draw_detectability_and_aliases(value), "Detectability of effects, and aliases")
    return _div(audit_report.summary_sentence(value), picture, _pre(value.summary()))


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
        diagnosis_report.summary_sentence(value),
        _picture(bars, "Probability of each hypothesis"),
        *((table(("effect", "probability", "what it does"), rows),) if rows else ()),
    )


@render_html.register
def _system_fit_html(value: SystemFit) -> str:
    picture = _picture(fit_report.draw_recorded_against_predicted(value), _ON_THE_LINE)
    return _div(fit_report.summary_sentence(value), picture, _pre(value.summary()))


@render_html.register
def _system_prediction_html(value: SystemPrediction) -> str:
    if not np.isfinite(value.readings).any():
        return _div(_pre(value.summary()))
    unit = value.table.instrumentation.unit_after_number
    drawn = recorded_against_predicted(value.readings, value.mean, value.sd, label="reading", unit=unit)
    return _div(_picture(drawn, _ON_THE_LINE), _pre(value.summary()))


@render_html.register
def _investigation_html(value: Investigation) -> str:
    picture = investigation_report.probabilities_figure_html(investigation_report.probabilities_png(value))
    return _div(investigation_report.summary_sentence(value), picture, _pre(value.summary()))
