"""Footprints of a world's sensor: spatial sensitivities as fine rasters of weights in the sensor frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray, read_only_floats, require_finite
from probewise.errors import ParameterError, ShapeError, require

Density = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class Spot:
    """A footprint: the share of the seen light that comes from each pixel.

    `weights`: share by pixel, shape (n_v, n_u), first row at the smallest v, first column at smallest u; scaled to sum
    to one; `pixel_mm`: side of a pixel; `corner_mm`: corner (u, v) of the raster with the smallest u and v, in the
    sensor frame.
    """

    weights: FloatArray
    pixel_mm: float
    corner_mm: tuple[float, float]

    def __post_init__(self) -> None:
        weights = np.asarray(self.weights, dtype=np.float64)
        if weights.ndim != 2:
            raise ShapeError(f"weights have shape {weights.shape}; allowed: (n_v, n_u)")
        require_finite("weights", weights)
        if weights.min() < 0 or weights.sum() <= 0:
            raise ParameterError("weights", float(weights.min()), "0 or more, not all of them 0")
        require(self.pixel_mm > 0, "pixel_mm", self.pixel_mm, "greater than 0")
        object.__setattr__(self, "weights", read_only_floats(weights / weights.sum()))

    def edges_mm(self) -> tuple[FloatArray, FloatArray]:
        """Return the edges of the pixels in u, shape (n_u + 1,), and in v, shape (n_v + 1,)."""
        n_v, n_u = self.weights.shape
        u_mm, v_mm = self.corner_mm
        return u_mm + self.pixel_mm * np.arange(n_u + 1), v_mm + self.pixel_mm * np.arange(n_v + 1)

    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Return the mean (u, v) in mm, shape (2,), and the covariance in mm^2, shape (2, 2)."""
        u_edges, v_edges = self.edges_mm()
        u, v = np.meshgrid(u_edges[:-1] + self.pixel_mm / 2, v_edges[:-1] + self.pixel_mm / 2)
        points = np.stack([u.ravel(), v.ravel()])
        mean = points @ self.weights.ravel()
        apart = points - mean[:, None]
        # Light is spread over each pixel, which adds the variance of a square.
        return mean, (apart * self.weights.ravel()) @ apart.T + np.eye(2) * self.pixel_mm**2 / 12


@dataclass(frozen=True)
class Blob:
    """One Gaussian of a footprint: share of the light, centre and sds (mm) along u and v, correlation of u and v."""

    share: float
    center_mm: tuple[float, float]
    sd_mm: tuple[float, float]
    correlation: float = 0.0


def raster_spot(
    density: Density, half_width_mm: float, *, center_mm: tuple[float, float] = (0.0, 0.0), pixel_mm: float = 0.25
) -> Spot:
    """Rasterise a density over a square of pixels; rows and columns with negligible weight at the margin are cropped.

    `density`: function of arrays u, v (mm) of one shape: sensitivity there; any scale, 0 or more; `half_width_mm`: half
    the side of the square; `center_mm`: its centre in the sensor frame; `pixel_mm`: side of a pixel.
    """
    n = math.ceil(half_width_mm / pixel_mm)
    centers = (np.arange(-n, n) + 0.5) * pixel_mm
    u, v = np.meshgrid(center_mm[0] + centers, center_mm[1] + centers)
    weights = density(u, v)
    lost = 1e-6  # of the light on each side, far below the promised accuracy of 1e-3 of the span
    below = [np.cumsum(profile) / profile.sum() for profile in (weights.sum(axis=1), weights.sum(axis=0))]
    ends = [(int(np.searchsorted(share, lost)), int(np.searchsorted(share, 1 - lost))) for share in below]
    rows, columns = (slice(first, last + 1) for first, last in ends)
    corner = (center_mm[0] + (columns.start - n) * pixel_mm, center_mm[1] + (rows.start - n) * pixel_mm)
    return Spot(weights[rows, columns], pixel_mm, corner)


def gaussian_spot(blobs: Sequence[Blob], *, pixel_mm: float = 0.25) -> Spot:
    """Make a footprint that is a sum of Gaussians; only the ratios of their shares count."""
    low = [min(b.center_mm[k] - 6 * b.sd_mm[k] for b in blobs) for k in (0, 1)]
    high = [max(b.center_mm[k] + 6 * b.sd_mm[k] for b in blobs) for k in (0, 1)]

    def light_density(u: FloatArray, v: FloatArray) -> FloatArray:
        out = np.zeros_like(u)
        for b in blobs:
            p, q = (u - b.center_mm[0]) / b.sd_mm[0], (v - b.center_mm[1]) / b.sd_mm[1]
            rest = 1 - b.correlation**2
            out += (
                b.share
                * np.exp(-(p * p - 2 * b.correlation * p * q + q * q) / (2 * rest))
                / (b.sd_mm[0] * b.sd_mm[1] * math.sqrt(rest))
            )
        return out

    center = ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2)
    half_width = max(high[0] - low[0], high[1] - low[1]) / 2
    return raster_spot(light_density, half_width, center_mm=center, pixel_mm=pixel_mm)


def ridge_spot(
    radius_mm: float,
    *,
    center_mm: tuple[float, float],
    lobes: float,
    ridge_mm: float,
    ridge_width_mm: float,
    shadow: float,
    pixel_mm: float,
) -> Spot:
    """Make a cosine disc with two lobes and the shadow of a ridge across it; not a mixture of Gaussians.

    The photodiode sees a disc that fades as cos^2 to its rim, brighter along u and darker along v by a share `lobes`;
    the plastic ridge between diode and LED takes `shadow` of the light along the line v = centre + `ridge_mm`.
    """

    def light_density(u: FloatArray, v: FloatArray) -> FloatArray:
        p, q = u - center_mm[0], v - center_mm[1]
        r = np.hypot(p, q)
        disc = np.where(r < radius_mm, np.cos(np.minimum(r / radius_mm, 1.0) * math.pi / 2) ** 2, 0.0)
        lobed = 1 + lobes * (p * p - q * q) / np.maximum(r * r, 1e-12)
        return np.asarray(disc * lobed * (1 - shadow / (1 + ((q - ridge_mm) / ridge_width_mm) ** 4)))

    return raster_spot(light_density, radius_mm + pixel_mm, center_mm=center_mm, pixel_mm=pixel_mm)


def tailed_spot(core_mm: tuple[float, float], *, center_mm: tuple[float, float], skew: float, pixel_mm: float) -> Spot:
    """Make a skewed footprint with exponential tails, exp(-r) in stretched axes; not a mixture of Gaussians.

    `core_mm` are the decay lengths along u and v; `skew`, 0 to below 1 (else ParameterError), lengthens the tail
    towards +u and shortens that towards -u.
    """
    require(0 <= skew < 1, "skew", skew, "0 to below 1")

    def light_density(u: FloatArray, v: FloatArray) -> FloatArray:
        p, q = (u - center_mm[0]) / core_mm[0], (v - center_mm[1]) / core_mm[1]
        stretched = p / (1 + skew * np.tanh(p))
        return np.asarray(np.exp(1 - np.sqrt(1 + stretched**2 + q**2)))

    half_width = 14 * max(core_mm[0] * (1 + skew), core_mm[1])
    return raster_spot(light_density, half_width, center_mm=center_mm, pixel_mm=pixel_mm)


def ring_spot(
    radius_mm: float, width_mm: float, *, center_mm: tuple[float, float], off_axis: float, pixel_mm: float
) -> Spot:
    """Make a ring, brighter on one side, as of an LED off the lens axis; not a mixture of Gaussians.

    A Gaussian of sd `width_mm` about a circle; `off_axis`, 0 to 1 (else ParameterError), brightens the side towards +v.
    """
    require(0 <= off_axis <= 1, "off_axis", off_axis, "0 to 1")

    def light_density(u: FloatArray, v: FloatArray) -> FloatArray:
        p, q = u - center_mm[0], v - center_mm[1]
        r = np.hypot(p, q)
        sided = 1 + off_axis * q / np.maximum(r, 1e-12)
        return np.asarray(sided * np.exp(-(((r - radius_mm) / width_mm) ** 2) / 2))

    return raster_spot(light_density, radius_mm + 6 * width_mm, center_mm=center_mm, pixel_mm=pixel_mm)


def blurred(spot: Spot, sd_mm: float) -> Spot:
    """Return a footprint convolved with a round Gaussian of sd `sd_mm`; larger pixels are divided first."""
    from scipy.ndimage import gaussian_filter  # here, as few worlds need it

    # A Gaussian sampled more coarsely than its sd is too narrow: refine the pixels first.
    cuts = math.ceil(spot.pixel_mm / sd_mm)
    pixel_mm = spot.pixel_mm / cuts
    margin = math.ceil(5 * sd_mm / pixel_mm)
    weights = np.pad(np.kron(spot.weights, np.ones((cuts, cuts))), margin)
    corner = (spot.corner_mm[0] - margin * pixel_mm, spot.corner_mm[1] - margin * pixel_mm)
    return Spot(gaussian_filter(weights, sd_mm / pixel_mm, mode="constant", truncate=5.0), pixel_mm, corner)
