"""Tests of the noise against white noise: autocorrelation, spread by predicted reading, tails, lost and rounded ones.

Residuals and predictions have the shape (n_points,), NaN where there is no usable reading; `unit` is the readings'.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.report.plots.canvas import BLACK, BLUE, GREY, VERMILLION, finish, stack_of_axes

_MOST_LAGS = 12
_STEPS = 12
_BINS = 41  # of the part of a rounding step: odd, so that rounded readings share the middle one
_SD_95 = 1.96
_WHITE = "95 % of white noise"


def residual_autocorrelation(
    residuals: FloatArray, scan: IntArray, *, rho: float | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the autocorrelation of residuals within scans at lags up to 12, with the 95 % band of white noise.

    `scan` holds scan numbers, (n_points,). Powers of `rho`, the estimated correlation of neighbours, are drawn too.
    """
    ax = ax if ax is not None else stack_of_axes([2.7])[0]
    lags = np.arange(1, min(_MOST_LAGS, max(len(residuals) // 4, 1)) + 1)
    variance = float(np.nanmean(residuals**2)) or 1.0
    correlation, chance = np.full(len(lags), np.nan), np.full(len(lags), np.nan)
    for k, lag in enumerate(lags):
        pairs = (residuals[lag:] * residuals[:-lag])[scan[lag:] == scan[:-lag]]
        pairs = pairs[np.isfinite(pairs)]
        if pairs.size:
            correlation[k], chance[k] = pairs.mean() / variance, _SD_95 / np.sqrt(pairs.size)
    ax.fill_between(lags, -chance, chance, color=GREY, alpha=0.3, linewidth=0, label=_WHITE)
    ax.axhline(0, color=BLACK, linewidth=0.7)
    ax.vlines(lags, 0, correlation, color=VERMILLION, linewidth=1.4)
    ax.plot(lags, correlation, "o", color=VERMILLION, markersize=5, label="residuals")
    if rho is not None:
        ax.plot(lags, rho**lags, "--", color=BLUE, linewidth=1.5, label=f"noise model found: {rho:.2f} per step")
    ax.set_xticks(lags)
    return finish(ax, x="how many readings apart (within a scan or run)", y="correlation (no unit)", plain="y")


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
    ax = ax if ax is not None else stack_of_axes([2.7])[0]
    ok = np.flatnonzero(np.isfinite(residuals) & np.isfinite(predicted))
    parts = np.array_split(ok[np.argsort(predicted[ok], kind="stable")], max(1, min(_STEPS, len(ok) // 8)))
    at = np.array([predicted[p].mean() for p in parts])
    rms = np.array([np.sqrt(np.mean(residuals[p] ** 2)) for p in parts])
    # The sd of an rms of n normal values is close to sd / sqrt(2 n).
    root = np.sqrt(2 * np.array([p.size for p in parts]))
    overall = float(np.sqrt(np.mean(residuals[ok] ** 2)))
    half = _SD_95 * overall / root
    ax.errorbar(at, rms, _SD_95 * rms / root, fmt="o", color=VERMILLION, capsize=3, label="residuals, 95 %")
    ax.fill_between(at, overall - half, overall + half, color=GREY, alpha=0.3, linewidth=0, label=_WHITE)
    if model_sd is not None:
        by_model = np.array([np.sqrt(np.mean(model_sd[p] ** 2)) for p in parts])
        ax.plot(at, by_model, "--", color=BLUE, linewidth=1.6, label="noise model found")
    ax.set_ylim(bottom=0.0)
    return finish(ax, x=f"predicted reading ({unit})", y=f"rms residual ({unit})")


def residual_histogram(residuals: FloatArray, sd: float, *, ax: Axes | None = None) -> Axes:
    """Draw a histogram of residuals in noise sds (`sd`, tails left out) on a log scale, with a normal distribution."""
    ax = ax if ax is not None else stack_of_axes([2.7])[0]
    z = residuals[np.isfinite(residuals)] / sd
    most = float(np.clip(np.abs(z).max(initial=4.0), 4.0, 30.0))
    edges = np.arange(-np.ceil(most), np.ceil(most) + 0.25, 0.5)
    counts = np.histogram(np.clip(z, edges[0], edges[-1]), edges)[0]
    ax.bar(edges[:-1] + 0.25, counts, 0.45, color=VERMILLION, label="residuals")
    at = np.linspace(-5, 5, 201)
    normal = len(z) * 0.5 * np.exp(-0.5 * at**2) / np.sqrt(2 * np.pi)
    ax.plot(at, normal, "--", color=BLACK, linewidth=1.4, label="normal distribution")
    ax.set_yscale("log")
    ax.set_ylim(0.5, 2 * max(float(counts.max(initial=1)), 1.0))
    return finish(ax, x="residual (sds of the noise)", y="readings per half sd", plain="x")


def lost_readings_against_predicted(
    predicted: FloatArray, readings: FloatArray, lost: BoolArray, *, unit: str, ax: Axes | None = None
) -> Axes:
    """Draw recorded against predicted readings, (n_points,) each; those where the mask `lost` is True are marked."""
    ax = ax if ax is not None else stack_of_axes([2.7])[0]
    ax.plot(predicted[~lost], readings[~lost], "o", color=GREY, markersize=3, label="reading")
    ax.plot(predicted[lost], readings[lost], "X", color=VERMILLION, markersize=7, label="lost reading")
    ax.axline((float(np.nanmean(predicted)),) * 2, slope=1, color=BLACK, linewidth=0.7)
    return finish(ax, x=f"predicted reading ({unit})", y=f"reading ({unit})")


def readings_modulo_step(readings: FloatArray, step: float, *, unit: str, ax: Axes | None = None) -> Axes:
    """Draw a histogram of readings' distances from the nearest multiple of `step`; rounded ones share one bin."""
    ax = ax if ax is not None else stack_of_axes([2.7])[0]
    finite = readings[np.isfinite(readings)]
    counts, edges = np.histogram(np.mod(finite / step + 0.5, 1.0) - 0.5, _BINS, (-0.5, 0.5))
    ax.bar((edges[:-1] + edges[1:]) / 2, counts, 0.9 / _BINS, color=VERMILLION, label="readings")
    ax.axhline(len(finite) / _BINS, color=GREY, linestyle="--", label="without rounding")
    return finish(ax, x=f"distance from a multiple of {step:.4g} {unit} (steps)", y="readings")
