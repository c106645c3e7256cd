"""Problems whose evidence and posterior are known by another route, for tests and benchmarks.

`PROBLEMS` has them by name; `problem(name)` also makes "Gaussian 7-D" or "shells 3-D" in any number of
dimensions.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.special import gammaln, logsumexp, ndtr
from scipy.stats import loggamma, norm

from nested_sampling import ssf as ssf_problem
from probewise.priors import Prior, Product, Uniform

FloatArray = NDArray[np.float64]
Function = Callable[[FloatArray], FloatArray]

LOG_2PI = math.log(2 * math.pi)
REFERENCES = Path(__file__).with_name("references.json")


@dataclass(frozen=True, eq=False)
class Check:
    """A function of the parameters, (n_samples, n_params) -> (n_samples,), and its posterior mean."""

    name: str
    function: Function
    mean: float
    error: float = 0.0


@dataclass(frozen=True, eq=False)
class Known:
    """A problem, with the log of its evidence (and that number's own error), and posterior means to check.

    `n_live`: how many live points the benchmark gives every sampler; None: each its own default.
    `function` takes (n_samples, n_params).
    """

    prior: Prior
    function: Function
    log_z: float
    log_z_error: float = 0.0
    checks: tuple[Check, ...] = ()
    n_live: int | None = None

    @property
    def n_params(self) -> int:
        """Dimension."""
        return len(self.prior.names)

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Log likelihood of a batch, (n_samples, n_params) -> (n_samples,)."""
        return self.function(theta)


def box(n_params: int, low: float, high: float) -> Product:
    """Uniform in a cube."""
    return Product({f"p{i}": Uniform(low, high) for i in range(n_params)})


def in_box(
    n_params: int,
    low: float,
    high: float,
    function: Function,
    log_z: float,
    checks: Sequence[Check] = (),
) -> Known:
    """Pose an analytic problem in a cube; `function(theta)` reduces the last axis."""
    return Known(box(n_params, low, high), function, log_z, checks=tuple(checks))


def _coordinates(n_params: int, mean: Sequence[float]) -> list[Check]:
    """Check the posterior mean of every parameter."""
    return [Check(f"mean of p{i}", partial(_column, i), float(mean[i])) for i in range(n_params)]


def _column(i: int, theta: FloatArray) -> FloatArray:
    return theta[:, i]


def _squares(i: int, theta: FloatArray) -> FloatArray:
    return theta[:, i] ** 2


def reference(name: str) -> dict[str, Any]:
    """Read a problem's computed reference; an empty one where none has been computed."""
    table = json.loads(REFERENCES.read_text(encoding="utf-8")) if REFERENCES.exists() else {}
    found: dict[str, Any] = table.get(name, {})
    return found


# ------------------------------------------------------------------ analytic


def shells(n_params: int) -> Known:
    """Two Gaussian shells of radius 2 and width 0.1, centres 3.5 to either side; by radial quadrature."""
    width, radius, shift = 0.1, 2.0, 3.5

    def function(theta: FloatArray) -> FloatArray:
        rest = np.sum(theta[..., 1:] ** 2, axis=-1)
        left, right = (np.sqrt((theta[..., 0] + side * shift) ** 2 + rest) for side in (1, -1))
        heights = (-0.5 * ((r - radius) / width) ** 2 for r in (left, right))
        return np.logaddexp(*heights) - (0.5 * LOG_2PI + math.log(width))

    def moment(power: int) -> float:
        """Radial integral of r^(n_params - 1 + power)."""
        found = quad(
            lambda r: r ** (n_params - 1 + power) * norm.pdf(r, radius, width), 1.0, 3.0, points=[radius], epsabs=0
        )
        return float(found[0])

    def distance(theta: FloatArray) -> FloatArray:
        """Radius about the nearer centre: the shells are 3 apart, thirty widths."""
        return np.asarray(np.hypot(np.abs(theta[:, 0]) - shift, np.linalg.norm(theta[:, 1:], axis=1)))

    radial = moment(0)
    area = math.log(2) + n_params / 2 * math.log(math.pi) - gammaln(n_params / 2)
    log_z = math.log(2 * radial) + area - n_params * math.log(12)
    checks = [
        Check("share of one shell", lambda t: (t[:, 0] > 0).astype(float), 0.5),
        Check("radius", distance, moment(1) / radial),
        Check("mean of the last parameter", partial(_column, n_params - 1), 0.0),
        # On a shell no direction is preferred.
        Check("square of the last parameter", partial(_squares, n_params - 1), moment(2) / radial / n_params),
    ]
    return in_box(n_params, -6, 6, function, log_z, checks)


@cache
def eggbox() -> Known:
    """Eighteen equal peaks; the midpoint rule converges at once for a periodic function."""

    def function(theta: FloatArray) -> FloatArray:
        return (2 + np.cos(theta[..., 0] / 2) * np.cos(theta[..., 1] / 2)) ** 5

    grid = (np.arange(2000) + 0.5) / 2000 * 10 * math.pi
    values = (2 + np.cos(grid[:, None] / 2) * np.cos(grid / 2)) ** 5
    log_z = float(logsumexp(values))
    weight = np.exp(values - log_z)
    across = weight.sum(axis=1)
    checks = [
        *_coordinates(2, [float(across @ grid)] * 2),
        Check("square of p0", partial(_squares, 0), float(across @ grid**2)),
        Check(
            "share where both cosines are positive",
            lambda t: (np.cos(t[:, 0] / 2) > 0).astype(float),
            float(across[np.cos(grid / 2) > 0].sum()),
        ),
    ]
    return in_box(2, 0, 10 * math.pi, function, log_z - 2 * math.log(2000), checks)


def gaussian(n_params: int = 10, correlation: float = 0.9, half_width: float = 5.0) -> Known:
    """A correlated Gaussian in a box wide enough to hold all of it but 1e-5."""
    covariance = correlation * np.ones((n_params, n_params)) + (1 - correlation) * np.eye(n_params)
    inverse = np.linalg.inv(covariance)
    constant = float(-0.5 * (n_params * LOG_2PI + np.linalg.slogdet(covariance)[1]))

    def function(theta: FloatArray) -> FloatArray:
        return constant - 0.5 * np.sum((theta @ inverse) * theta, axis=-1)

    checks = _coordinates(n_params, [0.0] * n_params)
    checks.append(Check("square of p0", partial(_squares, 0), 1.0))
    if n_params > 1:
        checks.append(Check("p0 times p1", lambda t: t[:, 0] * t[:, 1], correlation))
    return in_box(n_params, -half_width, half_width, function, -n_params * math.log(2 * half_width), checks)


def rosenbrock_reference(n_params: int, n_grid: int = 4000) -> tuple[float, FloatArray]:
    """Integrate the curved valley: the integral is a chain of one-dimensional ones (a transfer matrix).

    Returns
    -------
    log Z on [-5, 5]^n_params, and the posterior mean of every parameter.
    """
    x = (np.arange(n_grid) + 0.5) / n_grid * 10 - 5
    kernel = np.exp(-100 * (x[None, :] - x[:, None] ** 2) ** 2 - (1 - x[:, None]) ** 2) / n_grid
    forward, backward = [np.full(n_grid, 1 / n_grid)], [np.ones(n_grid)]
    for _ in range(n_params - 1):
        forward.append(forward[-1] @ kernel)
        backward.append(kernel @ backward[-1])
    backward.reverse()
    mean = np.array([(f * b) @ x / (f @ b) for f, b in zip(forward, backward, strict=True)])
    return float(np.log(forward[-1].sum())), mean


def rosenbrock(n_params: int) -> Known:
    """A curved valley in [-5, 5]^n_params; its reference is in `references.json` for 2 and 5 parameters."""

    def function(theta: FloatArray) -> FloatArray:
        a, b = theta[..., :-1], theta[..., 1:]
        return -np.sum(100 * (b - a**2) ** 2 + (1 - a) ** 2, axis=-1)

    stored = reference(f"Rosenbrock {n_params}-D")
    log_z, mean = (stored["log_z"], stored["mean"]) if stored else rosenbrock_reference(n_params)
    return in_box(n_params, -5, 5, function, float(log_z), _coordinates(n_params, list(mean)))


def log_gamma(n_params: int = 20) -> Known:
    """Four modes with heavy tails: products of log-gamma and normal densities (Beaujean & Caldwell 2013)."""
    s, half = 1 / 30, (n_params + 2) // 2

    def tail(z: FloatArray) -> FloatArray:
        return z - np.exp(z) - math.log(s)

    def bell(z: FloatArray) -> FloatArray:
        return -0.5 * z * z - (0.5 * LOG_2PI + math.log(s))

    def function(theta: FloatArray) -> FloatArray:
        low, high = (theta - 1 / 3) / s, (theta - 2 / 3) / s
        out = np.logaddexp(tail(low[..., 0]), tail(high[..., 0]))
        out = out + np.logaddexp(bell(low[..., 1]), bell(high[..., 1])) - 2 * math.log(2)
        return out + np.sum(tail(high[..., 2:half]), axis=-1) + np.sum(bell(high[..., half:]), axis=-1)

    def share(distribution: Any, centre: float) -> float:
        return float(distribution.cdf((1 - centre) / s) - distribution.cdf(-centre / s))

    def mean(distribution: Any, *centres: float) -> float:
        """Mean of a mixture of the distribution at these centres, cut off at the cube's faces."""
        parts = [
            quad(lambda x, c=c: x * distribution.pdf((x - c) / s) / s, 0, 1, points=[c], limit=200)[0] for c in centres
        ]
        return float(sum(parts) / sum(share(distribution, c) for c in centres))

    g, n = loggamma(1.0), norm()
    low, high = 1 / 3, 2 / 3
    log_z = (
        math.log(share(g, low) + share(g, high))
        + math.log(share(n, low) + share(n, high))
        - 2 * math.log(2)
        + (half - 2) * math.log(share(g, high))
        + (n_params - half) * math.log(share(n, high))
    )
    means = [mean(g, low, high), mean(n, low, high)]
    means += [mean(g, high)] * (half - 2) + [mean(n, high)] * (n_params - half)
    middle = 0.5
    checks = [
        *_coordinates(n_params, means),
        Check("share of the upper mode of p1", lambda t: (t[:, 1] > middle).astype(float), 0.5),
    ]
    return in_box(n_params, 0, 1, function, log_z, checks)


def plateau() -> Known:
    """Three flat terraces and a peak in the unit square: 0.6 of the volume at 0, 0.3 at 2, the rest a cone from 4."""

    def function(theta: FloatArray) -> FloatArray:
        x = theta[..., 0]
        return np.where(x < 0.6, 0.0, np.where(x < 0.9, 2.0, 4.0 + 20.0 * (x - 0.9)))

    peak = math.exp(4) * (math.exp(2) - 1) / 20
    z = 0.6 + 0.3 * math.exp(2) + peak
    checks = [
        Check("share of the lowest terrace", lambda t: (t[:, 0] < 0.6).astype(float), 0.6 / z),
        Check("share of the peak", lambda t: (t[:, 0] >= 0.9).astype(float), peak / z),
        Check("mean of p1", partial(_column, 1), 0.5),
    ]
    return in_box(2, 0, 1, function, math.log(z), checks)


def slab_and_spike(n_params: int = 5) -> Known:
    """A Gaussian of sd 0.1 and one of sd 0.01 with a hundred times its mass, around one centre."""
    wide, narrow = 0.1, 0.01

    def function(theta: FloatArray) -> FloatArray:
        square = np.sum((theta - 0.5) ** 2, axis=-1)
        slab = -0.5 * square / wide**2 - n_params * (0.5 * LOG_2PI + math.log(wide))
        spike = -0.5 * square / narrow**2 - n_params * (0.5 * LOG_2PI + math.log(narrow)) + math.log(100)
        return np.logaddexp(slab, spike)

    inside = (1 - 2 * norm.sf(0.5 / wide)) ** n_params
    # The slab's variance in the box, five of its sd to either side, is its own but for 1.5e-5.
    square = n_params * (inside * wide**2 + 100 * narrow**2) / (inside + 100)
    checks = [
        Check("squared distance", lambda t: ((t - 0.5) ** 2).sum(axis=1), square),
        *_coordinates(n_params, [0.5] * n_params),
    ]
    return in_box(n_params, 0, 1, function, math.log(inside + 100), checks)


@cache
def naive_steps() -> Known:
    """Four readings of a disc's presence: nothing but plateaus, the highest of them a lens."""
    grid = (np.arange(800) + 0.5) / 800
    places = np.array([[0.45, 0.5], [0.75, 0.5], [0.6, 0.2], [0.2, 0.9]])
    seen = np.array([1.0, 1.0, 0.0, 0.0])

    def function(theta: FloatArray) -> FloatArray:
        inside = np.sum((theta[..., None, :] - places) ** 2, axis=-1) < 0.04
        return -0.5 * np.sum(((inside - seen) / 0.2) ** 2, axis=-1)

    square = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    height = function(square)
    log_z = float(logsumexp(height))
    mean = np.exp(height - log_z) @ square
    return in_box(2, 0, 1, function, log_z - math.log(len(square)), _coordinates(2, list(mean)))


def mixture_of_far_peaks(n_params: int = 5) -> Known:
    """Two peaks of masses 1 and 3, twenty sd apart: a sampler that loses one is wrong by ln 4 or ln 4/3."""
    low, high, sd = 0.3, 0.7, 0.02

    def function(theta: FloatArray) -> FloatArray:
        constant = -n_params * (0.5 * LOG_2PI + math.log(sd))
        a, b = (-0.5 * np.sum(((theta - centre) / sd) ** 2, axis=-1) for centre in (low, high))
        return np.logaddexp(a + math.log(0.25), b + math.log(0.75)) + constant

    checks = [
        Check("share of the greater peak", lambda t: (t[:, 0] > 0.5).astype(float), 0.75),
        *_coordinates(n_params, [0.25 * low + 0.75 * high] * n_params),
    ]
    return in_box(n_params, 0, 1, function, 0.0, checks)


# ------------------------------------------------------------------ the paper's two problems

_ARC_NODES, _ARC_WEIGHTS = leggauss(20)
_SD_U, _SD_V, _CORRELATION, _U, _V = ssf_problem.SD_U, ssf_problem.SD_V, ssf_problem.CORRELATION, 0.0, ssf_problem.V


def disc_seen(x: FloatArray, y: FloatArray, cx: FloatArray, cy: FloatArray, r: FloatArray) -> FloatArray:
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
        density = np.exp(-0.5 * (rows / _SD_V) ** 2) / (_SD_V * math.sqrt(2 * math.pi))
        out[near] = (density * inside) @ _ARC_WEIGHTS * half[:, 0]
    return out


def circle() -> Known:
    """Find a circle from 20 readings of noise sd 1; 61 % of the prior lies on plateaus. By adaptive quadrature."""
    rng = np.random.default_rng(7)
    cx, cy, r = 430.0, 270.0, 82.0
    far = rng.uniform([0, 0], [1048, 520], (10, 2))
    turn, reach = rng.uniform(0, 2 * np.pi, 10), r + rng.normal(0, 4, 10)
    places = np.concatenate([far, np.stack([cx + reach * np.cos(turn), cy + reach * np.sin(turn)], axis=-1)])
    dark, bright = ssf_problem.DARK, ssf_problem.BRIGHT

    def predicted(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
        return dark + (bright - dark) * disc_seen(places[:, 0], places[:, 1], a, b, c)

    readings = predicted(np.array([cx]), np.array([cy]), np.array([r])) + rng.standard_normal(20)

    def function(theta: FloatArray) -> FloatArray:
        residual = predicted(*(theta[:, i : i + 1] for i in range(3))) - readings
        return np.asarray(-0.5 * (residual**2).sum(axis=1) - 10 * LOG_2PI)

    prior = Product({"x_mm": Uniform(0, 1048), "y_mm": Uniform(0, 520), "radius_mm": Uniform(20, 150)})
    stored = reference("circle")
    checks = [
        Check(f"mean of {name}", partial(_column, i), float(stored["mean"][i]))
        for i, name in enumerate(prior.names)
        if stored
    ]
    return Known(prior, function, float(stored.get("log_z", math.nan)), checks=tuple(checks))


def ssf(n_gaussians: int) -> Known:
    """Estimate an SSF of so many Gaussians: the likelihood that `probewise calibrate` uses; see `ssf.py`."""
    name = ssf_name(n_gaussians)
    problem = ssf_problem.problem(n_gaussians)
    stored = reference(name)
    means: dict[str, Sequence[float]] = stored.get("mean", {})
    checks = [
        Check(key, partial(ssf_problem.moment, key), float(means[key][0]), float(means[key][1]))
        for key in ssf_problem.MOMENTS
        if key in means
    ]
    return Known(
        problem.prior,
        problem.log_likelihood,
        float(stored.get("log_z", math.nan)),
        float(stored.get("log_z_error", math.nan)),
        tuple(checks),
        n_live=300,
    )


def ssf_name(n_gaussians: int) -> str:
    """Name an SSF problem."""
    return f"SSF {n_gaussians} Gaussian" + ("s" if n_gaussians > 1 else "")


PROBLEMS: dict[str, Callable[[], Known]] = {
    "shells 2-D": partial(shells, 2),
    "shells 10-D": partial(shells, 10),
    "eggbox": eggbox,
    "Gaussian 10-D": gaussian,
    "Rosenbrock 2-D": partial(rosenbrock, 2),
    "Rosenbrock 5-D": partial(rosenbrock, 5),
    "LogGamma 2-D": partial(log_gamma, 2),
    "LogGamma 10-D": partial(log_gamma, 10),
    "LogGamma 20-D": log_gamma,
    "plateau": plateau,
    "slab and spike": slab_and_spike,
    "naive steps": naive_steps,
    "two far peaks": mixture_of_far_peaks,
    "circle": circle,
    **{ssf_name(n): partial(ssf, n) for n in (1, 2, 3, 4)},
}

_FAMILIES: dict[str, Callable[[int], Known]] = {
    "Gaussian": gaussian,
    "shells": shells,
    "Rosenbrock": rosenbrock,
    "LogGamma": log_gamma,
    "two far peaks": mixture_of_far_peaks,
}


def problem(name: str) -> Known:
    """Make a problem by its name; families such as "Gaussian 7-D" in any number of dimensions.

    Raises
    ------
    ValueError
        If there is no such problem.
    """
    if name in PROBLEMS:
        return PROBLEMS[name]()
    found = re.fullmatch(r"(.+) (\d+)-D", name)
    if found and found[1] in _FAMILIES:
        return _FAMILIES[found[1]](int(found[2]))
    raise ValueError(f"problem is {name!r}; allowed: {', '.join(PROBLEMS)}, or {', '.join(_FAMILIES)} with ' n-D'")
