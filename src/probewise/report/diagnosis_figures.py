"""The figures of a diagnosis: SVG by file name; diagnosis.json refers to them by these names."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import cast

import numpy as np
from matplotlib.axes import Axes

from probewise.diagnosis import Diagnosis, Place
from probewise.diagnosis.locate import figure_name_of
from probewise.diagnosis.words import hypothesis_in_words
from probewise.effects import Effect
from probewise.report.covariates import (
    CovariateView,
    axis_label,
    is_scan_along_line,
    noise_of,
    view_along_scan,
    views_of_place,
)
from probewise.report.plots import residuals as plots
from probewise.report.plots.canvas import BLUE, FILLED, AxesGrid, stack_of_axes, svg
from probewise.report.plots.probabilities import height_of_bars_in, hypothesis_probabilities
from probewise.systems import RunTable

_WORTH_A_BAR = 0.005
_MOST_BARS = 6
_LOST = 5.0  # sds from the prediction beyond which a reading at the lost readings' value counts as lost


def figure_drawers(diagnosis: Diagnosis) -> dict[str, Callable[[], bytes]]:
    """List a diagnosis's figures by file name, as functions that draw SVGs."""
    drawers: dict[str, Callable[[], bytes]] = {
        "first.svg": lambda: svg(draw_first_figure(diagnosis)),
        "before_after.svg": lambda: svg(before_and_after(diagnosis)),
        "noise.svg": lambda: _noise_tests_svg(diagnosis),
    }
    gain = diagnosis.improvement
    if gain.heldout_by_scan:
        mean, sd, part = gain.heldout_log_density_per_reading, gain.heldout_sd, noun_of_held_out_part(diagnosis)
        drawers["gain.svg"] = lambda: svg(plots.heldout_gain_by_scan(gain.heldout_by_scan, mean, sd, part=part))
    for effect in cast(Sequence[Effect], diagnosis.repaired.chain.effects):
        if effect.name.startswith("curve:"):
            drawers[figure_name_of(effect.name)] = partial(_curve_svg, diagnosis, effect)
    return drawers | {place.figure_name: partial(_place_svg, diagnosis, place) for place in diagnosis.where}


def noun_of_held_out_part(diagnosis: Diagnosis) -> str:
    """Return what a held-out part is called: "scan" or "run" if each is one, else (a block, several scans) "part"."""
    held = {name for name, _ in diagnosis.improvement.heldout_by_scan}
    return diagnosis.apparatus.words.run if held <= {*diagnosis.recording.plan.scan_names} else "part"


def first_figure_content(diagnosis: Diagnosis) -> CovariateView | str:
    """Choose the content of a diagnosis's first figure: "readings" if they are too few for a diagnosis.

    For the verdict `noise` it is the name of the largest noise effect, else a view of residuals along a covariate.
    """
    if diagnosis.too_little:
        return "readings"
    if diagnosis.verdict == "noise":
        sizes = {effect.name: effect.size_lambda for effect in diagnosis.effects}
        return max(diagnosis.combination, key=lambda name: sizes.get(name, 0.0))
    return noise_of(diagnosis).first_view


def draw_first_figure(diagnosis: Diagnosis) -> AxesGrid:
    """Draw the first figure's content (`first_figure_content`) and, below it, the probability of each explanation.

    Return both axes, (2,).
    """
    listed = [h for h in diagnosis.hypotheses if h.probability > _WORTH_A_BAR]
    names, most = [hypothesis_in_words(h.effects) for h in listed], min(len(listed), _MOST_BARS)
    bars = [*names[:most], *["others"] * (len(diagnosis.hypotheses) > most)]
    above, below = axes = stack_of_axes([2.7, height_of_bars_in(bars)], aligned=False)
    shown = first_figure_content(diagnosis)
    if shown == "readings":
        plots.readings_in_order(diagnosis.recording, ax=above)
    elif isinstance(shown, str):
        _draw_noise_panel(diagnosis, shown, above)
    else:
        _draw_means_along(diagnosis, shown, each=False, ax=above)
    # All are passed on: the last bar adds up those that are not drawn.
    names += [""] * (len(diagnosis.hypotheses) - len(listed))
    probabilities = [h.probability for h in (*listed, *diagnosis.hypotheses[len(listed) :])]
    hypothesis_probabilities(names, probabilities, most=most, ax=below)
    return axes


def _place_svg(diagnosis: Diagnosis, place: Place) -> bytes:
    """Draw the calibrated model's residuals in each view of a place: readings, means, the band of chance."""
    views = views_of_place(diagnosis, place)
    axes = stack_of_axes([2.4, 2.6][-len(views) :])
    for ax, view in zip(axes, views, strict=True):
        _draw_means_along(diagnosis, view, each=True, ax=ax)
    return svg(axes)


def _curve_svg(diagnosis: Diagnosis, curve: Effect) -> bytes:
    """Draw a curve of a column, about its mean over the rows: its median, and the band of 95 % of the samples."""
    plan, reading = cast(RunTable, diagnosis.recording.plan), diagnosis.recording.plan.instrumentation
    (name, column), samples = curve.name.split(":", 1), diagnosis.repaired.effect_samples(curve.name)
    at = plan.covariates[column]
    rows = np.argsort(at)[: np.count_nonzero(np.isfinite(at))]
    change = curve.apply(np.zeros((len(samples), len(plan))), samples, plan)[:, rows]
    low, middle, high = np.quantile(change - change.mean(axis=1, keepdims=True), [0.025, 0.5, 0.975], axis=0)
    (ax,) = stack_of_axes([2.6])
    ax.fill_between(at[rows], low, high, label="95 %", **FILLED)
    ax.plot(at[rows], middle, color=BLUE, label=f"{name} of {column}")
    ax.set(xlabel=axis_label(diagnosis, curve.covariates[0]), ylabel=f"added {reading.unit_after_number}".rstrip())
    ax.legend()
    return svg(ax)


def _draw_means_along(diagnosis: Diagnosis, view: CovariateView, *, each: bool, ax: Axes) -> None:
    """Draw mean residuals in a view: of the calibrated model with `each` reading, else of both models."""
    plots.mean_residuals_along(
        noise_of(diagnosis).means_in(view, after=not each),
        label=view.label,
        unit=diagnosis.recording.plan.instrumentation.unit_after_number,
        each=(view.at, diagnosis.before.residuals) if each else None,
        window=view.window,
        names=view.names,
        before=diagnosis.apparatus.words.before_in_words,
        after=diagnosis.after_in_words,
        ax=ax,
    )


def before_and_after(diagnosis: Diagnosis) -> AxesGrid:
    """Draw the scan that the repair changes most (else the longest): readings, one or both models, residuals below.

    Scans along a line come first. A random walk of the noise, as all readings show it, is part of both models' lines.
    """
    recording, plan = diagnosis.recording, diagnosis.recording.plan
    before, after = diagnosis.before, diagnosis.after
    change = after.readings_with_walk - before.readings_with_walk
    scans = [rows for rows in plan.rows_by_scan() if rows.size]
    lines = [rows for rows in scans if is_scan_along_line(plan, rows)]
    rows = max(lines or scans, key=lambda rows: (float(change[rows] @ change[rows]), rows.size))
    shown = view_along_scan(diagnosis, plan.scan_names[int(plan.scan[rows[0]])])
    rows = rows[np.argsort(shown.at[rows], kind="stable")]
    models = [(diagnosis.apparatus.words.before_in_words, before.readings_with_walk[rows])]
    if diagnosis.repair_changes_predictions:
        models += [(diagnosis.after_in_words, after.readings_with_walk[rows])]
    readings = np.where(recording.usable[rows], recording.readings[rows], np.nan)
    unit = plan.instrumentation.unit_after_number
    return plots.scan_with_residuals(
        shown.at[rows], readings, models, joined=is_scan_along_line(plan, rows), label=shown.label, unit=unit
    )


def _noise_tests_svg(diagnosis: Diagnosis) -> bytes:
    axes = stack_of_axes([2.2, 2.4, 2.2])
    for ax, name in zip(axes, ("correlated_noise", "signal_dependent_noise", "outliers"), strict=True):
        _draw_noise_panel(diagnosis, name, ax)
    return svg(axes)


def _draw_noise_panel(diagnosis: Diagnosis, name: str, ax: Axes) -> None:
    """Draw a noise effect's panel; for other names, spread by predicted reading."""
    recording, noise_sd = diagnosis.recording, noise_of(diagnosis).sd
    predicted, residuals, sd = diagnosis.after.readings, np.array(diagnosis.after.residuals), float(noise_sd.mean())
    unit = recording.plan.instrumentation.unit_after_number
    found = {p.name: p.mean for p in diagnosis.noise.parameters}
    # Lost readings carry no information on the noise of the others.
    if name != "dropouts" and "share" in found and "value" in found:
        lost = recording.usable & np.isclose(recording.readings, found["value"], atol=3 * sd)
        residuals[lost & (np.abs(residuals) > _LOST * sd)] = np.nan
    if name == "quantisation" and "step" in found:
        plots.readings_modulo_step(recording.readings, found["step"], unit=unit, ax=ax)
    elif name in ("correlated_noise", "random_walk"):
        walking = residuals + diagnosis.after.walk
        plots.residual_autocorrelation(walking, recording.plan.scan, rho=found.get("rho"), ax=ax)
    elif name in ("outliers", "dropouts"):
        plots.residual_histogram(residuals / noise_sd, 1.0, ax=ax)
    else:
        model_sd = noise_sd if np.ptp(noise_sd) > 0 else None
        plots.spread_by_level(predicted, residuals, unit=unit, model_sd=model_sd, ax=ax)
