"""The spatial sensitivity function (SSF): mixtures of Gaussians and discrete fields (paper, eq. 10)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray, IntArray, read_only_floats, require_finite
from probewise._display import ShowsItself
from probewise._kinds import checked_whole
from probewise.errors import ParameterError, ShapeError, require
from probewise.sensor.stages import Footprint

_REACH = 6.5  # sds: beyond, a Gaussian's density is below 1e-9 of its peak
_NEGLIGIBLE = 1e-9  # share of a field's light that is not drawn


def mixture_parameter_names(n_gaussians: int) -> tuple[str, ...]:
    """Name the paper's parameters in order: a_1, u_1, v_1, A_1, B_1, C_1, a_2, ..."""
    require(n_gaussians >= 1, "n_gaussians", n_gaussians, "1 or more")
    return tuple(f"{letter}_{n}" for n in range(1, n_gaussians + 1) for letter in "auvABC")


def footprint_of(theta: FloatArray, n_gaussians: int) -> Footprint:
    """Turn the paper's parameters into weights, means and covariances (paper, eq. 10).

    The exponent A x^2 + B y^2 + 2 C x y belongs to the covariance 1/2 inv([[A, C], [C, B]]);
    its mass is a pi / sqrt(AB - C^2).

    `theta`: columns a_n, u_n, v_n (mm), A_n, B_n, C_n (1/mm^2), shape (n_samples, 6 n_gaussians); `n_gaussians`: number
    of Gaussians, N. Returns footprint with arrays (n_samples, 1, n_gaussians). Raises ParameterError if A, AB - C^2 or
    the total mass is not positive (single amplitudes may be negative); ShapeError if theta has another number of
    columns.
    """
    if theta.ndim != 2 or theta.shape[1] != 6 * n_gaussians:
        raise ShapeError(f"SSF parameters have shape {theta.shape}; allowed: (n_samples, {6 * n_gaussians})")
    # One contiguous row per parameter, (6, n_gaussians, n_samples), for speed.
    rows = np.ascontiguousarray(theta.reshape(len(theta), n_gaussians, 6).transpose(2, 1, 0))
    a, u, v, aa, bb, cc = rows
    determinant = aa * bb - cc * cc
    if not ((determinant > 0) & (aa > 0)).all():
        raise ParameterError(
            "A B - C^2 of a Gaussian", float(determinant.min()), "greater than 0, with A > 0 and B > 0"
        )
    mass = a / np.sqrt(determinant)
    total = mass.sum(axis=0)
    if not (total > 0).all():
        raise ParameterError("mass of the SSF", float(total.min()), "greater than 0")
    half = 0.5 / determinant
    return Footprint(*(part.T[:, None] for part in (mass / total, u, v, half * bb, half * aa, -half * cc)))


class SSFModel(Protocol):
    """An SSF as the chain needs it: named parameters and their footprint."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        ...

    def footprint(self, theta: FloatArray) -> Footprint:
        """Return the mixture of Gaussians in the sensor frame, theta (n_samples, n_params)."""
        ...


@dataclass(frozen=True)
class FreeMixture:
    """A mixture of `n_gaussians` with free parameters."""

    n_gaussians: int

    def __post_init__(self) -> None:
        checked_whole("n_gaussians", self.n_gaussians)

    @cached_property
    def names(self) -> tuple[str, ...]:
        return mixture_parameter_names(self.n_gaussians)

    def footprint(self, theta: FloatArray) -> Footprint:
        return footprint_of(theta, self.n_gaussians)


@dataclass(frozen=True, eq=False)
class FixedMixture:
    """A known mixture: weights (n,), means (n, 2) mm, covariances (n, 2, 2) mm^2, sensor frame."""

    weights: FloatArray
    means_mm: FloatArray
    covs_mm2: FloatArray

    def __post_init__(self) -> None:
        n = np.size(self.weights)
        for name, shape in (("weights", (n,)), ("means_mm", (n, 2)), ("covs_mm2", (n, 2, 2))):
            values = read_only_floats(getattr(self, name), name)
            if values.shape != shape or n == 0:
                raise ShapeError(f"{name} has shape {values.shape}; allowed: {shape}, one Gaussian or more")
            require_finite(name, values)
            object.__setattr__(self, name, values)
        is_mass = (self.weights >= 0).all() and self.weights.sum() > 0
        require(is_mass, "weights", self.weights.tolist(), "0 or more, at least one greater than 0")
        object.__setattr__(self, "weights", read_only_floats(self.weights / self.weights.sum()))
        is_definite = (np.linalg.eigvalsh(self.covs_mm2) > 0).all()
        require(is_definite, "covs_mm2", self.covs_mm2.tolist(), "positive definite matrices")

    @property
    def names(self) -> tuple[str, ...]:
        return ()

    @property
    def mean_mm(self) -> FloatArray:
        """Mean of the whole mixture, mm, (2,)."""
        return np.asarray(self.weights @ self.means_mm)

    @property
    def cov_mm2(self) -> FloatArray:
        """Covariance of the whole mixture by the law of total covariance, mm^2, (2, 2)."""
        off = self.means_mm - self.mean_mm
        return np.asarray(np.einsum("n,nij->ij", self.weights, self.covs_mm2 + off[:, :, None] * off[:, None, :]))

    def footprint(self, theta: FloatArray) -> Footprint:
        return self._footprint

    @cached_property
    def _footprint(self) -> Footprint:
        (u, v), (var_u, cov_uv, _, var_v) = self.means_mm.T, self.covs_mm2.reshape(-1, 4).T
        return Footprint(*(part[None, None] for part in (self.weights, u, v, var_u, var_v, cov_uv)))


@dataclass(frozen=True, eq=False)
class SSFField(ShowsItself):
    """A field of SSF values on square pixels (paper, the discrete SSF matrix).

    `values` (n_y, n_x) are the pixels' shares, of either sign, normalised to sum one on construction;
    row 0 is the lowest y', column 0 the lowest x'. `origin_mm` is the centre (x', y') of pixel
    [0, 0] in the sensor frame.
    """

    values: FloatArray
    pixel_mm: float
    origin_mm: tuple[float, float]

    def __post_init__(self) -> None:
        values = np.asarray(self.values, dtype=np.float64)
        if values.ndim != 2 or values.size == 0:
            raise ShapeError(f"SSF field has shape {values.shape}; allowed: (n_y, n_x), not empty")
        require_finite("SSF field", values)
        require(0 < self.pixel_mm < math.inf, "pixel_mm", self.pixel_mm, "greater than 0")
        require(values.sum() > 0, "sum of the SSF field", float(values.sum()), "greater than 0")
        object.__setattr__(self, "values", read_only_floats(values / values.sum()))

    @property
    def u_mm(self) -> FloatArray:
        """Pixel centres along x', mm, (n_x,)."""
        return np.array(self.origin_mm[0] + self.pixel_mm * np.arange(self.values.shape[1]), dtype=np.float64)

    @property
    def v_mm(self) -> FloatArray:
        """Pixel centres along y', mm, (n_y,)."""
        return np.array(self.origin_mm[1] + self.pixel_mm * np.arange(self.values.shape[0]), dtype=np.float64)

    @cached_property
    def centers_mm(self) -> FloatArray:
        """Pixel centres in the order of values.ravel(), (n_pixels, 2)."""
        u, v = np.meshgrid(self.u_mm, self.v_mm)
        return np.stack([u.ravel(), v.ravel()], axis=-1)

    @cached_property
    def mean_mm(self) -> FloatArray:
        """Mean position in the sensor frame, weighted by the values, mm, (2,)."""
        return np.asarray(self.values.ravel() @ self.centers_mm)

    @cached_property
    def cov_mm2(self) -> FloatArray:
        """Covariance of the pixel centres, weighted by the values, mm^2, (2, 2)."""
        off = self.centers_mm - self.mean_mm
        return np.asarray((self.values.ravel()[:, None] * off).T @ off)


def mean_ssf_field(
    footprint: Footprint, *, u_mm: FloatArray, v_mm: FloatArray, weights: FloatArray | None = None
) -> SSFField:
    """Return the mean field of sampled SSFs, evaluated at pixel centres: a mean of fields, not of parameters.

    Returns the mean field (paper, "logWt-weighted average of the sampled SSF fields"). Raises ShapeError if an axis has
    fewer than two pixels; ParameterError if the pixels are not evenly spaced, with one spacing for both axes.

    `footprint`: mixtures with arrays (n_samples, 1, n_gaussians); `u_mm`, `v_mm`: evenly spaced pixel centres with one
    spacing for both axes, (n_x,) and (n_y,); `weights`: weight of each sample in the mean, (n_samples,); equal when
    None.
    """
    if len(u_mm) < 2 or len(v_mm) < 2:
        raise ShapeError(f"u_mm has {len(u_mm)} pixels, v_mm {len(v_mm)}; allowed: 2 or more each")
    pixel, begins = float(u_mm[1] - u_mm[0]), (u_mm[:2].tolist(), v_mm[:2].tolist())
    is_even = np.allclose(np.diff(u_mm), pixel) and np.allclose(np.diff(v_mm), pixel) and pixel > 0
    require(is_even, "u_mm, v_mm", begins, "evenly spaced, one spacing for both")
    w, mu, mv, var_u, var_v, cov = _gaussians_of_mean(footprint, weights)
    total = np.zeros((len(v_mm), len(u_mm)))
    weight = np.abs(w)  # a free form's may be negative
    lightest_first = np.argsort(weight)
    # Of the dead points of a nested run few carry weight.
    counts = np.cumsum(weight[lightest_first]) > _NEGLIGIBLE * weight.sum()
    for n in lightest_first[counts]:
        # Conditioning v on u leaves one exponential per Gaussian and pixel.
        slope = cov[n] / var_u[n]
        var_free = var_v[n] - slope * cov[n]
        across = _reached_slice(u_mm, mu[n], np.sqrt(var_u[n]))
        up = _reached_slice(v_mm, mv[n], np.sqrt(var_v[n]))
        off_u = u_mm[across] - mu[n]
        own = (v_mm[up] - mv[n])[:, None] - slope * off_u
        own *= own
        own /= var_free
        own += off_u**2 / var_u[n]
        own *= -0.5
        np.exp(own, out=own)
        own *= w[n] / (2 * np.pi * np.sqrt(var_u[n] * var_free))
        total[up, across] += own
    return SSFField(total, pixel, (float(u_mm[0]), float(v_mm[0])))


def _gaussians_of_mean(footprint: Footprint, weights: FloatArray | None) -> tuple[FloatArray, ...]:
    """Return shares and moments of all Gaussians of the mean of sampled mixtures, (n_samples n_gaussians,) each."""
    arrays = np.broadcast_arrays(footprint.weight, *footprint.moments)
    n_samples, _, n = arrays[0].shape
    shares = np.full(n_samples, 1 / n_samples) if weights is None else np.asarray(weights) / np.sum(weights)
    w, *moments = (a[:, 0].ravel() for a in arrays)
    return (w * np.repeat(shares, n), *moments)


def _reached_slice(centres: FloatArray, mean: float, sd: float) -> slice:
    """Return the slice of the pixel centres, along one axis, that lie within 6.5 sds of a Gaussian's mean."""
    return slice(*np.searchsorted(centres, [mean - _REACH * sd, mean + _REACH * sd]))


def merged_mean_mixture(footprint: Footprint, *, n_gaussians: int = 1) -> FixedMixture:
    """Merge the mean of sampled mixtures, arrays (n_samples, 1, n), into one mixture of at most `n_gaussians`.

    The mean over the samples is a large mixture. Similar Gaussians of it are merged by the law of total covariance, so
    mean and covariance of the mean field are exact.
    """
    require(n_gaussians >= 1, "n_gaussians", n_gaussians, "1 or more")
    w, u, v, var_u, var_v, cov = _gaussians_of_mean(footprint, None)
    w = w / w.sum()
    means, covs = np.stack([u, v], axis=-1), np.stack([var_u, cov, cov, var_v], axis=-1)
    sd_u, sd_v = np.sqrt(var_u), np.sqrt(var_v)
    places = np.stack([u, v, sd_u, sd_v, cov / np.sqrt(sd_u * sd_v)], axis=-1)  # all in mm
    merged = [_mass_mean_covariance(w[g], means[g], covs[g]) for g in _similar_groups(w, places, n_gaussians)]
    return FixedMixture(*(np.array(part) for part in zip(*merged, strict=True)))


def mixture_of_field(field: SSFField, *, n_gaussians: int = 1) -> FixedMixture:
    """Approximate a field by a mixture of the same mean and covariance, for which responses have closed forms.

    Pixels count as points, negative values of the field as 0. Gaussians without mass are left out of the `n_gaussians`.
    Raises ParameterError if a Gaussian would have no width, as one on a single pixel.
    """
    values = np.maximum(field.values.ravel(), 0.0)
    kept = values > 1e-7 * values.max()
    return _mixture_of_points(values[kept], field.centers_mm[kept], n_gaussians)


def _similar_groups(w: FloatArray, places: FloatArray, n_groups: int) -> list[IntArray]:
    """Split rows of weights `w`, (n,), and `places`, (n, n_axes), into at most `n_groups` groups of near rows.

    Each split halves the group with the largest weighted scatter along one axis, across that axis at the mean.
    """

    def along_main_axis(group: IntArray) -> tuple[float, FloatArray]:
        off = places[group] - w[group] @ places[group] / w[group].sum()
        scatter, axes = np.linalg.eigh((w[group][:, None] * off).T @ off)
        return float(scatter[-1]), off @ axes[:, -1]

    groups = [np.arange(len(w))]
    spread = [along_main_axis(groups[0])]
    while len(groups) < n_groups:
        widest = max(range(len(groups)), key=lambda k: spread[k][0])
        group, (_, along) = groups.pop(widest), spread.pop(widest)
        parts = [part for part in (group[along <= 0], group[along > 0]) if len(part)]
        groups += parts
        spread += [along_main_axis(part) for part in parts]
        if len(parts) == 1:  # all rows alike
            break
    return groups


def _mass_mean_covariance(w: FloatArray, means: FloatArray, covs: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return mass, mean (2,) and covariance (2, 2) of Gaussians: weights (n,), means (n, 2), covariances (n, 4)."""
    mass = float(w.sum())
    mean = w @ means / mass
    off = means - mean
    return mass, mean, (w @ covs).reshape(2, 2) / mass + (w[:, None] * off).T @ off / mass


def _mixture_of_points(w: FloatArray, places: FloatArray, n_gaussians: int) -> FixedMixture:
    """Fit at most `n_gaussians` to weighted points (n, 2), by expectation-maximisation."""
    require(n_gaussians >= 1, "n_gaussians", n_gaussians, "1 or more")
    w = w / w.sum()
    none = np.zeros((len(w), 4))
    _, mean, cov = _mass_mean_covariance(w, places, none)
    if n_gaussians == 1:
        return FixedMixture(np.ones(1), mean[None], cov[None])
    # Start from Gaussians of increasing width, spread along the principal axis.
    main = np.linalg.eigh(cov)[1][:, 1] * np.sqrt(np.linalg.eigvalsh(cov)[1])
    spread = np.linspace(-1, 1, n_gaussians)
    weights = np.full(n_gaussians, 1 / n_gaussians)
    centers = mean + 0.5 * spread[:, None] * main
    shapes = cov * np.geomspace(0.4, 2.0, n_gaussians)[:, None, None]
    floor = 1e-6 * np.trace(cov) * np.eye(2)
    last = -np.inf
    for _ in range(300):
        log_p = np.empty((len(w), n_gaussians))
        for k in range(n_gaussians):
            inverse = np.linalg.inv(shapes[k])
            quadratic = np.einsum("ni,ij,nj->n", places - centers[k], inverse, places - centers[k])
            log_p[:, k] = np.log(weights[k]) - 0.5 * (quadratic + np.log(np.linalg.det(shapes[k])))
        top = log_p.max(axis=1, keepdims=True)
        p = np.exp(log_p - top)
        total = p.sum(axis=1, keepdims=True)
        score = float(w @ (top + np.log(total))[:, 0])
        shares = w[:, None] * p / total
        alive = shares.sum(axis=0) > 1e-9
        shares, n_gaussians = shares[:, alive], int(alive.sum())
        fitted = [_mass_mean_covariance(shares[:, k], places, none) for k in range(n_gaussians)]
        weights, centers, shapes = (np.array(part) for part in zip(*fitted, strict=True))
        shapes = shapes + floor
        if score - last < 1e-8:
            break
        last = score
    return FixedMixture(weights, centers, shapes - floor)
