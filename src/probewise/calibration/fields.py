"""What a posterior says of the spatial sensitivity function (SSF): its moments and its mean as a field; and of noise.

Paper, section 2.7: the weighted mean of sampled SSF fields.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammainc, gammaincinv

from probewise._arrays import FloatArray, IntArray
from probewise.errors import ShapeError, require
from probewise.sensor import Footprint, SSFField, footprint_of, mean_ssf_field

_SIGMAS = 5.0
_MOST_PIXELS_A_SIDE = 301
# The sum over pixels of width p is a trapezoidal or midpoint rule in the distance to an edge (depending on whether the
# edge halves a pixel or lies between two): its error is at most p^2 / 12 times the greatest slope of the profile of a
# footprint of sd s, 0.242 / s^2. With 4.5 pixels per sd that is 1.0e-3 of I_max - I_min.
_PIXELS_PER_SD = 4.5
_LEAST_SHARE = 0.05


def mixture_moments(theta: FloatArray, n_gaussians: int) -> dict[str, FloatArray]:
    """Compute centre, widths and correlation of the whole SSF of each sample.

    `theta` are parameters, (n_samples, at least 6 N). Return a dict of arrays (n_samples,): "centre x'", "centre y'"
    (mm), "log width along x'", "log width along y'" (natural log of the sd in mm), and "correlation of x' and y'".
    """
    u, v, var_u, var_v, cov = _moments_of_whole_footprint(footprint_of(theta[:, : 6 * n_gaussians], n_gaussians))
    return {
        "centre x'": u,
        "centre y'": v,
        "log width along x'": np.log(var_u) / 2,
        "log width along y'": np.log(var_v) / 2,
        "correlation of x' and y'": cov / np.sqrt(var_u * var_v),
    }


def _moments_of_whole_footprint(f: Footprint) -> tuple[FloatArray, ...]:
    """Compute the moments of the whole mixture, (n_samples,) each: u, v, var u, var v, covariance."""
    u, v = ((f.weight * centre).sum(axis=-1)[:, 0] for centre in (f.u_mm, f.v_mm))
    du, dv = f.u_mm[:, 0] - u[:, None], f.v_mm[:, 0] - v[:, None]
    spread = ((f.var_u, du * du), (f.var_v, dv * dv), (f.cov_uv, du * dv))
    return u, v, *((f.weight[:, 0] * (own[:, 0] + off)).sum(axis=-1) for own, off in spread)


def gaussians_sorted_by_mass(theta: FloatArray, n_gaussians: int) -> FloatArray:
    """Sort the Gaussians of each sample, (n_samples, at least 6 N), by decreasing mass; return sorted samples.

    Field and predictions do not change. The prior is exchangeable, so the labels of a posterior sample are arbitrary;
    sorted by mass, means and intervals of single columns are meaningful.
    """
    order = np.argsort(-footprint_of(theta[:, : 6 * n_gaussians], n_gaussians).weight[:, 0], axis=1, kind="stable")
    out = theta.copy()
    blocks = theta[:, : 6 * n_gaussians].reshape(len(theta), n_gaussians, 6)
    out[:, : 6 * n_gaussians] = np.take_along_axis(blocks, order[:, :, None], axis=1).reshape(len(theta), -1)
    return out


def choose_pixel_mm(theta: FloatArray, n_gaussians: int, *, step_mm: float) -> float:
    """Choose the pixel size of the mean field in mm: 1, or finer where scan step or footprint require it.

    It is at most the scan step and 1/4.5 of the sd of the narrowest Gaussian that holds a twentieth of the mass (median
    over the samples), so that the sum over pixels errs by at most a thousandth of I_max - I_min; rounded down to 1,
    0.5, 0.2 or 0.1 times a power of ten.

    `theta` are posterior samples, (n_samples, at least 6 N); `step_mm` is the scan step.
    """
    f = footprint_of(theta[:, : 6 * n_gaussians], n_gaussians)
    # The smaller eigenvalue of the covariance, as a quotient that keeps its digits.
    middle, half = (f.var_u + f.var_v) / 2, np.hypot((f.var_u - f.var_v) / 2, f.cov_uv)
    narrow = np.sqrt((f.var_u * f.var_v - f.cov_uv**2) / (middle + half))
    narrowest = np.where(f.weight >= _LEAST_SHARE, narrow, np.inf).min(axis=(1, 2))
    wanted = min(1.0, step_mm, float(np.median(narrowest)) / _PIXELS_PER_SD)
    decade = 10.0 ** math.ceil(math.log10(wanted) - 1e-9)
    return next(s * decade for s in (1.0, 0.5, 0.2, 0.1) if s * decade <= wanted * (1 + 1e-9))


def posterior_mean_ssf_field(
    theta: FloatArray, n_gaussians: int, *, pixel_mm: float = 1.0, weight: FloatArray | None = None
) -> SSFField:
    """Average the SSF fields of weighted samples on square pixels, centred on multiples of their width.

    Parameters
    ----------
    theta
        Samples, (n_samples, at least 6 N), columns a_1, u_1, v_1, A_1, B_1, C_1, ...
    n_gaussians
        Order N.
    pixel_mm
        Width of a pixel; enlarged for a footprint that would need more than 301 per side.
    weight
        Posterior weights, (n_samples,); by default equal. The samples with the last thousandth are left out.

    Returns
    -------
    SSFField
        The mean of the fields, not the field of the mean parameters. It extends five sds beyond all centres except the
        outermost thousandth of the mass.
    """
    require(pixel_mm > 0 and math.isfinite(pixel_mm), "pixel_mm", pixel_mm, "greater than 0")
    weight = np.full(len(theta), 1 / len(theta)) if weight is None else weight / weight.sum()
    if weight.shape != (len(theta),):
        raise ShapeError(f"weight has shape {weight.shape}; allowed: ({len(theta)},), one per sample")
    # The samples with the last thousandth of the weight would cost most of the time and change nothing.
    order = np.argsort(-weight)
    kept = order[: int(np.searchsorted(np.cumsum(weight[order]), 0.999)) + 1]
    f, shares = footprint_of(theta[kept, : 6 * n_gaussians], n_gaussians), weight[kept]
    mass = shares[:, None, None] * f.weight
    # Five sds beyond all centres, without the outermost thousandth of the mass at each end.
    ends = [
        (-_mass_quantile_999(_SIGMAS * sd - centre, mass), _mass_quantile_999(centre + _SIGMAS * sd, mass))
        for centre, sd in ((f.u_mm, np.sqrt(f.var_u)), (f.v_mm, np.sqrt(f.var_v)))
    ]
    widest = max(high - low for low, high in ends)
    if widest / pixel_mm > _MOST_PIXELS_A_SIDE - 2:
        wanted = widest / (_MOST_PIXELS_A_SIDE - 2)
        decade = 10.0 ** math.floor(math.log10(wanted))
        pixel_mm = next(k * decade for k in (1.0, 2.0, 5.0, 10.0) if k * decade >= wanted * (1 - 1e-9))
    u_mm, v_mm = (
        pixel_mm * np.arange(math.floor(low / pixel_mm), math.ceil(high / pixel_mm) + 1, dtype=np.float64)
        for low, high in ends
    )
    return replace(mean_ssf_field(f, u_mm=u_mm, v_mm=v_mm, weights=shares), pixel_mm=pixel_mm)


def _mass_quantile_999(values: FloatArray, mass: FloatArray) -> float:
    flat, weight = values.ravel(), mass.ravel()
    order = np.argsort(flat)
    ladder = np.cumsum(weight[order])
    return float(flat[order][np.searchsorted(ladder, 0.999 * ladder[-1])])


@dataclass(frozen=True)
class QuantitySummary:
    """A quantity's posterior: name (ending in the unit), unit, median and central 95 % interval."""

    name: str
    unit: str
    median: float
    interval95: tuple[float, float]


def ssf_quantities(samples: FloatArray, n_gaussians: int, *, each: bool = True) -> tuple[QuantitySummary, ...]:
    """Summarise the whole SSF and, if there are several, each Gaussian: medians and 95 % intervals.

    In this order: `centre_u_mm` and `centre_v_mm`; `sd_long_mm` and `sd_short_mm` along the axes of the covariance;
    `angle_deg` of the long axis from the u axis, anticlockwise, defined up to 180 degrees, with a median within 90
    degrees of 0. Then for each Gaussian n its share of the mass, and the same five, named as "gaussian_n.share".

    Parameters
    ----------
    samples
        Posterior samples of the paper's parameters, (n_samples, at least 6 N).
    n_gaussians
        Order N.
    each
        Whether to summarise each of several Gaussians too.
    """
    f = footprint_of(samples[:, : 6 * n_gaussians], n_gaussians)
    found = _summaries_of_sampled_moments("", *_moments_of_whole_footprint(f))
    if n_gaussians > 1 and each:
        for k in range(n_gaussians):
            prefix = f"gaussian_{k + 1}."
            own = (f.u_mm, f.v_mm, f.var_u, f.var_v, f.cov_uv)
            found += (_quantity_of_samples(f"{prefix}share", "1", f.weight[:, 0, k]),)
            found += _summaries_of_sampled_moments(prefix, *(values[:, 0, k] for values in own))
    return found


def _summaries_of_sampled_moments(
    prefix: str, u: FloatArray, v: FloatArray, var_u: FloatArray, var_v: FloatArray, cov_uv: FloatArray
) -> tuple[QuantitySummary, ...]:
    middle, half = (var_u + var_v) / 2, np.hypot((var_u - var_v) / 2, cov_uv)
    angle = 0.5 * np.arctan2(2 * cov_uv, var_u - var_v)
    # An axis' angle is defined up to half a turn: unwrap about the mean direction.
    about = 0.5 * np.angle(np.exp(2j * angle).mean())
    unwrapped = about + (angle - about + np.pi / 2) % np.pi - np.pi / 2
    return (
        _quantity_of_samples(f"{prefix}centre_u_mm", "mm", u),
        _quantity_of_samples(f"{prefix}centre_v_mm", "mm", v),
        _quantity_of_samples(f"{prefix}sd_long_mm", "mm", np.sqrt(middle + half)),
        _quantity_of_samples(f"{prefix}sd_short_mm", "mm", np.sqrt(np.maximum(middle - half, 0.0))),
        _quantity_of_samples(f"{prefix}angle_deg", "degree", np.degrees(unwrapped)),
    )


def _quantity_of_samples(name: str, unit: str, values: FloatArray) -> QuantitySummary:
    low, median, high = (float(q) for q in np.quantile(values, [0.025, 0.5, 0.975]))
    return QuantitySummary(name, unit, median, (low, high))


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
