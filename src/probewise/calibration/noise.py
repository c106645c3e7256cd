"""Posterior of the noise sd of a calibration: of each scan, and pooled over scans for new readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammainc, gammaincinv

from probewise._arrays import FloatArray, IntArray
from probewise.errors import ParameterError, ShapeError


@dataclass(frozen=True)
class ScanNoise:
    """Noise of one scan: number of readings, posterior mean and sd of the noise sd, in the reading's unit."""

    scan: str
    n_readings: int
    mean: float
    sd: float


def draw_sd(
    sum_of_squares: FloatArray, n_readings: int, *, sd_floor: float, sd_ceiling: float, rng: np.random.Generator
) -> FloatArray:
    """Draw the sd of Gaussian noise given residuals, under the bounded 1/sd prior of the Student-t likelihood.

    The posterior is sd^(-1 - n) exp(-Q / (2 sd^2)) on [floor, ceiling], so Q / (2 sd^2) follows a
    truncated gamma distribution of shape n / 2, which is drawn by its quantile function.

    `sum_of_squares` is Q, of `n_readings` residuals, of each hypothesis, (n_samples,); the bounds of the prior are in
    the reading's unit. Return one sd for each hypothesis, (n_samples,). ParameterError if `n_readings` is below 1 or
    the bounds are not 0 < floor < ceiling.
    """
    if n_readings < 1:
        raise ParameterError("n_readings", n_readings, "1 or more")
    if not 0 < sd_floor < sd_ceiling < np.inf:
        raise ParameterError("(sd_floor, sd_ceiling)", (sd_floor, sd_ceiling), "0 < floor < ceiling, finite")
    shape = n_readings / 2
    # At Q = 0 the posterior is concentrated at the floor, as for tiny residuals.
    q = np.maximum(sum_of_squares, n_readings * (1e-6 * sd_floor) ** 2)
    least, most = q / (2 * sd_ceiling**2), q / (2 * sd_floor**2)
    low, high = gammainc(shape, least), gammainc(shape, most)
    drawn = gammaincinv(shape, low + (high - low) * rng.random(q.shape))
    # Where the interval lies in a tail too thin for the incomplete gamma, use the nearer bound.
    thin = ~(high - low > 1e-280) | ~np.isfinite(drawn) | (drawn <= 0)
    at_bound = np.where(most < shape, sd_floor, sd_ceiling)
    with np.errstate(divide="ignore", invalid="ignore"):
        sd = np.sqrt(q / (2 * drawn))
    return np.clip(np.where(thin, at_bound, sd), sd_floor, sd_ceiling)


def draw_pooled_sd(
    residuals: FloatArray, *, sd_floor: float, sd_ceiling: float, rng: np.random.Generator
) -> FloatArray:
    """Draw one noise sd per sample, (n_samples,), from the residuals of all scans: the noise of a new scan.

    `residuals`: reading minus prediction of the usable rows, (n_samples, n_points); see `draw_sd`.
    """
    total = np.einsum("sp,sp->s", residuals, residuals)
    return draw_sd(total, residuals.shape[1], sd_floor=sd_floor, sd_ceiling=sd_ceiling, rng=rng)


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

    `residuals`: reading minus prediction of the usable rows, (n_samples, n_points); `scan`: data set of each row, an
    index into `scan_names`, (n_points,), else ShapeError.
    """
    if residuals.shape[1:] != scan.shape:
        raise ShapeError(
            f"residuals have shape {residuals.shape}; allowed: (n_samples, {scan.size}), one per row of scan"
        )
    out = []
    for k, name in enumerate(scan_names):
        rows = residuals[:, scan == k]
        if rows.shape[1]:
            sd = draw_pooled_sd(rows, sd_floor=sd_floor, sd_ceiling=sd_ceiling, rng=rng)
            out.append(ScanNoise(name, rows.shape[1], float(sd.mean()), float(sd.std())))
    return tuple(out)
