"""The page of a calibration: the SSF that the evidence favours, and how well it predicts."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import PurePath

import numpy as np

from probewise._words import count_with_noun, unit_after_number
from probewise._writing import Output
from probewise.calibration import Calibration, FittedSensor, predict, write_sensor
from probewise.recordings import Prediction, Recording
from probewise.report.html import Markup, Section, figures, notes_in_words, page, seed_fact, table
from probewise.report.plots.canvas import AxesGrid, png
from probewise.report.plots.readings import (
    predicted_and_recorded_by_scan,
    readings_by_orientation,
    standardised_residuals,
)
from probewise.report.plots.ssf import spatial_sensitivity, ssf_by_n_gaussians
from probewise.report.words import (
    decimals_to_show,
    number_text,
    typeset_numbers,
    value_and_interval_texts,
    value_with_error,
    words_without_unit,
)

_CAPTIONS = {
    "ssf.png": "Spatial sensitivity function (SSF): how much each point below the sensor counts in a reading. White "
    "lines: a half and a tenth of the peak; white cross: the package's centre.",
    "ssf_by_order.png": "Mean SSF of each number of Gaussians, in the sensor frame seen from above. White lines: a "
    "half and a tenth of the peak; white cross: the package's centre.",
    "readings.png": "Readings as recorded, along the scans; single readings are below.",
    "predicted.png": "Recorded readings, and what the model predicts.",
    "residuals.png": "Standardised residuals in the order of the readings; 95 % should lie between the dashed lines.",
}
_SSF = (
    "Posterior of the SSF's centre (u along x', v along y'), of its sds along its long and its short axis, and of the "
    "angle of the long axis from the x' axis, anticlockwise."
)


def summary_sentence(sensor: FittedSensor) -> str:
    """Summarise a calibration: number of Gaussians, lead in ln Z over the next best, SSF's centre and sds, noise."""
    n = sensor.n_gaussians
    said = f"The evidence favours {count_with_noun(n, 'Gaussian')}"
    others = sorted((o for o in sensor.orders if o.n_gaussians != n), key=lambda o: -o.log_z)
    if others:
        chosen = next(o for o in sensor.orders if o.n_gaussians == n)
        lead = chosen.log_z - others[0].log_z
        error = math.hypot(chosen.log_z_error, others[0].log_z_error)
        said += f", ahead of {others[0].n_gaussians} by {value_with_error(lead, error)} in ln Z"
    short, long = np.sqrt(np.maximum(np.linalg.eigvalsh(sensor.field.cov_mm2), 0)).tolist()
    digits, noise_sd = decimals_to_show(long, 1), float(sensor.noise_sd.mean())
    u, v = (number_text(float(at), digits) for at in sensor.field.mean_mm)
    return (
        f"{said}: centred at ({u}, {v}) mm on the sensor, "
        f"{number_text(long, digits)} by {number_text(short, digits)} mm (sd), "
        f"noise {number_text(noise_sd, decimals_to_show(noise_sd, 2))} "
        f"{sensor.instrumentation.unit_after_number} per reading."
    )


def figure_drawers(
    calibration: Calibration, recording: Recording, prediction: Prediction
) -> dict[str, Callable[[], bytes]]:
    """List the figures of a calibration by file name: functions that draw them, as PNGs."""
    mean, sd = prediction.mean, prediction.sd
    return {
        "readings.png": lambda: png(readings_by_orientation(recording)),
        "predicted.png": lambda: png(predicted_and_recorded_by_scan(recording, mean, sd)),
        "residuals.png": lambda: png(standardised_residuals(recording, mean, sd)),
        "ssf.png": lambda: png(spatial_sensitivity(calibration.sensor.field)),
        "ssf_by_order.png": lambda: png(draw_ssf_by_n_gaussians(calibration)),
    }


def draw_ssf_by_n_gaussians(calibration: Calibration) -> AxesGrid:
    """Draw the mean SSF for each number of Gaussians, with its evidence; return the axes, (n_rows, 1 or 2)."""
    return ssf_by_n_gaussians(
        calibration.fields,
        {o.n_gaussians: o.log_z for o in calibration.orders},
        {o.n_gaussians: o.log_z_error for o in calibration.orders},
    )


def evidence_table(sensor: FittedSensor) -> Markup:
    """Build a calibration's table by number of Gaussians: ln Z ± error, ln Z below the best, number of parameters."""
    best = max((o.log_z for o in sensor.orders), default=0.0)
    return table(
        ("Gaussians", "ln Z", "below the best", "parameters (with I_min, I_max)"),
        (
            (
                str(o.n_gaussians),
                value_with_error(o.log_z, o.log_z_error),
                number_text(best - o.log_z, 2),
                f"{o.n_ssf_parameters} ({o.n_parameters})",
            )
            for o in sensor.orders
        ),
        caption="Natural log of the evidence with its standard error.",
    )


def parameter_table(sensor: FittedSensor) -> Markup:
    """Build the table of a fitted sensor model's parameters: posterior medians and 95 % intervals."""
    median, ends = sensor.median(), sensor.interval()
    rows = [(n, sensor.unit_of_parameter(n), median[n], ends[n]) for n in sensor.names]
    caption = (
        "Posterior of the model's parameters. The covariance of Gaussian n is half the inverse of [[A, C], [C, B]]."
    )
    return _posterior_table("parameter", rows, caption)


def _posterior_table(first: str, rows: Iterable[tuple[str, str, float, tuple[float, float]]], caption: str) -> Markup:
    cells = [(name, _printed_unit(unit), *value_and_interval_texts(value, *ends)) for name, unit, value, ends in rows]
    return table((first, "unit", "median", "95 % interval"), cells, caption=caption)


def _printed_unit(unit: str) -> str:
    """Return a unit as the report prints it: "mm⁻²" for "mm^-2", nothing for "1", else `unit_name`."""
    return {"mm^-2": "mm⁻²", "1": ""}.get(unit, unit_after_number(unit))


def sections(
    sensor: FittedSensor, recording: Recording, prediction: Prediction, drawn: Mapping[str, bytes], *, seed: int | None
) -> list[Section]:
    """Build the sections of a calibration's page, below the first screen; `drawn` is from `figure_drawers`."""
    ok, shown = recording.usable, figures(drawn, _CAPTIONS)
    z = (recording.readings[ok] - prediction.mean[ok]) / prediction.sd[ok]
    chi_square = (
        f"Chi-square per reading is {number_text(float(np.mean(z**2)), 3)} over "
        f"{count_with_noun(int(ok.sum()), 'reading')} "
        "(near 1 where the model and its noise are right; they were fitted, so a little below)."
    )
    own = {"reading": sensor.instrumentation.unit}  # a prior's unit is that of the table of parameters
    priors = (
        (p.parameter, _printed_unit(own.get(p.unit, p.unit)), *map(typeset_numbers, (p.distribution, p.reason)))
        for p in sensor.priors
    )
    run = {
        "recording": PurePath(sensor.source).name or "unnamed",
        "its fingerprint": sensor.fingerprint,
        **seed_fact(seed),
        "version": f"probewise {sensor.version}",
    }
    of_ssf = ((words_without_unit(q.name), q.unit, q.median, q.interval95) for q in sensor.ssf_quantities())
    parameters = (_posterior_table("SSF", of_ssf, _SSF), parameter_table(sensor), *notes_in_words(sensor.notes))
    return [
        Section("Which number of Gaussians", (shown["ssf_by_order.png"], evidence_table(sensor))),
        Section("Readings", (shown["readings.png"], *notes_in_words(recording.notes))),
        Section("Predicted against recorded", (shown["predicted.png"], chi_square, shown["residuals.png"])),
        Section("Parameters", parameters),
        Section("Prior", (table(("parameter", "unit", "prior", "why"), priors),)),
        Section("This run", (run,)),
    ]


def page_html(
    calibration: Calibration,
    recording: Recording,
    prediction: Prediction,
    drawn: Mapping[str, bytes],
    *,
    seed: int | None,
) -> str:
    """Return the HTML of a calibration's page; `drawn` is from `figure_drawers`."""
    return page(
        f"Calibration of {PurePath(calibration.sensor.source).name or 'a sensor'}",
        answer=summary_sentence(calibration.sensor),
        key_figure=figures(drawn, _CAPTIONS)["ssf.png"],
        sections=sections(calibration.sensor, recording, prediction, drawn, seed=seed),
    )


def output_of(value: Calibration, *, seed: int | None = None) -> Output:
    """Return what is written of a calibration: sensor.json, figures, page; `seed` is stated if known."""
    prediction = predict(value.sensor, value.recording)
    return Output(
        lambda stage: write_sensor(value.sensor, stage / "sensor.json"),
        figure_drawers(value, value.recording, prediction),
        lambda drawn: page_html(value, value.recording, prediction, drawn, seed=seed),
        main="sensor.json",
    )
