"""Problems whose evidence is known by another route."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.integrate import quad
from scipy.special import gammaln, logsumexp, ndtr
from scipy.stats import loggamma, multivariate_normal, norm

from probewise.priors import Prior, Product, Uniform

LOG_2PI = math.log(2 * math.pi)


@dataclass(frozen=True, eq=False)
class Known:
    """A problem, with the log of its evidence."""

    prior: Prior
    function: Callable[[np.ndarray], np.ndarray]
    log_z: float

    def log_likelihood(self, theta: np.ndarray) -> np.ndarray:
        return self.function(theta)


def box(n_params: int, low: float, high: float) -> Product:
    return Product({f"p{i}": Uniform(low, high) for i in range(n_params)})


def shells(n_params: int) -> Known:
    """Two Gaussian shells of radius 2 and width 0.1, centres 3.5 to either side; by radial quadrature."""
    width, radius, shift = 0.1, 2.0, 3.5

    def function(theta: np.ndarray) -> np.ndarray:
        rest = (theta[:, 1:] ** 2).sum(axis=1)
        r = np.sqrt((theta[:, :1] - np.array([shift, -shift])) ** 2 + rest[:, None])
        return logsumexp(-0.5 * ((r - radius) / width) ** 2, axis=1) - 0.5 * LOG_2PI - math.log(width)

    radial = quad(lambda r: r ** (n_params - 1) * norm.pdf(r, radius, width), 1.0, 3.0, points=[radius], epsabs=0)[0]
    area = math.log(2) + n_params / 2 * math.log(math.pi) - gammaln(n_params / 2)
    return Known(box(n_params, -6, 6), function, math.log(2 * radial) + area - n_params * math.log(12))


@cache
def eggbox() -> Known:
    """Eighteen equal peaks; the midpoint rule converges at once for a periodic function."""
    grid = (np.arange(2000) + 0.5) / 2000 * 10 * math.pi
    values = (2 + np.cos(grid[:, None] / 2) * np.cos(grid / 2)) ** 5
    log_z = float(logsumexp(values) - 2 * math.log(2000))
    return Known(box(2, 0, 10 * math.pi), lambda t: (2 + np.cos(t[:, 0] / 2) * np.cos(t[:, 1] / 2)) ** 5, log_z)


def gaussian(n_params: int = 10, correlation: float = 0.9, half_width: float = 5.0) -> Known:
    """A correlated Gaussian in a box wide enough to hold all of it but 1e-5."""
    covariance = correlation * np.ones((n_params, n_params)) + (1 - correlation) * np.eye(n_params)
    inverse = np.linalg.inv(covariance)
    constant = -0.5 * (n_params * LOG_2PI + np.linalg.slogdet(covariance)[1])

    def function(theta: np.ndarray) -> np.ndarray:
        return constant - 0.5 * np.einsum("ni,ij,nj->n", theta, inverse, theta)

    return Known(box(n_params, -half_width, half_width), function, -n_params * math.log(2 * half_width))


@cache
def rosenbrock(n_params: int, n_grid: int = 4000) -> Known:
    """A curved valley; the integral factorises into a chain of one-dimensional ones."""

    def function(theta: np.ndarray) -> np.ndarray:
        a, b = theta[:, :-1], theta[:, 1:]
        return -(100 * (b - a**2) ** 2 + (1 - a) ** 2).sum(axis=1)

    x = (np.arange(n_grid) + 0.5) / n_grid * 10 - 5
    kernel = np.exp(-100 * (x[None, :] - x[:, None] ** 2) ** 2 - (1 - x[:, None]) ** 2) * (10 / n_grid)
    message = np.ones(n_grid)
    for _ in range(n_params - 1):
        message = kernel @ message
    return Known(box(n_params, -5, 5), function, float(np.log(message.mean()) - (n_params - 1) * math.log(10)))


def log_gamma(n_params: int = 20) -> Known:
    """Four modes with heavy tails: products of log-gamma and normal densities (Beaujean & Caldwell 2013)."""
    s, half = 1 / 30, (n_params + 2) // 2

    def tail(z: np.ndarray) -> np.ndarray:
        return z - np.exp(z) - math.log(s)

    def bell(z: np.ndarray) -> np.ndarray:
        return -0.5 * z * z - 0.5 * LOG_2PI - math.log(s)

    def function(theta: np.ndarray) -> np.ndarray:
        low, high = (theta - 1 / 3) / s, (theta - 2 / 3) / s
        out = np.logaddexp(tail(low[:, 0]), tail(high[:, 0])) + np.logaddexp(bell(low[:, 1]), bell(high[:, 1]))
        return out - 2 * math.log(2) + tail(high[:, 2:half]).sum(axis=1) + bell(high[:, half:]).sum(axis=1)

    def share(distribution: object, centre: float) -> float:
        return float(distribution.cdf((1 - centre) / s) - distribution.cdf(-centre / s))  # type: ignore[attr-defined]

    g, n = loggamma(1.0), norm()
    log_z = (
        math.log(share(g, 1 / 3) + share(g, 2 / 3))
        + math.log(share(n, 1 / 3) + share(n, 2 / 3))
        - 2 * math.log(2)
        + (half - 2) * math.log(share(g, 2 / 3))
        + (n_params - half) * math.log(share(n, 2 / 3))
    )
    return Known(box(n_params, 0, 1), function, log_z)


def plateau() -> Known:
    """Three flat terraces and a peak in the unit square: 0.6 of the volume at 0, 0.3 at 2, the rest a cone from 4."""

    def function(theta: np.ndarray) -> np.ndarray:
        x = theta[:, 0]
        return np.where(x < 0.6, 0.0, np.where(x < 0.9, 2.0, 4.0 + 20.0 * (x - 0.9)))

    log_z = math.log(0.6 + 0.3 * math.exp(2) + math.exp(4) * (math.exp(2) - 1) / 20)
    return Known(box(2, 0, 1), function, log_z)


def slab_and_spike(n_params: int = 5) -> Known:
    """A Gaussian of sd 0.1 and one of sd 0.01 with a hundred times its mass, around one centre."""
    wide, narrow = 0.1, 0.01

    def function(theta: np.ndarray) -> np.ndarray:
        square = ((theta - 0.5) ** 2).sum(axis=1)
        slab = -0.5 * square / wide**2 - n_params * (0.5 * LOG_2PI + math.log(wide))
        spike = -0.5 * square / narrow**2 - n_params * (0.5 * LOG_2PI + math.log(narrow)) + math.log(100)
        return np.logaddexp(slab, spike)

    inside = (1 - 2 * norm.sf(0.5 / wide)) ** n_params
    return Known(box(n_params, 0, 1), function, math.log(inside + 100))


def naive_steps() -> Known:
    """Four readings of a disc's presence: nothing but plateaus, the highest of them a lens."""
    grid = (np.arange(800) + 0.5) / 800
    places = np.array([[0.45, 0.5], [0.75, 0.5], [0.6, 0.2], [0.2, 0.9]])
    seen = np.array([1.0, 1.0, 0.0, 0.0])

    def function(theta: np.ndarray) -> np.ndarray:
        inside = ((theta[:, None, :] - places) ** 2).sum(axis=2) < 0.04
        return -0.5 * (((inside - seen) / 0.2) ** 2).sum(axis=1)

    square = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    log_z = float(logsumexp(function(square)) - math.log(len(square)))
    return Known(box(2, 0, 1), function, log_z)


# ------------------------------------------------------------------ the paper's two problems, in small

_SD_U, _SD_V, _CORRELATION, _U, _V = 4.0, 2.5, 0.2, 0.0, 1.5
_DARK, _BRIGHT = 10.0, 60.0


@dataclass(frozen=True, eq=False)
class SSFPrior:
    """The paper's parameters with uniform priors; C is uniform where the form is positive definite."""

    n_gaussians: int

    @property
    def names(self) -> tuple[str, ...]:
        per = [f"{letter}_{n}" for n in range(1, self.n_gaussians + 1) for letter in "auvABC"]
        return (*per, "I_min", "I_max")

    def from_unit_cube(self, u: np.ndarray) -> np.ndarray:
        theta = np.empty_like(u)
        for i in range(0, 6 * self.n_gaussians, 6):
            theta[:, i] = u[:, i]
            theta[:, i + 1 : i + 3] = 20 * u[:, i + 1 : i + 3] - 10
            theta[:, i + 3 : i + 5] = 0.003 + 0.497 * u[:, i + 3 : i + 5]
            theta[:, i + 5] = 0.98 * (2 * u[:, i + 5] - 1) * np.sqrt(theta[:, i + 3] * theta[:, i + 4])
        theta[:, -2], theta[:, -1] = 20 * u[:, -2], 40 + 40 * u[:, -1]
        return theta

    def log_prob(self, theta: np.ndarray) -> np.ndarray:
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class SSFProblem:
    """404 readings across an edge in four orientations, 4 of quadrants; Student-t without its constants.

    No closed form: log Z is about -737.5 for one Gaussian, -740.3 for two with the recording of `ssf`.
    """

    prior: SSFPrior
    scans: tuple[np.ndarray, ...]
    quadrants: np.ndarray
    log_z: float

    def log_likelihood(self, theta: np.ndarray) -> np.ndarray:
        g = theta[:, :-2].reshape(len(theta), -1, 6)
        a, u, v, big_a, big_b, big_c = np.moveaxis(g, 2, 0)
        det = big_a * big_b - big_c**2
        mass = a / np.sqrt(det)
        weight = mass / mass.sum(axis=1, keepdims=True)
        scans, quadrants = _responses(weight, u, v, big_b / det / 2, big_a / det / 2, -big_c / det / 2)
        dark, span = theta[:, -2, None], (theta[:, -1] - theta[:, -2])[:, None]
        out = np.zeros(len(theta))
        for seen, read in zip((*scans, quadrants), (*self.scans, self.quadrants), strict=True):
            out -= 0.5 * (read.size - 1) * np.log((((dark + span * seen) - read) ** 2).sum(axis=1))
        return out


_EDGE = np.arange(-50.0, 51.0)
_CORNERS = ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (4.0, 4.0, 1.0), (-4.0, 4.0, 1.0))
_NODES, _WEIGHTS = leggauss(24)


def _responses(
    weight: np.ndarray, u: np.ndarray, v: np.ndarray, vu: np.ndarray, vv: np.ndarray, c: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray]:
    su, sv = np.sqrt(vu), np.sqrt(vv)
    scans = [
        (weight[..., None] * ndtr((_EDGE + m[..., None]) / s[..., None])).sum(axis=1)
        for m, s in ((u, su), (-v, sv), (-u, su), (v, sv))
    ]
    quadrants = []
    for x, y, sign in _CORNERS:
        h, k, r = sign * (x - u) / su, (y - v) / sv, sign * c / (su * sv)
        angle = np.arcsin(r)
        sine = np.sin(0.5 * angle[..., None] * (_NODES + 1))
        hk = (h * h + k * k)[..., None] - 2 * (h * k)[..., None] * sine
        both = ndtr(-h) * ndtr(-k) + angle / (4 * math.pi) * (np.exp(-hk / 2 / (1 - sine**2)) @ _WEIGHTS)
        quadrants.append((weight * both).sum(axis=1))
    return scans, np.stack(quadrants, axis=-1)


def ssf(n_gaussians: int) -> SSFProblem:
    rng = np.random.default_rng(20130101)
    one = np.ones((1, 1))
    scans, quadrants = _responses(
        one, one * _U, one * _V, one * _SD_U**2, one * _SD_V**2, one * _CORRELATION * _SD_U * _SD_V
    )

    def read(seen: np.ndarray) -> np.ndarray:
        return _DARK + (_BRIGHT - _DARK) * seen[0] + 0.6 * rng.standard_normal(seen[0].size)

    return SSFProblem(
        SSFPrior(n_gaussians), tuple(read(s) for s in scans), read(quadrants), {1: -737.5, 2: -740.3}[n_gaussians]
    )


_ARC_NODES, _ARC_WEIGHTS = leggauss(20)


def disc_seen(x: np.ndarray, y: np.ndarray, cx: np.ndarray, cy: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Share of a one-Gaussian SSF inside a disc, by quadrature over the rows the SSF covers."""
    x, y, cx, cy, r = np.broadcast_arrays(x, y, cx, cy, r)
    dx, dy = cx - x - _U, cy - y - _V
    out = (np.hypot(dx, dy) < r).astype(float)
    near = np.abs(np.hypot(dx, dy) - r) < 6 * _SD_U
    if near.any():
        x0, y0, rr = dx[near][:, None], dy[near][:, None], r[near][:, None]
        low, high = np.maximum(y0 - rr, -5.5 * _SD_V), np.minimum(y0 + rr, 5.5 * _SD_V)
        half = np.maximum(high - low, 0) / 2
        rows = (low + high) / 2 + half * _ARC_NODES
        chord = np.sqrt(np.maximum(rr**2 - (rows - y0) ** 2, 0))
        sd, lean = _SD_U * math.sqrt(1 - _CORRELATION**2), _CORRELATION * _SD_U / _SD_V * rows
        inside = ndtr((x0 + chord - lean) / sd) - ndtr((x0 - chord - lean) / sd)
        out[near] = (norm.pdf(rows / _SD_V) / _SD_V * inside) @ _ARC_WEIGHTS * half[:, 0]
    return out


def circle() -> Known:
    """Find a circle from 20 readings; log Z = -47.61 by quadrature, with 61 % of the prior on plateaus."""
    rng = np.random.default_rng(7)
    cx, cy, r = 430.0, 270.0, 82.0
    far = rng.uniform([0, 0], [1048, 520], (10, 2))
    turn, reach = rng.uniform(0, 2 * np.pi, 10), r + rng.normal(0, 4, 10)
    places = np.concatenate([far, np.stack([cx + reach * np.cos(turn), cy + reach * np.sin(turn)], axis=-1)])

    def predicted(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        return _DARK + (_BRIGHT - _DARK) * disc_seen(places[:, 0], places[:, 1], a, b, c)

    readings = predicted(np.array([cx]), np.array([cy]), np.array([r])) + rng.standard_normal(20)

    def function(theta: np.ndarray) -> np.ndarray:
        return -0.5 * ((predicted(*(theta[:, i : i + 1] for i in range(3))) - readings) ** 2).sum(axis=1) - 10 * LOG_2PI

    prior = Product({"x_mm": Uniform(0, 1048), "y_mm": Uniform(0, 520), "radius_mm": Uniform(20, 150)})
    return Known(prior, function, -47.613)


def mixture_of_far_peaks(n_params: int = 5) -> Known:
    """Two peaks of masses 1 and 3, twenty sd apart: a sampler that loses one is wrong by ln 4 or ln 4/3."""
    low, high = np.full(n_params, 0.3), np.full(n_params, 0.7)
    sd = 0.02

    def function(theta: np.ndarray) -> np.ndarray:
        a = np.atleast_1d(multivariate_normal.logpdf(theta, low, sd**2 * np.eye(n_params)))
        b = np.atleast_1d(multivariate_normal.logpdf(theta, high, sd**2 * np.eye(n_params)))
        return np.logaddexp(a + math.log(0.25), b + math.log(0.75))

    return Known(box(n_params, 0, 1), function, 0.0)


PROBLEMS: dict[str, Callable[[], Known | SSFProblem]] = {
    "shells 2-D": lambda: shells(2),
    "shells 10-D": lambda: shells(10),
    "eggbox": eggbox,
    "Gaussian 10-D": gaussian,
    "Rosenbrock 2-D": lambda: rosenbrock(2),
    "Rosenbrock 5-D": lambda: rosenbrock(5),
    "LogGamma 20-D": log_gamma,
    "plateau": plateau,
    "slab and spike": slab_and_spike,
    "naive steps": naive_steps,
    "two far peaks": mixture_of_far_peaks,
    "circle": circle,
    "SSF 1 Gaussian": lambda: ssf(1),
    "SSF 2 Gaussians": lambda: ssf(2),
}
