"""The spatial sensitivity function (SSF): mixtures of Gaussians, discrete fields and free forms (paper, eq. 9, 10)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray, IntArray, logsumexp, read_only_floats, require_finite
from probewise._display import ShowsItself
from probewise._kinds import checked_whole
from probewise.errors import ShapeError, require
from probewise.scene.regions import Region
from probewise.sensor.stages import Footprint, Poses

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
    positive, least = ((determinant > 0) & (aa > 0)).all(), float(determinant.min(initial=np.inf))
    require(positive, "A B - C^2 of a Gaussian", least, "greater than 0, with A > 0 and B > 0")
    mass = a / np.sqrt(determinant)
    total = mass.sum(axis=0)
    require((total > 0).all(), "mass of the SSF", float(total.min(initial=np.inf)), "greater than 0")
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


_PLACES_AT_ONCE = 2**18
# A Fibonacci lattice in the unit square, whose places are even along either side: a straight edge cuts off a share that
# is right to a hundredth.
_N_PLACES = 89
_PLACES_IN_PIXEL = (np.stack([np.arange(89), 55 * np.arange(89) % 89], axis=1) + 0.5) / _N_PLACES - 0.5


def mean_albedo_by_pixels(region: Region, field: SSFField, poses: Poses) -> FloatArray:
    """Compute the response of a discrete SSF: its pixels' values times the mean albedo of each pixel (paper, eq. 9).

    The second of two independent routes to the response; the other, the closed forms of `probewise.sensor.gaussian`,
    shares only the regions' albedo at points. The albedo of a pixel is its covered share, from 89 places in it.

    Returns response R, shape (n_samples, n_points); n_samples is 1 where it is the same for all hypotheses. Raises
    ShapeError if poses and region hold different numbers of hypotheses, neither of them 1.

    `region`: albedo field of each hypothesis (n_regions of them, n_samples or 1); `field`: the discrete SSF in the
    sensor frame; its pixels turn with the sensor; `poses`: where the sensor stands; arrays broadcast to (n_samples,
    n_points).
    """
    x, y, turn = np.broadcast_arrays(*poses.arrays)
    n_poses, n_points = x.shape
    if n_poses not in (1, region.n_regions) and region.n_regions != 1:
        raise ShapeError(f"poses of {n_poses} hypotheses, {region.n_regions} regions; allowed: equal numbers, or 1")
    if n_poses > 1:
        # Each hypothesis has its own poses: evaluate one hypothesis at a time.
        out = np.empty((n_poses, n_points))
        for i in range(n_poses):
            one = Poses(x[i : i + 1], y[i : i + 1], turn[i : i + 1])
            found = mean_albedo_by_pixels(region, field, one)
            out[i] = found[i if len(found) > 1 else 0]
        return out
    values = field.values.ravel()
    kept = np.abs(values) > 1e-12 * np.abs(values).max()
    places = (field.centers_mm[kept][:, None] + field.pixel_mm * _PLACES_IN_PIXEL).reshape(-1, 2)  # in the sensor frame
    weights = np.repeat(values[kept] / _N_PLACES, _N_PLACES)
    out = np.empty((region.n_regions, n_points))
    block = max(1, _PLACES_AT_ONCE // (len(weights) * region.n_regions))
    for start in range(0, n_points, block):
        rows = slice(start, start + block)
        cosine, sine = np.cos(turn[0, rows])[:, None], np.sin(turn[0, rows])[:, None]
        lab_x = x[0, rows, None] + cosine * places[:, 0] - sine * places[:, 1]
        lab_y = y[0, rows, None] + sine * places[:, 0] + cosine * places[:, 1]
        albedo = region.albedo(np.stack([lab_x.ravel(), lab_y.ravel()], axis=-1))
        out[:, rows] = albedo.reshape(len(albedo), -1, len(weights)) @ weights
    return out


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


def mixture_of_field(field: SSFField, *, n_gaussians: int) -> FixedMixture:
    """Approximate a field by a mixture of the same mean and covariance, for which responses have closed forms.

    Pixels count as points, negative values of the field as 0, in expectation-maximisation. Gaussians without mass are
    left out of the `n_gaussians`. Raises ParameterError if one would have no width, as on a single pixel.
    """
    require(n_gaussians >= 1, "n_gaussians", n_gaussians, "1 or more")
    values = np.maximum(field.values.ravel(), 0.0)
    kept = values > 1e-7 * values.max()
    w, places = values[kept] / values[kept].sum(), field.centers_mm[kept]
    none = np.zeros((len(w), 4))
    _, mean, cov = _mass_mean_covariance(w, places, none)
    # Start from Gaussians of increasing width, spread along the principal axis.
    variance, axes = np.linalg.eigh(cov)
    weights = np.full(n_gaussians, 1 / n_gaussians)
    centers = mean + 0.5 * np.linspace(-1, 1, n_gaussians)[:, None] * axes[:, 1] * np.sqrt(variance[1])
    shapes = cov * np.geomspace(0.4, 2.0, n_gaussians)[:, None, None]
    floor = 1e-6 * np.trace(cov) * np.eye(2)
    last, score = -np.inf, -np.inf
    for _ in range(300):
        off = places[:, None] - centers
        square = np.einsum("nki,kij,nkj->nk", off, np.linalg.inv(shapes), off)
        log_p = np.log(weights) - 0.5 * (square + np.linalg.slogdet(shapes)[1])
        total = logsumexp(log_p, axis=1)
        last, score = score, float(w @ total)
        shares = w[:, None] * np.exp(log_p - total[:, None])
        fitted = [_mass_mean_covariance(own, places, none) for own in shares.T if own.sum() > 1e-9]
        weights, centers, shapes = (np.array(part) for part in zip(*fitted, strict=True))
        shapes = shapes + floor
        if score - last < 1e-8:
            break
    return FixedMixture(weights, centers, shapes - floor)


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


# A free-form SSF: one Gaussian, and nineteen narrower ones of either sign that change its form. A real SSF (a ring, a
# shadow across the spot, a long tail) is no mixture of a few Gaussians. Here one Gaussian sets place and size; the
# others lie on rings about it, in units of its sds, and readings are linear in their shares of the mass. The shares are
# restricted to the directions that keep the first and second moments, so the whole has the mean and covariance of the
# one Gaussian and no parameter is redundant.


# Rings (radius, number, width, rotation in spacings), in sds of the one Gaussian: spaced by about their widths, out to
# where a long tail still shows.
_RINGS = ((0.0, 1, 0.45, 0.0), (0.8, 6, 0.5, 0.0), (1.6, 8, 0.6, 0.0), (2.7, 4, 0.9, 0.5))
_TURNS = [(radius, turn) for radius, n, _, first in _RINGS for turn in 2 * np.pi * (np.arange(n) + first) / n]
_PLACES = np.array([(radius * np.cos(turn), radius * np.sin(turn)) for radius, turn in _TURNS])
_WIDTHS = np.repeat([width for _, _, width, _ in _RINGS], [n for _, n, _, _ in _RINGS])
_X, _Y = _PLACES.T
_MOMENTS = np.stack([_X, _Y, _X * _X + _WIDTHS**2 - 1, _Y * _Y + _WIDTHS**2 - 1, _X * _Y])
_DIRECTIONS: FloatArray = np.ascontiguousarray(np.linalg.svd(_MOMENTS)[2][len(_MOMENTS) :].T)
"""Orthonormal basis of the shares that change neither mean nor covariance, (N_FREE_FORM - 1, N_BENDS)."""

N_BENDS: int = _DIRECTIONS.shape[1]
"""Number of free-form coefficients (bends)."""

N_FREE_FORM = 1 + len(_WIDTHS)
"""Number of Gaussians of a free form, the one that sets place and size first."""


def free_form_theta(one: FloatArray, bends: FloatArray) -> FloatArray:
    """Return the parameters of free forms: each a Gaussian bent without a change of its mean and covariance.

    `one`: the paper's a, u, v, A, B, C of one Gaussian that holds the whole mass, (n_samples, 6); `bends`: coefficients
    of the basis of shares that keep mean and covariance, of either sign, (n_samples, N_BENDS). Returns the paper's
    parameters of the mixture, (n_samples, 6 N_FREE_FORM).
    """
    shares = bends @ _DIRECTIONS.T
    a, u, v, aa, bb, cc = (one[:, k, None] for k in range(6))
    det = aa * bb - cc**2
    sd_u, rest_v = np.sqrt(bb / (2 * det)), np.sqrt(0.5 / bb)  # with the next line: the Cholesky factor
    slope = -cc / bb
    blocks = np.empty((len(one), N_FREE_FORM, 6))
    blocks[:, 0] = one
    blocks[:, 0, 0] *= 1 - shares.sum(axis=1)
    blocks[:, 1:, 0] = a * shares / _WIDTHS**2
    blocks[:, 1:, 1] = u + sd_u * _PLACES[:, 0]
    blocks[:, 1:, 2] = v + slope * sd_u * _PLACES[:, 0] + rest_v * _PLACES[:, 1]
    for k, moment in ((3, aa), (4, bb), (5, cc)):
        blocks[:, 1:, k] = moment / _WIDTHS**2
    return blocks.reshape(len(one), -1)


def bend_coefficients(theta: FloatArray) -> FloatArray:
    """Return the coefficients `bends` of free forms, (n_samples, 6 N_FREE_FORM) -> (n_samples, N_BENDS)."""
    return np.asarray(footprint_of(theta, N_FREE_FORM).weight[:, 0, 1:] @ _DIRECTIONS)


def is_free_form(theta: FloatArray) -> bool:
    """Return whether all these mixtures, (n_samples, 6 n), have a free form's number and widths of Gaussians."""
    if theta.shape[1] != 6 * N_FREE_FORM:
        return False
    blocks = theta.reshape(len(theta), N_FREE_FORM, 6)
    return bool(np.allclose(blocks[:, 1:, 3:] * _WIDTHS[:, None] ** 2, blocks[:, :1, 3:], rtol=1e-6, atol=1e-12))
