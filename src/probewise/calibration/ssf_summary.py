"""Summary of an SSF by quantities easier to read than A, B and C: centre, widths and angle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.sensor import Footprint, footprint_of


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


def _moments_of_whole_footprint(f: Footprint) -> tuple[FloatArray, ...]:
    """Compute the moments of the whole mixture, (n_samples,) each: u, v, var u, var v, covariance."""
    u, v = ((f.weight * centre).sum(axis=-1)[:, 0] for centre in (f.u_mm, f.v_mm))
    du, dv = f.u_mm[:, 0] - u[:, None], f.v_mm[:, 0] - v[:, None]
    spread = ((f.var_u, du * du), (f.var_v, dv * dv), (f.cov_uv, du * dv))
    return u, v, *((f.weight[:, 0] * (own[:, 0] + off)).sum(axis=-1) for own, off in spread)


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
