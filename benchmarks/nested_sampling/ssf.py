"""The paper's problem: the SSF of a light sensor as N Gaussians, from four scans across an edge and four quadrants.

Priors, all uniform: a 0 to 1; u, v -10 to 10 mm; A, B 0.003 to 0.5 mm^-2; C within 0.98 sqrt(A B); I_min 0 to 20,
I_max 40 to 80. No ordering: N! labellings of each footprint. `problem` is what `probewise calibrate` samples;
`Direct` writes the same likelihood down a second time, from the formulas.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray
from scipy.special import ndtr

from probewise.calibration import SSFPrior, problem_for
from probewise.inference import SensorProblem, sd_ceiling, sd_floor
from probewise.priors import Uniform
from probewise.recordings import Plan, Quadrant, Recording, paper_plan

FloatArray = NDArray[np.float64]

# The sensor that made the readings: one Gaussian, sds and centre in mm, levels and noise in LEGO units.
SD_U, SD_V, CORRELATION, U, V = 4.0, 2.5, 0.2, 0.0, 1.5
DARK, BRIGHT, NOISE = 10.0, 60.0, 0.6
_SEED = 20130101

MAX_CORRELATION = 0.98
OFFSET, PRECISION, I_MIN, I_MAX = (-10.0, 10.0), (0.003, 0.5), (0.0, 20.0), (40.0, 80.0)


def prior(n_gaussians: int) -> SSFPrior:
    """Believe what the paper does: uniform priors of a, A and B themselves."""
    return SSFPrior(
        n_gaussians=n_gaussians,
        offset_mm=Uniform(*OFFSET),
        precision=Uniform(*PRECISION),
        i_min=Uniform(*I_MIN),
        i_max=Uniform(*I_MAX),
        amplitude=Uniform(0.0, 1.0),
        unit_mass_mm2=None,
        max_correlation=MAX_CORRELATION,
    )


def plan(n_per_scan: int = 101) -> Plan:
    """Lay out the paper's plan, its scans over the same 100 mm with so many readings each."""
    paper = paper_plan()
    if n_per_scan == 101:
        return paper
    rows = np.concatenate(
        [
            scan[np.round(np.linspace(0, len(scan) - 1, n_per_scan)).astype(int)] if len(scan) > 4 else scan
            for scan in paper.rows_by_scan()
        ]
    )
    taken = paper.take(rows)
    x_mm = taken.x_mm.copy()
    for scan in taken.rows_by_scan():
        if len(scan) > 4:
            x_mm[scan] = np.linspace(-50.0, 50.0, len(scan))
    return replace(taken, x_mm=x_mm)


def recording(n_per_scan: int = 101) -> Recording:
    """Simulate the readings of the sensor above, by the formulas of `Direct` and not by the package's chain."""
    layout = plan(n_per_scan)
    var_u, var_v, cov = SD_U**2, SD_V**2, CORRELATION * SD_U * SD_V
    a, b, c = np.linalg.inv([[var_u, cov], [cov, var_v]])[[0, 1, 0], [0, 1, 1]] / 2
    theta = np.array([[1.0, U, V, a, b, c, DARK, BRIGHT]])
    noise = NOISE * np.random.default_rng(_SEED).standard_normal(len(layout))
    silent = Recording(layout, np.zeros(len(layout)))
    return Recording(layout, Direct(silent).predicted(theta)[0] + noise)


def problem(n_gaussians: int, *, n_per_scan: int = 101) -> SensorProblem:
    """Pose the calibration as `probewise.calibration.calibrate` does, with the paper's priors."""
    return problem_for(recording(n_per_scan), prior(n_gaussians))


class Direct:
    """The likelihood of a recording over an edge and quadrants, written from the formulas alone.

    An edge sees ndtr of the distance over the projected sd, a quadrant the bivariate normal integral
    (Drezner & Wesolowsky 1990), a scan's noise level is integrated by Gauss and Legendre's rule in ln sigma.
    """

    def __init__(self, recording: Recording) -> None:
        layout = recording.plan
        self._readings = recording.readings
        self._floor, self._ceiling = sd_floor(recording), sd_ceiling(recording)
        self._scans = layout.rows_by_scan()
        names = np.array(layout.pattern_names)[layout.pattern]
        self._edge = np.flatnonzero(names == "boundary")
        self._quadrants: list[tuple[int, Quadrant]] = []
        for row in np.flatnonzero(names != "boundary").tolist():
            pattern = layout.patterns[names[row]]
            if not isinstance(pattern, Quadrant):
                raise ValueError(f"pattern {names[row]!r} is {pattern}; allowed: the boundary and quadrants")
            self._quadrants.append((row, pattern))
        turn = layout.orientation_rad[self._edge]
        self._x, self._cos, self._sin = layout.x_mm[self._edge], np.cos(turn), np.sin(turn)
        self._quadrant_x, self._quadrant_y = layout.x_mm, layout.y_mm

    def predicted(self, theta: Any) -> Any:
        """Readings without noise, edges first, then quadrants (the plan's order), (..., n_params) -> (..., n)."""
        g = np.reshape(theta[..., :-2], (*theta.shape[:-1], -1, 6))
        a, u, v, p, q, c = (g[..., i] for i in range(6))
        det = p * q - c * c
        mass = a / np.sqrt(det)
        weight = mass / np.sum(mass, axis=-1, keepdims=True)
        var_u, var_v, cov = q / det / 2, p / det / 2, -c / det / 2
        # The edge stands along y; x' and y' of the sensor project on x with cos and -sin of its turn.
        cos, sin = self._cos, self._sin
        u1, v1, uu, vv, uv = (m[..., None] for m in (u, v, var_u, var_v, cov))
        distance = self._x + cos * u1 - sin * v1
        sd = np.sqrt(cos**2 * uu + sin**2 * vv - 2 * cos * sin * uv)
        parts = [np.sum(weight[..., None] * ndtr(distance / sd), axis=-2)]
        su, sv = np.sqrt(var_u), np.sqrt(var_v)
        for row, pattern in self._quadrants:
            (x, y), (to_x, to_y) = pattern.corner_mm, pattern.direction
            h = to_x * (x - self._quadrant_x[row] - u) / su
            k = to_y * (y - self._quadrant_y[row] - v) / sv
            both = _upper_quadrant(h, k, to_x * to_y * cov / (su * sv))
            parts.append(np.sum(weight * both, axis=-1)[..., None])
        seen = np.concatenate(parts, axis=-1)
        dark, bright = theta[..., -2:-1], theta[..., -1:]
        return dark + (bright - dark) * seen

    def log_likelihood(self, theta: Any) -> Any:
        """Log likelihood with every constant, (..., n_params) -> (...)."""
        residual = self.predicted(theta) - self._readings[self._order]
        total: Any = 0.0
        for rows in self._columns:
            total = total + self._integrated(np.sum(residual[..., rows] ** 2, axis=-1), len(rows))
        return total

    @cached_property
    def _order(self) -> NDArray[np.int64]:
        return np.concatenate([self._edge, np.array([row for row, _ in self._quadrants], dtype=np.int64)])

    @cached_property
    def _columns(self) -> list[NDArray[np.int64]]:
        """Columns of `predicted` that belong to each scan."""
        return [np.flatnonzero(np.isin(self._order, rows)) for rows in self._scans]

    def _integrated(self, square: Any, n: int) -> Any:
        """Log of the integral over sigma of its 1/sigma prior and n Gaussian densities with this sum of squares."""
        low, high = math.log(self._floor), math.log(self._ceiling)
        width = 1 / math.sqrt(2 * n)
        peak = np.clip(0.5 * np.log(square / n + 1e-300), low, high)
        start, end = np.maximum(low, peak - 12 * width), np.minimum(high, peak + 12 * width + 20 / n)
        half = (end - start) / 2
        log_sigma = (start + end)[..., None] / 2 + half[..., None] * _NODES
        height = -n * log_sigma - 0.5 * square[..., None] * np.exp(-2 * log_sigma)
        most = np.max(height, axis=-1, keepdims=True)
        integral = np.sum(np.exp(height - most) * _WEIGHTS, axis=-1) * half
        return most[..., 0] + np.log(integral) - 0.5 * n * math.log(2 * math.pi) - math.log(high - low)


_NODES, _WEIGHTS = leggauss(40)


def _upper_quadrant(h: Any, k: Any, r: Any) -> Any:
    """Probability that two standard normals of correlation r exceed h and k, all of one shape."""
    angle = np.arcsin(r)
    sine = np.sin(0.5 * angle[..., None] * (_NODES + 1))
    exponent = (h * h + k * k)[..., None] - 2 * (h * k)[..., None] * sine
    integral = np.sum(np.exp(-exponent / 2 / (1 - sine**2)) * _WEIGHTS, axis=-1)
    return ndtr(-h) * ndtr(-k) + angle / (4 * math.pi) * integral


MOMENTS = ("centroid x'", "centroid y'", "log sd x'", "log sd y'", "I_min", "I_max")


def moment(name: str, theta: FloatArray) -> FloatArray:
    """Compute one of `MOMENTS` of each footprint: functions that no relabelling of the Gaussians changes."""
    if name in ("I_min", "I_max"):
        return theta[:, -2 if name == "I_min" else -1]
    g = theta[:, :-2].reshape(len(theta), -1, 6)
    a, u, v, p, q, c = np.moveaxis(g, 2, 0)
    det = p * q - c * c
    weight = a / np.sqrt(det)
    weight = weight / weight.sum(axis=1, keepdims=True)
    where, variance = (u, q / det / 2) if name.endswith("x'") else (v, p / det / 2)
    centre = (weight * where).sum(axis=1)
    if name.startswith("centroid"):
        return np.asarray(centre)
    spread = (weight * (variance + (where - centre[:, None]) ** 2)).sum(axis=1)
    return np.asarray(0.5 * np.log(spread))
