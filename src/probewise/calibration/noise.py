"""Posterior of the noise sd of a calibration: of each scan, and pooled over scans for new readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammainc, gammaincinv

from probewise._arrays import FloatArray, IntArray


@dataclass(frozen=True)
class ScanNoise:
    """Noise of one scan: number of readings, posterior mean and sd of the noise sd, in the reading's unit."""

    scan: str
    n_readings: int
    mean: float
    sd: float


def draw_sd(residuals: FloatArray, *, sd_floor: float, sd_ceiling: float, rng: np.random.Generator) -> FloatArray:
    """Draw the sd of Gaussian noise given residuals, under the bounded 1/sd prior of the Student-t likelihood.

    The posterior is sd^(-1 - n) exp(-Q / (2 sd^2)) on [floor, ceiling], so Q / (2 sd^2) follows a
    truncated gamma distribution of shape n / 2, which is drawn by its quantile function.

    `residuals`: reading minus prediction of the usable rows, one or more, by each hypothesis, (n_samples, n_points); Q
    is their sum of squares. The bounds are in the reading's unit. Return one sd for each hypothesis, (n_samples,).
    """
    n_readings = residuals.shape[1]
    shape = n_readings / 2
    # At Q = 0 the posterior is concentrated at the floor, as for tiny residuals.
    q = np.maximum(np.einsum("sp,sp->s", residuals, residuals), n_readings * (1e-6 * sd_floor) ** 2)
    least, most = q / (2 * sd_ceiling**2), q / (2 * sd_floor**2)
    low, high = gammainc(shape, least), gammainc(shape, most)
    drawn = gammaincinv(shape, low + (high - low) * rng.random(q.shape))
    # Where the interval lies in a tail too thin for the incomplete gamma, use the nearer bound.
    thin = ~(high - low > 1e-280) | ~np.isfinite(drawn) | (drawn <= 0)
    at_bound = np.where(most < shape, sd_floor, sd_ceiling)
    with np.errstate(divide="ignore", invalid="ignore"):
        sd = np.sqrt(q / (2 * drawn))
    return np.clip(np.where(thin, at_bound, sd), sd_floor, sd_ceiling)


def noise_by_scan(
    residuals: FloatArray,
    scan: IntArray,
    scan_names: tuple[str, ...],
    *,
    sd_floor: float,
    sd_ceiling: float,
    rng: np.random.Generator,
) -> tuple[ScanNoise, ...]:
    """Summarise the posterior of every scan's noise sd, in the order of the scans; scans without rows are left out.

    `residuals` as of `draw_sd`; `scan`: data set of each row, an index into `scan_names`, (n_points,).
    """
    out = []
    for k, name in enumerate(scan_names):
        rows = residuals[:, scan == k]
        if rows.shape[1]:
            sd = draw_sd(rows, sd_floor=sd_floor, sd_ceiling=sd_ceiling, rng=rng)
            out.append(ScanNoise(name, rows.shape[1], float(sd.mean()), float(sd.std())))
    return tuple(out)
