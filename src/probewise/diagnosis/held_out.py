"""Gain on held-out readings. Whole parts are held out, since rows chosen at random would leak information."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.diagnosis.fit import Fit, fit, residual_degrees_of_freedom, with_prior
from probewise.diagnosis.noise import NoiseLaw, innovations_given_rest
from probewise.recordings.plan import Recording

LEAST_ROWS = 8
"""Least number of rows of a held-out part."""

MOST_PARTS = 10
"""Largest number of parts held out in turn."""

Parts = tuple[IntArray, tuple[str, ...]]
"""Part number of each usable reading, (n_usable,), -1 for one that is never held out, and the names of the parts."""

N_BLOCKS = 5
"""Number of parts of readings that have no scans or runs."""

_NO_DENSITY = -690.0  # log density of a reading for which a model predicts no number: that of 1e-300
_NO_SLOPE = 1e-6  # of a parameter's slope on its own readings: so little on others is rounding of predictions
_HARDLY_TOLD = 0.5  # variance of a coordinate given the other parts, of 1 before them


@dataclass(frozen=True)
class HeldOutGain:
    """Gain of a model over the null on held-out readings: mean in nats per reading, and the sd of that mean.

    `by_scan`: name and mean gain of each held-out part, such as a scan.
    """

    per_reading: float
    sd: float
    n_readings: int
    by_scan: tuple[tuple[str, float], ...]


def held_out_gain(
    null: Fit,
    repaired: Fit,
    recording: Recording,
    law: NoiseLaw,
    held_out: Parts,
    *,
    law_of_null: NoiseLaw,
    each_alone: bool = False,
) -> HeldOutGain:
    """Refit both models without one part of the readings at a time, and compare their log densities of that part.

    A held-out reading is predicted from the other parts alone. If the part has parameters of its own, which other parts
    do not determine, or if the noise has memory, its readings are predicted sequentially, each given those before it:
    together they have the joint density of the part given the rest, unless `each_alone` asks for what the rest tells of
    each: far from the rest, noise with memory is as wide as it is without. Parts of fewer than eight readings are not
    held out, and of more than ten parts only ten.

    `law`, `law_of_null`: noise distribution of the repaired model, and of the null; `held_out`: number of the part of
    each usable reading, and names of the parts.
    """
    usable, (parts, names) = recording.usable, held_out

    def log_densities(found: Fit, law: NoiseLaw, out: BoolArray) -> FloatArray:
        """Return the log predictive density of each held-out reading, from a refit to the others; 0 for lost readings.

        At an end of the range it is a log likelihood relative to its peak: 0 where the prediction is beyond the end.
        Lost readings (dropouts at one value) add the same to every model of the mean.
        """
        readings, rest = recording.readings.copy(), law.take_readings(~out)
        readings[np.flatnonzero(usable)[out]] = np.nan
        if not rest.n_kept:  # without them the noise sd, and so the density, is unknown
            return np.zeros(int(out.sum()))
        without = fit(found.model, recording.with_readings(readings), found.z, rest, max_steps=4, tolerance=0.05)
        of_its_own = are_of_part_alone(found.slopes, out)
        turned = np.where(of_its_own, 0.0, rest(without.slopes))
        # Parameters of the part alone are linearised about the fit to all readings: their prior may be wide, and the
        # other readings may bound them on one side only, as for a ceiling.
        about = np.where(of_its_own, found.z, without.z)
        predicted, slopes = (part[usable] for part in found.model.predict_and_differentiate(about))
        free = residual_degrees_of_freedom(turned, without.sd / math.sqrt(rest.fisher_information), rest.n_kept)
        sigma_2 = without.sd**2 * (1.0 if rest.flat else rest.n_kept / free)  # beside rounding it is known
        curvature = with_prior(turned.T @ turned * rest.fisher_information / sigma_2)
        covariance = np.asarray(np.linalg.inv(curvature), dtype=np.float64)
        # Of values with one scale in common, those of the other parts tell how large this part's is, not which it is.
        hardly_told = found.model.has_shared_scale & (np.diag(covariance) > _HARDLY_TOLD) & np.any(slopes[out], axis=0)
        sequential = not each_alone and bool(law.has_memory or (of_its_own | hardly_told).any())
        told = (law, out, recording.readings[usable] - predicted, slopes, without.z - about, covariance, sigma_2)
        return predictive_log_densities(*told, sequential=sequential)

    def gain_per_reading(out: BoolArray) -> FloatArray:
        with np.errstate(invalid="ignore"):  # without them a model may predict no number
            densities = (log_densities(repaired, law, out), log_densities(null, law_of_null, out))
            repaired_one, null_one = (np.where(np.isnan(each), _NO_DENSITY, each) for each in densities)
        return np.asarray(repaired_one - null_one)

    return mean_gain_over_parts(parts, gain_per_reading, names)


def partition_into_blocks(recording: Recording) -> Parts:
    """Partition usable readings into five parts: every fifth block of eight successive readings.

    Returns numbers (n_usable,) and names of the parts. An effect local in time cannot be predicted for another scan,
    but it can between known readings; a block is long enough that its middle is not adjacent to known readings.
    """
    block = np.arange(int(recording.usable.sum())) // LEAST_ROWS
    return block % N_BLOCKS, tuple(f"every fifth block of {LEAST_ROWS}, from {k + 1}" for k in range(N_BLOCKS))


def mean_gain_over_parts(
    scan: IntArray, gain: Callable[[BoolArray], FloatArray], scan_names: Sequence[str] = ()
) -> HeldOutGain:
    """Hold out one part at a time, at most ten, and average the gains of their readings.

    `scan`: number of the part of each usable reading, such as its scan, (n_usable,); `gain`: function of a mask of
    held-out readings (n_usable,); returns the gain of each of them, in nats. Returns the gain; no readings and gain 0
    if fewer than two parts are long enough, or none beside readings that are never held out.
    """
    long_enough = [int(k) for k in np.unique(scan) if k >= 0 and np.sum(scan == k) >= LEAST_ROWS]
    if len(long_enough) < (1 if np.any(scan < 0) else 2):
        return HeldOutGain(0.0, 0.0, 0, ())
    if len(long_enough) > MOST_PARTS:
        long_enough = [long_enough[int(i)] for i in np.linspace(0, len(long_enough) - 1, MOST_PARTS).round()]
    gains = [gain(np.asarray(scan == k)) for k in long_enough]
    by_scan = tuple(
        (scan_names[k] if scan_names else str(k), float(g.mean())) for k, g in zip(long_enough, gains, strict=True)
    )
    joined = np.concatenate(gains)
    sd = float(joined.std(ddof=1)) / math.sqrt(len(joined))
    return HeldOutGain(float(joined.mean()), sd, len(joined), by_scan)


def predictive_log_densities(
    law: NoiseLaw,
    out: BoolArray,
    miss: FloatArray,
    slopes: FloatArray,
    mean: FloatArray,
    covariance: FloatArray,
    sigma_2: float,
    *,
    sequential: bool = True,
) -> FloatArray:
    """Return the log density of each held-out reading from a linear model of the others, (n_out,); 0 for lost ones.

    `out`: mask of the held-out readings, (n_points,); `miss`, `slopes`: residuals of all readings, (n_points,), and
    slopes, (n_points, n_params), at one point; `mean`, `covariance`: of the coordinates about that point, from the
    readings that are not held out. If `sequential`, each is given those held out before it too: the sum is the log of
    the joint density. Of censored readings, densities are relative to the peak.
    """
    columns = np.concatenate([slopes, miss[:, None]], axis=1)
    whitened, sd = innovations_given_rest(law, columns, out, each_alone=not sequential)
    turned, innovations, kept, censored = whitened[:, :-1], whitened[:, -1], law.kept[out], law.is_censored[out]
    noise_2 = sigma_2 * (law.sd_with_rounding[out] / law.sd[out]) ** 2
    log_shares = np.log(np.maximum([1 - law.share, law.share], 1e-300))
    widths = np.tile([1.0, law.times**2], (len(sd), 1))
    if law.wide.size:  # variances, in units of sd^2, if each is narrow and if it is wide: it may be either
        own = law.sd[out] ** 2
        narrow = own * law.relative_precision[out]
        widths = np.stack([sd**2 - own + narrow, sd**2 - own + narrow * law.times**2], axis=1) / sd[:, None] ** 2

    def given(rows: slice, mean: FloatArray, gain: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return log densities, residuals, and most probable variances, (n_rows,) each; `gain` (n_rows, n_params)."""
        left, spread = innovations[rows] - turned[rows] @ mean, np.maximum(np.sum(turned[rows] * gain, axis=1), 0.0)
        parts = noise_2[rows, None] * widths[rows] + spread[:, None]
        at_zero = log_shares - 0.5 * np.log(2 * np.pi * parts)
        by_width = at_zero - 0.5 * left[:, None] ** 2 / parts
        density = np.logaddexp(*by_width.T)
        variance = np.sum(np.exp(by_width - density[:, None]) * parts, axis=1)
        unit = np.where(censored[rows], np.logaddexp(*at_zero.T), np.log(sd[rows]))
        return density - unit, left, variance

    if not sequential:
        return given(slice(None), mean, turned @ covariance)[0] * kept
    mean, covariance, densities = mean.copy(), covariance.copy(), np.zeros(len(innovations))
    for k in np.flatnonzero(kept).tolist():
        gain = covariance @ turned[k]
        densities[k], left, variance = (float(own[0]) for own in given(slice(k, k + 1), mean, gain[None]))
        mean += gain * left / variance
        covariance -= np.outer(gain, gain) / variance
    return densities


def are_of_part_alone(slopes: FloatArray, part: BoolArray) -> BoolArray:
    """Return which parameters change only the readings of a part, (n_params,), such as where its run starts.

    `slopes` are those of all readings, (n_readings, n_params), `part` is the mask of its readings.
    """
    here, elsewhere = (np.linalg.norm(slopes[rows], axis=0) for rows in (part, ~part))
    return np.asarray((here > 0.0) & (elsewhere <= _NO_SLOPE * here))
