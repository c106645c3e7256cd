"""Residuals of the calibrated and of the repaired model: along covariates, in one scan, by held-out part.

And tests of the noise against white noise: autocorrelation, spread by predicted reading, tails, rounding.
Residuals and predictions have the shape (n_points,), NaN where there is no usable reading; `unit` is the readings'.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from probewise._arrays import FloatArray, IntArray
from probewise.recordings import Recording
from probewise.recordings.plan import require_recording
from probewise.report.plots import canvas
from probewise.report.residual_means import ResidualMeans, groups_of_neighbours, rows_by_value
from probewise.report.words import number_text

_STYLES = ((canvas.VERMILLION, "o", "-"), (canvas.BLUE, "s", (0, (4, 1.5))))
_CROWDED = 500  # number of dots from which they are paler
_MANY = 1500  # number of dots from which they are an image inside the SVG
_MOST_LABELS = 24  # of categories on an axis
_MOST_SCANS = 12
_RUNNING_MEANS = 20
_MOST_LAGS = 12
_STEPS = 12
_BINS = 41  # of the part of a rounding step: odd, so that rounded readings share the middle one
_SD_95 = 1.96
_WHITE = "95 % of white noise"


def draw_running_mean(ax: Axes, x: FloatArray, y: FloatArray, *, colour: str, line: Any = "-", name: str = "") -> None:
    """Draw means of y, (n,), over up to 20 groups of neighbours in x as a curve, named after the model `name`.

    Where x has few values, no curve joins them: each has its mean with the 95 % interval of that.
    """
    ok = np.isfinite(x) & np.isfinite(y)
    x, y = x[ok], y[ok]
    few = rows_by_value(x)
    groups = few or groups_of_neighbours(x, max(1, min(_RUNNING_MEANS, len(x) // 4)))
    at, means = (np.array([values[g].mean() for g in groups]) for values in (x, y))
    half = [_SD_95 * float(y[g].std()) / np.sqrt(g.size) for g in groups] if few else None
    style = {"fmt": "o", "capsize": 3} if few else {"linestyle": line}
    ax.errorbar(at, means, yerr=half, color=colour, label=f"means, {name}" if name else None, **style)


def mean_residuals_along(
    means: ResidualMeans,
    *,
    label: str,
    unit: str,
    each: tuple[FloatArray, FloatArray] | None = None,
    window: tuple[float, float] | None = None,
    names: Sequence[str] = (),
    before: str = "as calibrated",
    after: str = "repaired",
    ax: Axes | None = None,
) -> Axes:
    """Draw mean residuals against a covariate, the 95 % band of chance, and the interval that is significant.

    `each` holds covariate and residual of every reading, (n_points,) each, drawn as dots behind; `window` is the
    significant interval, shaded; `names` are those of the values 0, 1, 2 ... of a categorical covariate; `before` and
    `after` are the names of the two models.
    """
    ax = canvas.axes_or_new(ax)
    if each is not None:
        _draw_dots(ax, *each, canvas.GREY, "one reading")
    ax.axhline(0, **canvas.THIN)
    band: dict[str, Any] = {"color": canvas.GREY, "alpha": 0.3, "label": "95 % by chance alone"}
    if means.by_value:
        ax.errorbar(means.at, np.zeros(len(means.at)), yerr=means.chance, fmt="none", elinewidth=8, **band)
    else:
        ax.fill_between(means.at, -means.chance, means.chance, **band)
    mean = "mean, " if each is not None else ""
    line = "none" if means.by_value else "-"
    for values, (colour, marker, _), name in zip((means.before, means.after), _STYLES, (before, after), strict=True):
        if values is not None:
            ax.plot(means.at, values, marker=marker, linestyle=line, color=colour, label=f"{mean}{name}")
    if names:
        every = 1 + len(names) // _MOST_LABELS
        at = np.arange(len(names))[::every]
        ax.set_xticks(at, [name.replace("_", " ") for name in names[::every]], fontsize=canvas.SMALL_PT, rotation=30)
    if window is not None and means.is_largest_within(window):
        ax.axvspan(*window, color=canvas.SKY, alpha=0.25, label="stands out here", zorder=0)
    averaged = each is None and int(means.size.max(initial=1)) > 1
    y = f"{'mean residual' if averaged else 'residual'} ({unit})"
    return canvas.finish(ax, x=label, y=y, plain="y" if names else "both")


def scan_with_residuals(
    along: FloatArray,
    readings: FloatArray,
    models: Sequence[tuple[str, FloatArray]],
    *,
    joined: bool = True,
    label: str,
    unit: str,
) -> canvas.AxesGrid:
    """Draw the readings of one scan with each model's predictions, and below them the residuals; return the axes, (2,).

    `along`, `readings` and the predictions of the `models` (name and predictions, the calibrated model first) have the
    shape (n_rows,), NaN where there is no usable reading. Without `joined`, no curve joins the rows.
    """
    above, below = axes = canvas.stack_of_axes([2.5, 2.0])
    above.plot(along, readings, "o", color=canvas.BLACK, markersize=3, alpha=0.7, label="recorded")
    below.axhline(0, **canvas.THIN)
    for (name, predicted), (colour, marker, line) in zip(models, _STYLES, strict=False):
        style = {"linestyle": line} if joined else {"linestyle": "none", "marker": marker}
        above.plot(along, predicted, color=colour, label=f"predicted, {name}", **style)
        below.plot(along, readings - predicted, marker, color=colour, ms=3, alpha=0.5, label=f"residual, {name}")
        if joined:
            draw_running_mean(below, along, readings - predicted, colour=colour, line=line)
    below.sharex(above)
    canvas.finish(above, x="", y=f"reading ({unit})")
    canvas.finish(below, x=label, y=f"residual ({unit})")
    return axes


def readings_in_order(recording: Recording, *, ax: Axes | None = None) -> Axes:
    """Draw usable readings by reading number, for recordings too short for any other figure."""
    require_recording(recording)
    ax = canvas.axes_or_new(ax)
    usable = np.flatnonzero(recording.usable)
    ax.plot(usable + 1, recording.readings[usable], "o", color=canvas.BLUE, markersize=5)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    return canvas.finish(ax, x="reading number", y=f"reading ({recording.plan.instrumentation.unit_after_number})")


def residuals_against_covariates(
    covariates: Sequence[tuple[str, FloatArray]], models: Sequence[tuple[str, FloatArray]], *, unit: str
) -> canvas.AxesGrid:
    """Draw all residuals against each covariate, with running means, one panel per covariate; return the axes, (n,).

    `covariates` are labels and values, `models` names and residuals, (n_points,), the calibrated model first.
    """
    axes = canvas.stack_of_axes([2.2] * len(covariates))
    for ax, (label, at) in zip(axes, covariates, strict=True):
        ax.axhline(0, **canvas.THIN)
        for (name, residuals), (colour, _, line) in zip(models, _STYLES, strict=False):
            _draw_dots(ax, at, residuals, colour, "")
            draw_running_mean(ax, at, residuals, colour=colour, line=line, name=name)
        canvas.finish(ax, x=label, y=f"residual ({unit})")
    return axes


def heldout_gain_by_scan(
    scans: Sequence[tuple[str, float]], mean: float, sd: float, *, part: str = "scan", ax: Axes | None = None
) -> Axes:
    """Draw the gain on each held-out scan in nats per reading, largest on top, and the mean with its standard error.

    `scans` are names and gains; of more than twelve, only the six largest and the six smallest gains are drawn. `mean`
    and `sd` are over all held-out readings; `part` is the name of a held-out unit.
    """
    ranked = sorted(scans, key=lambda pair: -pair[1])
    if len(ranked) > _MOST_SCANS:
        ranked = [*ranked[: _MOST_SCANS // 2], *ranked[-_MOST_SCANS // 2 :]]
    ax = canvas.axes_or_new(ax, size_in=(canvas.PANEL_IN, 1.0 + 0.28 * max(len(ranked), 3)))
    gains = np.array([gain for _, gain in ranked])
    at = -np.arange(len(ranked), dtype=np.float64)
    ax.barh(at, gains, 0.62, color=[canvas.BLUE if gain >= 0 else canvas.VERMILLION for gain in gains])
    ax.axvspan(mean - sd, mean + sd, zorder=0, **canvas.BAND)
    total = f"all {part}s: {number_text(mean, 3)} ± {number_text(sd, 3)} nats per reading"
    ax.axvline(mean, color=canvas.GREY, linewidth=1.4, label=total)
    ax.axvline(0, **canvas.THIN)
    ax.set_yticks(at, [name.replace("_", " ") for name, _ in ranked])
    ax.set_ylim(min(at[-1], -2.0) - 0.6, 0.6)
    return canvas.finish(ax, x=f"gain on each held-out {part} (nats per reading)", y=f"held-out {part}", plain="x")


def recorded_against_predicted(
    readings: FloatArray, predicted: FloatArray, sd: FloatArray, *, label: str, unit: str, ax: Axes | None = None
) -> Axes:
    """Draw each reading (NaN: none) against its prediction, with one sd of a new reading, (n_points,) each.

    Where nothing was read, the predictions are drawn row by row. `label` and `unit` are those of the readings.
    """
    there = np.isfinite(readings)
    label += "" if f"[{unit}]" in label else f" ({unit})"
    if not there.any():
        ax = canvas.axes_or_new(ax)
        ax.errorbar(np.arange(len(predicted)), predicted, yerr=_SD_95 * sd, fmt="o", ms=3, lw=0.8, color=canvas.BLUE)
        return canvas.finish(ax, x="row, from 0", y=f"predicted {label}, 95 %", plain="y")
    ax = canvas.axes_or_new(ax, size_in=(canvas.PANEL_IN, 4.2))
    x, y = predicted[there], readings[there]
    ax.errorbar(x, y, yerr=sd[there], fmt="o", ms=3, lw=0.8, color=canvas.BLUE, alpha=0.6, label="readings, ± 1 sd")
    ends = [min(x.min(), y.min()), max(x.max(), y.max())]
    ax.plot(ends, ends, color=canvas.BLACK, lw=0.9, label="as predicted")
    return canvas.finish(ax, x=f"predicted {label}", y=f"recorded {label}", plain=None)


def _draw_dots(ax: Axes, x: FloatArray, y: FloatArray, colour: str, label: str) -> None:
    ok = np.isfinite(x) & np.isfinite(y)
    n = max(int(ok.sum()), 1)
    size, alpha = float(np.clip(4000 / n, 4, 16)), 0.35 if n > _CROWDED else 0.7
    ax.scatter(x[ok], y[ok], size, color=colour, alpha=alpha, linewidth=0, label=label or None, rasterized=n > _MANY)


def residual_autocorrelation(
    residuals: FloatArray, scan: IntArray, *, rho: float | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the autocorrelation of residuals within scans at lags up to 12, with the 95 % band of white noise.

    `scan` holds scan numbers, (n_points,). Powers of `rho`, the estimated correlation of neighbours, are drawn too.
    """
    ax = canvas.axes_or_new(ax)
    in_order = np.argsort(scan, kind="stable")  # runs may be interleaved
    residuals, scan = residuals[in_order], scan[in_order]
    lags = np.arange(1, min(_MOST_LAGS, max(len(residuals) // 4, 1)) + 1)
    variance = float(np.nanmean(residuals**2)) or 1.0
    correlation, chance = np.full(len(lags), np.nan), np.full(len(lags), np.nan)
    for k, lag in enumerate(lags):
        pairs = (residuals[lag:] * residuals[:-lag])[scan[lag:] == scan[:-lag]]
        pairs = pairs[np.isfinite(pairs)]
        if pairs.size:
            correlation[k], chance[k] = pairs.mean() / variance, _SD_95 / np.sqrt(pairs.size)
    ax.fill_between(lags, -chance, chance, label=_WHITE, **canvas.BAND)
    ax.axhline(0, **canvas.THIN)
    ax.vlines(lags, 0, correlation, color=canvas.VERMILLION, linewidth=1.4)
    ax.plot(lags, correlation, "o", color=canvas.VERMILLION, markersize=5, label="residuals")
    if rho is not None:
        ax.plot(lags, rho**lags, "--", color=canvas.BLUE, linewidth=1.5, label=f"noise model found: {rho:.2f} per step")
    ax.set_xticks(lags)
    return canvas.finish(ax, x="how many readings apart (within a scan or run)", y="correlation (no unit)", plain="y")


def spread_by_level(
    predicted: FloatArray,
    residuals: FloatArray,
    *,
    unit: str,
    model_sd: FloatArray | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the rms of residuals by predicted reading, in bins of equal numbers, with the band expected of white noise.

    `model_sd`, (n_points,), is the noise sd of each reading under the noise model, which is drawn too.
    """
    ax = canvas.axes_or_new(ax)
    ok = np.flatnonzero(np.isfinite(residuals) & np.isfinite(predicted))
    parts = [ok[group] for group in groups_of_neighbours(predicted[ok], max(1, min(_STEPS, len(ok) // 8)))]
    at = np.array([predicted[p].mean() for p in parts])
    rms = np.array([np.sqrt(np.mean(residuals[p] ** 2)) for p in parts])
    # The sd of an rms of n normal values is close to sd / sqrt(2 n).
    root = np.sqrt(2 * np.array([p.size for p in parts]))
    overall = float(np.sqrt(np.mean(residuals[ok] ** 2)))
    half = _SD_95 * overall / root
    ax.errorbar(at, rms, _SD_95 * rms / root, fmt="o", color=canvas.VERMILLION, capsize=3, label="residuals, 95 %")
    ax.fill_between(at, overall - half, overall + half, label=_WHITE, **canvas.BAND)
    if model_sd is not None:
        by_model = np.array([np.sqrt(np.mean(model_sd[p] ** 2)) for p in parts])
        ax.plot(at, by_model, "--", color=canvas.BLUE, linewidth=1.6, label="noise model found")
    ax.set_ylim(bottom=0.0)
    return canvas.finish(ax, x=f"predicted reading ({unit})", y=f"rms residual ({unit})")


def residual_histogram(residuals: FloatArray, sd: float, *, ax: Axes | None = None) -> Axes:
    """Draw a histogram of residuals in noise sds (`sd`, tails left out) on a log scale, with a normal distribution."""
    ax = canvas.axes_or_new(ax)
    z = residuals[np.isfinite(residuals)] / sd
    most = float(np.clip(np.abs(z).max(initial=4.0), 4.0, 30.0))
    edges = np.arange(-np.ceil(most), np.ceil(most) + 0.25, 0.5)
    counts = np.histogram(np.clip(z, edges[0], edges[-1]), edges)[0]
    ax.bar(edges[:-1] + 0.25, counts, 0.45, color=canvas.VERMILLION, label="residuals")
    at = np.linspace(-5, 5, 201)
    normal = len(z) * 0.5 * np.exp(-0.5 * at**2) / np.sqrt(2 * np.pi)
    ax.plot(at, normal, "--", color=canvas.BLACK, linewidth=1.4, label="normal distribution")
    canvas.use_log_scale(ax, ticks=(1.0, 3.0))
    ax.set_ylim(0.5, 2 * max(float(counts.max(initial=1)), 1.0))
    return canvas.finish(ax, x="residual (sds of the noise)", y="readings per half sd", plain="x")


def readings_modulo_step(readings: FloatArray, step: float, *, unit: str, ax: Axes | None = None) -> Axes:
    """Draw a histogram of readings' distances from the nearest multiple of `step`; rounded ones share one bin."""
    ax = canvas.axes_or_new(ax)
    finite = readings[np.isfinite(readings)]
    counts, edges = np.histogram(np.mod(finite / step + 0.5, 1.0) - 0.5, _BINS, (-0.5, 0.5))
    ax.bar((edges[:-1] + edges[1:]) / 2, counts, 0.9 / _BINS, color=canvas.VERMILLION, label="readings")
    ax.axhline(len(finite) / _BINS, color=canvas.GREY, linestyle="--", label="without rounding")
    return canvas.finish(ax, x=f"distance from a multiple of {step:.4g} {unit} (steps)", y="readings")
