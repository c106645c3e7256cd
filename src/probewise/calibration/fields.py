"""The posterior mean of the spatial sensitivity function (SSF) as a field, on a grid chosen for the footprint.

Paper, section on MoG estimation.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError, ShapeError
from probewise.sensor import Footprint, SSFField, footprint_of, mean_ssf_field

_SIGMAS = 5.0
_MAX_PIXELS_A_SIDE = 301
_SERIES = (1.0, 0.5, 0.2, 0.1)
# The sum over pixels of width p is a trapezoidal or midpoint rule in the distance to an edge (depending on whether the
# edge halves a pixel or lies between two): its error is at most p^2 / 12 times the greatest slope of the profile of a
# footprint of sd s, 0.242 / s^2. With 4.5 pixels per sd that is 1.0e-3 of I_max - I_min.
_PIXELS_PER_SD = 4.5
_LEAST_SHARE = 0.05


def mixture_moments(theta: FloatArray, n_gaussians: int) -> dict[str, FloatArray]:
    """Compute centre, widths and correlation of the whole SSF of each sample.

    Parameters
    ----------
    theta
        Parameters, (n_samples, at least 6 N).
    n_gaussians
        Order N.

    Returns
    -------
    A dict of arrays (n_samples,): "centre x'", "centre y'" (mm), "log width along x'", "log width along y'" (natural
    log of the sd in mm), and "correlation of x' and y'".
    """
    f = _footprint_of_samples(theta, n_gaussians)
    u, v = (f.weight * f.u_mm).sum(axis=-1), (f.weight * f.v_mm).sum(axis=-1)
    du, dv = f.u_mm - u[..., None], f.v_mm - v[..., None]
    var_u = (f.weight * (f.var_u + du * du)).sum(axis=-1)
    var_v = (f.weight * (f.var_v + dv * dv)).sum(axis=-1)
    cov = (f.weight * (f.cov_uv + du * dv)).sum(axis=-1)
    found = {
        "centre x'": u,
        "centre y'": v,
        "log width along x'": np.log(var_u) / 2,
        "log width along y'": np.log(var_v) / 2,
        "correlation of x' and y'": cov / np.sqrt(var_u * var_v),
    }
    return {name: values[:, 0] for name, values in found.items()}


def gaussians_sorted_by_mass(theta: FloatArray, n_gaussians: int) -> FloatArray:
    """Sort the Gaussians of each sample, (n_samples, at least 6 N), by decreasing mass; return sorted samples.

    Field and predictions do not change. The prior is exchangeable, so the labels of a posterior sample are arbitrary;
    sorted by mass, means and intervals of single columns are meaningful.
    """
    order = np.argsort(-_footprint_of_samples(theta, n_gaussians).weight[:, 0], axis=1, kind="stable")
    out = theta.copy()
    blocks = theta[:, : 6 * n_gaussians].reshape(len(theta), n_gaussians, 6)
    out[:, : 6 * n_gaussians] = np.take_along_axis(blocks, order[:, :, None], axis=1).reshape(len(theta), -1)
    return out


def choose_pixel_mm(theta: FloatArray, n_gaussians: int, *, step_mm: float) -> float:
    """Choose the pixel size of the mean field in mm: 1, or finer where scan step or footprint require it.

    It is at most the scan step and 1/4.5 of the sd of the narrowest Gaussian that holds a twentieth of the mass (median
    over the samples), so that the sum over pixels errs by at most a thousandth of I_max - I_min; rounded down to 1,
    0.5, 0.2 or 0.1 times a power of ten.

    Parameters
    ----------
    theta
        Posterior samples, (n_samples, at least 6 N).
    n_gaussians
        Order N.
    step_mm
        Scan step.
    """
    f = _footprint_of_samples(theta, n_gaussians)
    # The smaller eigenvalue of the covariance, as a quotient that keeps its digits.
    middle, half = (f.var_u + f.var_v) / 2, np.hypot((f.var_u - f.var_v) / 2, f.cov_uv)
    narrow = np.sqrt((f.var_u * f.var_v - f.cov_uv**2) / (middle + half))
    narrowest = np.where(f.weight >= _LEAST_SHARE, narrow, np.inf).min(axis=(1, 2))
    wanted = min(1.0, step_mm, float(np.median(narrowest)) / _PIXELS_PER_SD)
    decade = 10.0 ** math.ceil(math.log10(wanted) - 1e-9)
    return next(s * decade for s in _SERIES if s * decade <= wanted * (1 + 1e-9))


def posterior_mean_ssf_field(
    theta: FloatArray,
    n_gaussians: int,
    *,
    pixel_mm: float = 1.0,
    weight: FloatArray | None = None,
    max_pixels: int = _MAX_PIXELS_A_SIDE,
) -> SSFField:
    """Average the SSF fields of weighted samples on square pixels, centred on multiples of their width.

    Parameters
    ----------
    theta
        Samples, (n_samples, at least 6 N), columns a_1, u_1, v_1, A_1, B_1, C_1, ...
    n_gaussians
        Order N.
    pixel_mm
        Width of a pixel; enlarged for a footprint that would need more than `max_pixels` per side.
    weight
        Posterior weights, (n_samples,); by default equal. The samples with the last thousandth are left out.
    max_pixels
        Largest number of pixels per side, 3 or more.

    Returns
    -------
    SSFField
        The mean of the fields, not the field of the mean parameters. It extends five sds beyond all centres except the
        outermost thousandth of the mass.
    """
    if not (pixel_mm > 0 and math.isfinite(pixel_mm)):
        raise ParameterError("pixel_mm", pixel_mm, "greater than 0")
    if max_pixels < 3:
        raise ParameterError("max_pixels", max_pixels, "3 or more")
    weight = np.full(len(theta), 1 / len(theta)) if weight is None else weight / weight.sum()
    if weight.shape != (len(theta),):
        raise ShapeError(f"weight has shape {weight.shape}; allowed: ({len(theta)},), one per sample")
    # The samples with the last thousandth of the weight would cost most of the time and change nothing.
    order = np.argsort(-weight)
    kept = order[: int(np.searchsorted(np.cumsum(weight[order]), 0.999)) + 1]
    f, shares = _footprint_of_samples(theta[kept], n_gaussians), weight[kept]
    mass = shares[:, None, None] * f.weight
    low_u, high_u = _footprint_bounds_along_axis(f.u_mm, np.sqrt(f.var_u), mass)
    low_v, high_v = _footprint_bounds_along_axis(f.v_mm, np.sqrt(f.var_v), mass)
    widest = max(high_u - low_u, high_v - low_v)
    if widest / pixel_mm > max_pixels - 2:
        pixel_mm = _rounded_up_pixel_mm(widest / (max_pixels - 2))
    u_mm, v_mm = _pixel_centres(low_u, high_u, pixel_mm), _pixel_centres(low_v, high_v, pixel_mm)
    return replace(mean_ssf_field(f, u_mm=u_mm, v_mm=v_mm, weights=shares), pixel_mm=pixel_mm)


def _footprint_of_samples(theta: FloatArray, n_gaussians: int) -> Footprint:
    return footprint_of(theta[:, : 6 * n_gaussians], n_gaussians)


def _pixel_centres(low_mm: float, high_mm: float, pixel_mm: float) -> FloatArray:
    """Pixel centres, multiples of the pixel size, that cover `low_mm` to `high_mm`."""
    numbers = np.arange(math.floor(low_mm / pixel_mm), math.ceil(high_mm / pixel_mm) + 1, dtype=np.float64)
    return pixel_mm * numbers


def _footprint_bounds_along_axis(center: FloatArray, sd: FloatArray, mass: FloatArray) -> tuple[float, float]:
    """Return the bounds along one axis, mm: five sds beyond all centres, without the outermost 0.001 of the mass."""
    return -_mass_quantile_999(_SIGMAS * sd - center, mass), _mass_quantile_999(center + _SIGMAS * sd, mass)


def _mass_quantile_999(values: FloatArray, mass: FloatArray) -> float:
    """Smallest of the values up to which 0.999 of the mass lies; both arrays have one shape."""
    flat, weight = values.ravel(), mass.ravel()
    order = np.argsort(flat)
    ladder = np.cumsum(weight[order])
    return float(flat[order][np.searchsorted(ladder, 0.999 * ladder[-1])])


def _rounded_up_pixel_mm(pixel_mm: float) -> float:
    """Round up to 1, 2, 5 or 10 times a power of ten."""
    decade = 10.0 ** math.floor(math.log10(pixel_mm))
    return float(next(s * decade for s in (1.0, 2.0, 5.0, 10.0) if s * decade >= pixel_mm * (1 - 1e-9)))
