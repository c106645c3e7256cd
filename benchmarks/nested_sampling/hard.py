"""Twenty hard problems with known evidence, to ask whether a sampler knows when it is wrong.

Every evidence is closed or a quadrature in one or two dimensions: the likelihoods are built to fall apart into
factors, by a rotation under an isotropic normal prior, by a shear of unit Jacobian, or by symmetry. `HARD` has them
by name; the tests hold each family, in two dimensions, against the midpoint rule. Every part of a posterior here
fills a share of the volume that some of 300 live points can meet, but for the spike on the slab, which lies 40 nats
below the posterior that a run has by then: a peak that no live point meets is found, or suspected, by nobody.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.special import gammaln, i0e, logsumexp, ndtr

from nested_sampling.problems import LOG_2PI, Known, box
from probewise.priors import LogUniform, Normal, Product, Uniform

FloatArray = NDArray[np.float64]


def _normals(n_params: int, sd: float = 1.0) -> Product:
    return Product({f"p{i}": Normal(0.0, sd) for i in range(n_params)})


def _log_quad(log_f: Callable[[float], float], low: float, high: float, at: list[float] | None = None) -> float:
    """Log of the integral of exp(log_f), which is smooth between the places `at` where it peaks or breaks."""
    places = sorted({low, high, *(at or [])})
    fine = np.concatenate([np.linspace(a, b, 201)[:-1] for a, b in pairwise(places)])
    top = max(log_f(x) for x in fine)
    parts = [
        quad(lambda x: math.exp(log_f(x) - top), a, b, limit=500, epsabs=0.0, epsrel=1e-10)[0]
        for a, b in pairwise(places)
    ]
    return top + math.log(math.fsum(parts))


@cache
def rotation(n_params: int) -> FloatArray:
    """A fixed orthogonal matrix, (n_params, n_params)."""
    return np.asarray(np.linalg.qr(np.random.default_rng(n_params).standard_normal((n_params, n_params)))[0])


# ------------------------------------------------------------------ ridges


def slab(n_params: int = 8, width: float = 1e-4) -> Known:
    """A slab of sd `width` across the diagonal of the cube [-1, 1]^n; the sum's density is Irwin and Hall's."""

    def function(theta: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * (theta.sum(axis=1) / width) ** 2)

    # Density at 0 of the sum of n uniforms on [-1, 1]: that of Irwin and Hall at n / 2, over 2. The ridge is so
    # narrow that the density does not change across it.
    x = n_params / 2
    terms = [(-1) ** k * math.comb(n_params, k) * (x - k) ** (n_params - 1) for k in range(math.floor(x) + 1)]
    density = math.fsum(terms) / math.factorial(n_params - 1) / 2
    return Known(box(n_params, -1, 1), function, math.log(density * width) + 0.5 * LOG_2PI)


def bent_ridge(n_params: int = 8, width: float = 1e-4) -> Known:
    """A curve x[i+1] = x[i]^2 - 1/2 of sd `width` in [-1, 1]^n: a shear makes it straight."""

    def function(theta: FloatArray) -> FloatArray:
        off = (theta[:, 1:] - theta[:, :-1] ** 2 + 0.5) / width
        return np.asarray(-0.5 * (off**2).sum(axis=1))

    return Known(box(n_params, -1, 1), function, (n_params - 1) * (0.5 * LOG_2PI + math.log(width / 2)))


def bananas(n_pairs: int = 6, width: float = 0.02) -> Known:
    """Pairs y = x^2 of sd `width` under standard normals, rotated together: a quadrature a pair."""
    n_params = 2 * n_pairs
    turn = rotation(n_params)

    def function(theta: FloatArray) -> FloatArray:
        turned = theta @ turn
        off = (turned[:, 1::2] - turned[:, ::2] ** 2) / width
        return np.asarray(-0.5 * (off**2).sum(axis=1))

    def across(x: float) -> float:
        # The normal ridge times the normal prior of y, integrated over y; then the prior of x.
        variance = 1 + width**2
        return math.log(width) - 0.5 * math.log(variance) - 0.5 * x**4 / variance - 0.5 * (x**2 + LOG_2PI)

    return Known(_normals(n_params), function, n_pairs * _log_quad(across, -8, 8, [0.0]))


def linear_ridge(n_params: int = 8, width: float = 1e-4) -> Known:
    """A line along the diagonal of the cube [-1, 1]^n, of sd `width` in every direction across it."""

    def function(theta: FloatArray) -> FloatArray:
        across = theta - theta.mean(axis=1, keepdims=True)
        return np.asarray(-0.5 * (across**2).sum(axis=1) / width**2)

    # The diagonal is 2 sqrt(n) long; its ends, where the cube's corners cut the ridge, are of the order of the width.
    log_line = math.log(2) + 0.5 * math.log(n_params) + (n_params - 1) * (0.5 * LOG_2PI + math.log(width))
    return Known(box(n_params, -1, 1), function, log_line - n_params * math.log(2))


def product_ridge(n_params: int = 6, width: float = 1e-4) -> Known:
    """Only the product of all parameters is read, to a relative `width`: log-uniform priors from 1e-4 to 1."""
    span = math.log(1e4)
    middle = -0.5 * n_params * span

    def function(theta: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * ((np.log(theta).sum(axis=1) - middle) / width) ** 2)

    x = n_params / 2
    terms = [(-1) ** k * math.comb(n_params, k) * (x - k) ** (n_params - 1) for k in range(math.floor(x) + 1)]
    density = math.fsum(terms) / math.factorial(n_params - 1) / span
    prior = Product({f"p{i}": LogUniform(1e-4, 1.0) for i in range(n_params)})
    return Known(prior, function, math.log(density * width) + 0.5 * LOG_2PI)


# ------------------------------------------------------------------ tails, funnels, scales


def cauchy(n_params: int = 10, scale: float = 0.01) -> Known:
    """A product of Cauchy densities in [-1, 1]^n, centres 0.2."""
    centre = 0.2

    def function(theta: FloatArray) -> FloatArray:
        return np.asarray(-np.log1p(((theta - centre) / scale) ** 2).sum(axis=1))

    inside = scale * (math.atan((1 - centre) / scale) + math.atan((1 + centre) / scale)) / 2
    return Known(box(n_params, -1, 1), function, n_params * math.log(inside))


def student(n_params: int = 8, scale: float = 1e-3) -> Known:
    """Student t of two degrees of freedom along rotated axes under a standard normal: one quadrature to the n."""
    turn = rotation(n_params)

    def function(theta: FloatArray) -> FloatArray:
        return np.asarray(-1.5 * np.log1p((theta @ turn / scale) ** 2 / 2).sum(axis=1))

    def along(x: float) -> float:
        return -1.5 * math.log1p((x / scale) ** 2 / 2) - 0.5 * (x * x + LOG_2PI)

    each = _log_quad(along, -9, 9, [k * scale for k in (-300, -30, -3, 0, 3, 30, 300)])
    return Known(_normals(n_params), function, n_params * each)


def funnel(n_params: int = 10) -> Known:
    """Neal's funnel as a likelihood: log variance v with sd 3, the others with sd exp(v / 2), in a box."""
    half_v, half = 10.0, 30.0

    def function(theta: FloatArray) -> FloatArray:
        v, rest = theta[:, 0], theta[:, 1:]
        log_p = -0.5 * (v / 3) ** 2 - math.log(3) - 0.5 * LOG_2PI
        return np.asarray(log_p - 0.5 * ((rest**2).sum(axis=1) * np.exp(-v) + (n_params - 1) * (v + LOG_2PI)))

    def over(v: float) -> float:
        inside = math.log(math.erf(half * math.exp(-v / 2) / math.sqrt(2)))
        return -0.5 * (v / 3) ** 2 - math.log(3) - 0.5 * LOG_2PI + (n_params - 1) * inside

    log_volume = math.log(2 * half_v) + (n_params - 1) * math.log(2 * half)
    prior = Product({"v": Uniform(-half_v, half_v), **{f"p{i}": Uniform(-half, half) for i in range(1, n_params)}})
    return Known(prior, function, _log_quad(over, -half_v, half_v, [0.0, 6.0]) - log_volume)


def gaussians(n_params: int, half: float, centre: FloatArray, sd: FloatArray, mass: FloatArray) -> Known:
    """Gaussians of these sds and masses, (n_gaussians,), in [-half, half]^n; each centre is the same in all parameters.

    Or `centre` is (n_params, n_gaussians).
    """

    def function(theta: FloatArray) -> FloatArray:
        square = ((theta[:, :, None] - centre) ** 2).sum(axis=1) / sd**2
        return np.asarray(logsumexp(np.log(mass) - 0.5 * square - n_params * (np.log(sd) + 0.5 * LOG_2PI), axis=1))

    centres = np.broadcast_to(centre, (n_params, len(sd)))
    inside = np.log(ndtr((half - centres) / sd) - ndtr((-half - centres) / sd)).sum(axis=0)
    log_z = float(logsumexp(np.log(mass) + inside)) - n_params * math.log(2 * half)
    return Known(box(n_params, -half, half), function, log_z)


def nested_scales(n_params: int = 5, n_scales: int = 6) -> Known:
    """Spikes of sd 0.2 to 2e-4 within each other, every one with twice the mass of the one before it."""
    sd = 0.2 * 4.0 ** -np.arange(n_scales)
    # Each off the centre of the greater one, so that no two share an axis of symmetry.
    centre = np.concatenate([[0.0], 0.3 * np.cumsum(sd[:-1])])
    return gaussians(n_params, 1.0, centre, sd, 2.0 ** np.arange(n_scales))


def spike_on_slab(n_params: int = 20) -> Known:
    """Skilling's change of phase: a Gaussian of sd 0.1 and one of 0.01 with a hundred times its mass, 20-D."""
    return gaussians(n_params, 0.5, np.array([0.0, 0.031]), np.array([0.1, 0.01]), np.array([1.0, 100.0]))


# ------------------------------------------------------------------ several modes


def stripes(n_params: int = 4, n_stripes: int = 7) -> Known:
    """Disjoint stripes across a diagonal, of unequal height: a mixture along one rotated axis under normals."""
    turn = rotation(n_params)
    centre = np.linspace(-1.8, 1.8, n_stripes)
    sd = 0.003 * (1 + np.arange(n_stripes) % 3)
    log_height = np.log(1 + np.arange(n_stripes) % 4) - np.log(sd)

    def function(theta: FloatArray) -> FloatArray:
        turned = theta @ turn
        off = (turned[:, :1] - centre) / sd
        return np.asarray(logsumexp(log_height - 0.5 * off**2, axis=1) - 0.5 * ((turned[:, 1:] / 0.3) ** 2).sum(axis=1))

    variance = 1 + sd**2
    first = logsumexp(log_height + np.log(sd) - 0.5 * np.log(variance) - 0.5 * centre**2 / variance)
    each = math.log(0.3) - 0.5 * math.log(1.09)
    return Known(_normals(n_params), function, float(first) + (n_params - 1) * each)


def mixture(n_params: int = 12) -> Known:
    """Three Gaussians of different sds and places in [-5, 5]^n."""
    places = (np.full(n_params, -2.0), np.full(n_params, 1.0), np.where(np.arange(n_params) % 2, 3.0, -1.0))
    return gaussians(n_params, 5.0, np.stack(places, axis=1), np.array([0.3, 0.26, 0.22]), np.array([0.2, 0.3, 0.5]))


def needle_beside_hill(n_params: int = 6) -> Known:
    """A hill of sd 0.15 and, far from it, a peak half as wide with ninety times its mass, in [-1, 1]^n."""
    return gaussians(n_params, 1.0, np.array([-0.25, 0.6]), np.array([0.15, 0.075]), np.array([1.0, 90.0]))


def von_mises(n_params: int = 6, kappa: float = 30.0) -> Known:
    """Angles that peak where the circle is cut: 2^n corners of the cube [0, 2 pi]^n; Bessel's I0 a parameter."""

    def function(theta: FloatArray) -> FloatArray:
        return np.asarray(kappa * (np.cos(theta - 0.1) - 1).sum(axis=1))

    return Known(box(n_params, 0, 2 * math.pi), function, n_params * math.log(i0e(kappa)))


# ------------------------------------------------------------------ plateaus, priors, dimensions


def staircase(n_params: int = 6, n_steps: int = 40) -> Known:
    """Balls within balls, each step down a constant: radii and volumes are known."""
    radius = 0.9 ** np.arange(n_steps)

    def function(theta: FloatArray) -> FloatArray:
        r = np.linalg.norm(theta, axis=1)
        return np.asarray((r[:, None] < radius).sum(axis=1) * 0.8)

    log_ball = n_params / 2 * math.log(math.pi) - gammaln(n_params / 2 + 1) + n_params * np.log(radius)
    share = np.exp(log_ball - n_params * math.log(2))
    shells = np.concatenate([[1 - share[0]], share[:-1] - share[1:], share[-1:]])
    return Known(box(n_params, -1, 1), function, float(logsumexp(0.8 * np.arange(n_steps + 1) + np.log(shells))))


def ordered(n_params: int = 7) -> Known:
    """Parameters in order, else impossible (1 of n! of the prior), each with an exponential of rate 5 in [0, 1]."""
    rate = 5.0

    def function(theta: FloatArray) -> FloatArray:
        rising = (np.diff(theta, axis=1) > 0).all(axis=1)
        return np.where(rising, -rate * theta.sum(axis=1), -np.inf)

    each = math.log((1 - math.exp(-rate)) / rate)
    return Known(box(n_params, 0, 1), function, n_params * each - float(gammaln(n_params + 1)))


def two_of_twenty(n_params: int = 20) -> Known:
    """A thin eccentric ring in two parameters, and eighteen of which nothing is read."""
    radius, width, x, y = 0.3, 1e-3, 0.1, -0.2

    def function(theta: FloatArray) -> FloatArray:
        off = np.hypot(theta[:, 7] - x, theta[:, 13] - y) - radius
        return np.asarray(-0.5 * (off / width) ** 2)

    return Known(box(n_params, -1, 1), function, math.log(2 * math.pi * radius * width / 4) + 0.5 * LOG_2PI)


def hierarchical(n_groups: int = 12) -> Known:
    """Group means z of a population mu, tau, one reading each: the means fall out, two parameters are integrated."""
    rng = np.random.default_rng(5)
    sd = 0.5 + rng.random(n_groups)
    readings = 0.6 + 0.4 * rng.standard_normal(n_groups) + sd * rng.standard_normal(n_groups)

    def function(theta: FloatArray) -> FloatArray:
        mu, log_tau, z = theta[:, :1], theta[:, 1:2], theta[:, 2:]
        off = z - mu
        # The population's density is part of the likelihood: z is uniform in the prior.
        population = -0.5 * (off * np.exp(-log_tau)) ** 2 - log_tau - 0.5 * LOG_2PI
        read = -0.5 * ((readings - z) / sd) ** 2 - np.log(sd) - 0.5 * LOG_2PI
        return np.asarray((population + read).sum(axis=1))

    half, low, high = 20.0, -5.0, 1.5
    mu = np.linspace(-6, 6, 2401)
    log_tau = np.linspace(low, high, 2001)
    variance = sd**2 + np.exp(2 * log_tau)[:, None]
    out = np.zeros((len(log_tau), len(mu)))
    for k in range(n_groups):
        out += -0.5 * ((readings[k] - mu) ** 2 / variance[:, k : k + 1] + np.log(variance[:, k : k + 1]) + LOG_2PI)
    weight = np.full(len(log_tau), log_tau[1] - log_tau[0])
    weight[[0, -1]] /= 2  # trapezoids; over mu the integrand dies at both ends
    inner = logsumexp(out, axis=1) + math.log(mu[1] - mu[0])
    log_z = float(logsumexp(inner + np.log(weight))) - math.log(2 * 6.0) - math.log(high - low)
    prior = Product(
        {
            "mu": Uniform(-6.0, 6.0),
            "log_tau": Uniform(low, high),
            **{f"z{k}": Uniform(-half, half) for k in range(n_groups)},
        }
    )
    return Known(prior, function, log_z - n_groups * math.log(2 * half))


def many_dimensions(n_params: int = 30) -> Known:
    """Gaussians of sd 1e-3 to 0.3, half of them rotated together with the others under standard normals, 30-D."""
    turn = rotation(n_params)
    sd = np.logspace(-3, -0.5, n_params)

    def function(theta: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * ((theta @ turn / sd) ** 2).sum(axis=1))

    return Known(_normals(n_params), function, float((np.log(sd) - 0.5 * np.log1p(sd**2)).sum()))


def skew(n_params: int = 15, rate: float = 80.0) -> Known:
    """Half-open exponentials against a wall at unknown places: asymmetric, sharp on one side, in [0, 1]^n."""
    wall = np.linspace(0.2, 0.7, n_params)

    def function(theta: FloatArray) -> FloatArray:
        off = theta - wall
        return np.asarray((np.where(off > 0, -rate * off, 30 * rate * off)).sum(axis=1))

    up = -np.expm1(-rate * (1 - wall)) / rate
    down = -np.expm1(-30 * rate * wall) / (30 * rate)
    return Known(box(n_params, 0, 1), function, float(np.log(up + down).sum()))


HARD: dict[str, Callable[[], Known]] = {
    "linear ridge 8-D": linear_ridge,
    "bent ridge 8-D": bent_ridge,
    "bananas 12-D": bananas,
    "slab 8-D": slab,
    "product ridge 6-D": product_ridge,
    "Cauchy 10-D": cauchy,
    "Student 8-D": student,
    "funnel 10-D": funnel,
    "nested scales 5-D": nested_scales,
    "spike on slab 20-D": spike_on_slab,
    "stripes 4-D": stripes,
    "mixture 12-D": mixture,
    "needle beside hill 6-D": needle_beside_hill,
    "von Mises 6-D": von_mises,
    "staircase 6-D": staircase,
    "ordered 7-D": ordered,
    "two of twenty": two_of_twenty,
    "hierarchical 14-D": hierarchical,
    "many dimensions 30-D": many_dimensions,
    "skew 15-D": skew,
}

IN_TWO: dict[str, Callable[[], Known]] = {
    "linear ridge": partial(linear_ridge, 2, 0.005),
    "bent ridge": partial(bent_ridge, 2, 0.02),
    "bananas": partial(bananas, 1, 0.05),
    "slab": partial(slab, 2, 0.02),
    "product ridge": partial(product_ridge, 2, 0.05),
    "Cauchy": partial(cauchy, 2, 0.02),
    "Student": partial(student, 2, 0.02),
    "funnel": partial(funnel, 2),
    "nested scales": partial(nested_scales, 2, 2),
    "spike on slab": partial(spike_on_slab, 2),
    "stripes": partial(stripes, 2),
    "mixture": partial(mixture, 2),
    "needle beside hill": partial(needle_beside_hill, 2),
    "von Mises": partial(von_mises, 2),
    "staircase": partial(staircase, 2, 12),
    "ordered": partial(ordered, 2),
    "many dimensions": partial(many_dimensions, 2),
    "skew": partial(skew, 2, 20.0),
}
"""The families in two dimensions and coarse enough for a grid."""
