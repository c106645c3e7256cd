"""The page of a fit of a user's simulator: predicted against recorded, posterior, evidence, residuals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import cast

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import unit_after_number
from probewise.diagnosis import SystemFit
from probewise.report.html import Section, definition_list, figure, page, paragraph, table
from probewise.report.plots.canvas import svg
from probewise.report.plots.residuals import recorded_against_predicted, residuals_against_covariates
from probewise.report.words import digits_of_range, number_text, typeset_numbers
from probewise.systems import RunTable

_MOST_COLUMNS = 6
_LEAST_VALUES = 8  # distinct values of a column, for a running mean along it


def summary_sentence(fit: SystemFit) -> str:
    """Summarise a fit of a simulator in one sentence: number of readings, and rms of the residuals."""
    unit = fit.recording.plan.instrumentation.unit_after_number
    n = int(fit.recording.usable.sum())
    rms = f"{fit.rms:.3g} {unit} (rms){fit.recording.weighting_in_words}"
    return f"The simulator fits {n} readings with residuals of {rms}."


def figure_drawers(fit: SystemFit) -> dict[str, Callable[[], bytes]]:
    """List a fit's figures by file name: functions that draw recorded against predicted readings, and residuals.

    Residuals are drawn against time, predicted reading, and up to four input columns of eight distinct values or more.
    """
    recording, own = fit.recording, fit.fitted.simulator
    unit, readings = unit_after_number(own.unit), np.where(fit.recording.usable, fit.recording.readings, np.nan)
    return {
        "predicted.svg": lambda: svg(
            recorded_against_predicted(readings, fit.predicted, fit.sd, label=own.reading, unit=unit)
        ),
        "residuals.svg": lambda: svg(
            residuals_against_covariates(
                _labelled_covariates(fit, cast(RunTable, recording.plan)), [("fitted", fit.residuals)], unit=unit
            )
        ),
    }


def _labelled_covariates(fit: SystemFit, plan: RunTable) -> tuple[tuple[str, FloatArray], ...]:
    own = fit.fitted.simulator
    time = f"{plan.time} ({own.time_unit})" if plan.has_varying_time else "row of the table"
    out = [(time, plan.time_s), (f"predicted {own.reading} ({unit_after_number(own.unit)})", fit.predicted)]
    inputs = {name: v for name, v in plan.covariates.items() if name not in (own.reading, own.noise.sd)}
    varying = {name: v for name, v in inputs.items() if len(np.unique(v[np.isfinite(v)])) >= _LEAST_VALUES}
    return (*out, *list(varying.items())[: _MOST_COLUMNS - len(out)])


def page_html(fit: SystemFit, drawn: Mapping[str, bytes], *, seed: int) -> str:
    """Return the HTML of a fit's page; `drawn` is from `figure_drawers`."""
    own, evidence = fit.fitted, fit.evidence
    median, interval = np.median(own.samples, axis=0), own.interval()
    error = f" ± {number_text(evidence.error, 2)}" if evidence.error else ""
    how = f"; {evidence.reason}" if evidence.reason else ""
    digits = {name: digits_of_range(*interval[name], 5) for name in own.names}
    rows = [
        (
            name,
            typeset_numbers(f"{median[k]:.{digits[name]}g}"),
            typeset_numbers(" to ".join(f"{end:.{digits[name]}g}" for end in interval[name])),
        )
        for k, name in enumerate(own.names)
    ]
    run = (
        ("readings", f"{int(fit.recording.usable.sum())} used of {len(fit.recording)}, from {own.source}"),
        ("simulator", own.simulator.source or "given in Python"),
        ("noise sd of a reading", f"{np.median(own.noise_sd):.4g} {unit_after_number(own.simulator.unit)}"),
        ("log evidence", f"{number_text(evidence.log_z, 2)}{error} nats by {evidence.method}{how}"),
        ("seed", str(seed)),
    )
    return page(
        f"Fit of {own.source}",
        answer=summary_sentence(fit),
        key_figure=figure(drawn["predicted.svg"], "Recorded against predicted readings; on the line they agree."),
        sections=[
            Section("Posterior", (table(("parameter", "median", "95 % interval"), rows),)),
            Section(
                "Residuals",
                (
                    figure(drawn["residuals.svg"], "Recorded minus predicted reading, with running means."),
                    paragraph("probewise diagnose tests them and names the physics that would explain them."),
                ),
            ),
            Section("This run", (definition_list(run), *(paragraph(f"Note: {note}.") for note in fit.recording.notes))),
        ],
    )
