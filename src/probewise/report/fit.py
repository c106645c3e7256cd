"""The page of a fit of a user's simulator: predicted against recorded, posterior, evidence, residuals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import cast

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import FloatArray, varies
from probewise._words import unit_after_number
from probewise._writing import Output, StagedFiles
from probewise.diagnosis import SystemFit, fit_json
from probewise.report.html import Section, definition_list, figure, notes_in_words, page, seed_fact, table
from probewise.report.plots.canvas import svg
from probewise.report.plots.residuals import recorded_against_predicted, residuals_against_covariates
from probewise.report.words import typeset_numbers, value_and_interval_texts
from probewise.systems import RunTable, samples_csv, write_fitted_system

_MOST_INPUTS = 4
_POOR = 1.5  # times the declared noise: of 24 readings or more the rms is so large by chance in one fit of 2,000


def summary_sentence(fit: SystemFit) -> str:
    """Summarise a fit of a simulator in one sentence: number of readings, and rms of the residuals."""
    rms = f"{fit.rms:.3g} {fit.recording.plan.instrumentation.unit_after_number} (rms)"
    declared, times = fit.fitted.simulator.noise.sd, ""
    if isinstance(declared, float | int) and fit.rms > _POOR * declared:
        times = f", {fit.rms / declared:.2g} times the declared noise: `diagnose` asks what is missing"
    return (
        f"The best fit to {fit.recording.usable.sum()} readings leaves residuals of {rms}"
        f"{fit.recording.weighting_in_words}{times}."
    )


def figure_drawers(fit: SystemFit) -> dict[str, Callable[[], bytes]]:
    """List a fit's figures by file name, as functions that draw SVGs: predicted readings, and residuals."""
    residuals = [("fitted", fit.residuals)]
    unit = unit_after_number(fit.fitted.simulator.unit)
    return {
        "predicted.svg": lambda: svg(draw_recorded_against_predicted(fit)),
        "residuals.svg": lambda: svg(residuals_against_covariates(_labelled_covariates(fit), residuals, unit=unit)),
    }


def draw_recorded_against_predicted(fit: SystemFit) -> Axes:
    """Draw each usable reading against its prediction; return the axes."""
    simulator = fit.fitted.simulator
    readings = np.where(fit.recording.usable, fit.recording.readings, np.nan)
    unit = unit_after_number(simulator.unit)
    return recorded_against_predicted(readings, fit.predicted, fit.sd, label=simulator.reading, unit=unit)


def _labelled_covariates(fit: SystemFit) -> list[tuple[str, FloatArray]]:
    simulator, plan = fit.fitted.simulator, cast(RunTable, fit.recording.plan)
    time = f"{plan.time} ({simulator.time_unit})" if plan.has_varying_time else "row of the table"
    level = f"predicted {simulator.reading} ({unit_after_number(simulator.unit)})"
    inputs = simulator.inputs(plan.covariates)
    varying = [pair for pair in inputs.items() if varies(pair[1])]
    return [(time, plan.time_s), (level, fit.predicted), *varying[:_MOST_INPUTS]]


def page_html(fit: SystemFit, drawn: Mapping[str, bytes], *, seed: int | None) -> str:
    """Return the HTML of a fit's page; `drawn` is from `figure_drawers`."""
    own, mode = fit.fitted, fit.fitted.mode()
    median, interval = np.median(own.samples, axis=0), own.interval()
    rows = [
        (name, *value_and_interval_texts(value, *interval[name]), typeset_numbers(f"{mode[name]:.8g}"))
        for name, value in zip(own.names, median, strict=True)
    ]
    of_file = f", from {own.source}" if own.source else ""
    run = {
        "readings": f"{int(fit.recording.usable.sum())} used of {len(fit.recording)}{of_file}",
        "simulator": own.simulator.source or "given in Python",
        "noise sd of a reading": f"{np.median(own.noise_sd):.4g} {unit_after_number(own.simulator.unit)}",
    }
    evidences = [typeset_numbers(each.in_words) for each in (fit.evidence, fit.nested) if each is not None]
    facts = [*run.items(), *(("log evidence", said) for said in evidences), *seed_fact(seed).items()]
    residuals = figure(drawn["residuals.svg"], "Recorded minus predicted reading, with running means.")
    return page(
        f"Fit of {own.source or own.simulator.reading}",
        answer=summary_sentence(fit),
        key_figure=figure(drawn["predicted.svg"], "Recorded against predicted readings; on the line they agree."),
        sections=[
            Section("Posterior", (table(("parameter", "median", "95 % interval", "mode"), rows),)),
            Section(
                "Residuals", (residuals, "probewise diagnose tests them and names the physics that would explain them.")
            ),
            Section("This run", (definition_list(facts), *notes_in_words(fit.recording.notes))),
        ],
    )


def output_of(value: SystemFit, *, seed: int | None = None) -> Output:
    """Return what is written of a fit: fit.json, fitted.json, samples.csv, figures, page; `seed` is stated if known."""

    def write_files(stage: StagedFiles) -> None:
        stage.write_json("fit.json", fit_json(value))
        write_fitted_system(value.fitted, stage / "fitted.json")
        stage.write("samples.csv", samples_csv(value.fitted))

    page = partial(page_html, value, seed=seed)
    return Output(write_files, figure_drawers(value), page, main="fit.json")
