"""What a result shows of itself: its main picture, its HTML in notebooks; of a verb also its page and its files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from probewise._arrays import FloatArray
from probewise._kinds import checked_path, checked_whole
from probewise._writing import Drawings, Output, checked_output_directory
from probewise.calibration import Calibration, FittedSensor
from probewise.diagnosis import Diagnosis, PlanAudit, SystemFit
from probewise.errors import ParameterError
from probewise.experiment import Exploration
from probewise.inquiry import Inquiry
from probewise.investigation import Investigation
from probewise.nested.result import Samples
from probewise.recordings import Prediction, Recording
from probewise.report import audit, calibration, diagnosis, exploration, fit, investigation
from probewise.report.diagnosis_figures import draw_first_figure
from probewise.report.html import element, figure
from probewise.report.plots.canvas import AxesGrid, figure_of, png, text_as_it_is
from probewise.report.plots.nested import corner_plot
from probewise.report.plots.readings import predicted_and_recorded_by_scan, readings_by_orientation
from probewise.report.plots.residuals import readings_in_order, recorded_against_predicted
from probewise.report.plots.ssf import spatial_sensitivity
from probewise.sensor import SSFField
from probewise.systems import SystemPrediction
from probewise.systems.table import RunRecording

__all__: list[str] = []

_DPI = 96  # as large as drawn, so that 9 point type is 9 point; notebooks keep every picture, so no larger
_MOST_PARAMETERS = 6  # of a run's picture in a notebook: compact; `corner_plot` draws all of them


def _draw_recorded_against_predicted(value: SystemPrediction) -> Axes:
    unit, readings = value.table.instrumentation.unit_after_number, value.readings
    return recorded_against_predicted(readings, value.mean, value.sd, label="reading", unit=unit)


def _draw_predicted(value: Prediction) -> AxesGrid:
    readings: FloatArray = value.readings
    return predicted_and_recorded_by_scan(Recording(value.plan, readings), value.mean, value.sd)


def _draw_posterior(value: Samples) -> AxesGrid:
    return corner_plot(value, parameters=value.names[:_MOST_PARAMETERS])


_SSF = "Spatial sensitivity function, seen from above; white lines at a half and a tenth of its peak."
_ON_THE_LINE = "Recorded against predicted readings; on the line they agree."
_POSTERIOR = f"Posterior of up to {_MOST_PARAMETERS} parameters: each by itself, and each pair."
_DRAWINGS: dict[type, tuple[Callable[[Any], Axes | AxesGrid], str]] = {
    SSFField: (spatial_sensitivity, _SSF),
    FittedSensor: (lambda value: spatial_sensitivity(value.field), _SSF),
    Calibration: (calibration.draw_ssf_by_n_gaussians, "Mean SSF by number of Gaussians."),
    Recording: (readings_by_orientation, "Readings along the scans."),
    RunRecording: (readings_in_order, "Readings in the order of the rows."),
    Prediction: (_draw_predicted, "Predicted readings, each with its 95 % band."),
    Samples: (_draw_posterior, _POSTERIOR),
    Inquiry: (lambda value: _draw_posterior(value.posterior), _POSTERIOR),
    Exploration: (exploration.draw_last_view, "The robot's view at the end."),
    Diagnosis: (draw_first_figure, "Residuals, and probabilities of explanations."),
    SystemFit: (fit.draw_recorded_against_predicted, _ON_THE_LINE),
    SystemPrediction: (_draw_recorded_against_predicted, _ON_THE_LINE),
    PlanAudit: (audit.draw_detectability_and_aliases, "Detectability of effects, and aliases."),
    Investigation: (investigation.draw_probabilities_by_round, "Probability of each explanation after each round."),
}

_OUTPUTS: dict[type, Callable[..., Output]] = {
    Calibration: calibration.output_of,
    Diagnosis: diagnosis.output_of,
    SystemFit: fit.output_of,
    PlanAudit: audit.output_of,
    Investigation: investigation.output_of,
    Exploration: exploration.output_of,
}


def drawing_of(value: object) -> Axes | AxesGrid:
    """Draw a result's main picture; return its axes. ParameterError if a result of this type has none."""
    if (made := _drawing_and_caption(value)) is None:
        raise ParameterError("result", value, f"one with a picture: {', '.join(k.__name__ for k in _DRAWINGS)}")
    drawn = made[0](value)
    with text_as_it_is(figure_of(drawn)):
        return drawn


def html_of(value: object) -> str:
    """Return a result as an HTML fragment: its summary, and its main picture if its type has one."""
    said = element("pre", str(value))
    if (made := _drawing_and_caption(value)) is None:
        return said
    draw, caption = made
    return element("div", said, figure(png(draw(value), dpi=_DPI), caption))


def page_of(value: object, *, seed: int | None) -> str:
    """Return the page of a result, with its figures inside."""
    made = _output_of(value, seed)
    return made.page({name: draw() for name, draw in made.drawers.items()})


def save(value: object, folder: str | Path, *, seed: int | None) -> Path:
    """Write a result into a folder, made if missing, and return it; errors as of `probewise._display.Reported.save`."""
    made, out = _output_of(value, seed), checked_path("folder", folder)
    drawings = Drawings(checked_output_directory(out, main=made.main, option="folder"))
    drawings.write_results(made)
    drawings.raise_if_any_failed()
    return out


def _output_of(value: object, seed: int | None) -> Output:
    make = next(_OUTPUTS[kind] for kind in type(value).__mro__ if kind in _OUTPUTS)
    return make(value, seed=None if seed is None else checked_whole("seed", seed, least=0, most=None))


def _drawing_and_caption(value: object) -> tuple[Callable[[Any], Axes | AxesGrid], str] | None:
    return next((_DRAWINGS[kind] for kind in type(value).__mro__ if kind in _DRAWINGS), None)
