"""Priors of the SSF and the levels: proper, with bounds from scan step, span and range of the readings.

The paper assigns uniform priors and prints no bounds. A uniform prior of A and B puts almost all of its mass on
footprints narrower than a few steps (sd = (2 A)^(-1/2), so half of a uniform A lies within a factor 1.4 of the smallest
sd), and the evidence of an order then depends on the bounds. Here the order of magnitude of a width is unknown, so A
and B are log-uniform, with bounds from what the scans can resolve and contain. Likewise, with a uniform amplitude a, a
narrow Gaussian has almost no mass, so a superfluous Gaussian can be narrow at little cost in evidence; here the mass of
a Gaussian, a pi / sqrt(A B - C^2), is uniform. `paper_prior` is uniform in a and in (A, B, C).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from probewise._arrays import FloatArray, rounding_error
from probewise.errors import require
from probewise.priors import LogUniform, Marginal, Uniform, checked_columns
from probewise.recordings import HalfPlane, Ramp, Recording, Stripes
from probewise.recordings import Uniform as UniformPattern
from probewise.scene import KnownScene

_MAX_CORRELATION = 0.98
_SAME_AXIS = 0.01  # chord of the doubled angle; it equals 0.3 degrees
_TINY = float(np.finfo(float).tiny)
_AMPLITUDE = Uniform(0.0, 1.0)


@dataclass(frozen=True)
class SquareRoot:
    """Density proportional to the square root of the value, from `low` >= 0 to `high`.

    With C uniform on (-r sqrt(A B), r sqrt(A B)), it makes (A, B, C) uniform over the volume that they leave to C.
    """

    low: float
    high: float

    def from_unit(self, u: FloatArray) -> FloatArray:
        """Evaluate the quantile function, any shape."""
        low, high = self.low**1.5, self.high**1.5
        return np.asarray((low + (high - low) * u) ** (2 / 3))

    def to_unit(self, value: FloatArray) -> FloatArray:
        """Evaluate the cumulative distribution function, any shape."""
        low, high = self.low**1.5, self.high**1.5
        return np.asarray((np.clip(value, self.low, self.high) ** 1.5 - low) / (high - low))

    def log_prob(self, value: FloatArray) -> FloatArray:
        """Return the natural log of the density, any shape; -inf outside the bounds."""
        inside = (value >= self.low) & (value <= self.high)
        safe = np.where(inside, value, self.high)
        constant = math.log(1.5 / (self.high**1.5 - self.low**1.5))
        return np.where(inside, 0.5 * np.log(safe) + constant, -np.inf)

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g}, density proportional to the square root"


@dataclass(frozen=True)
class PriorRow:
    """One row of the report's table of priors, in words: parameter, unit, distribution and reason of the bounds."""

    parameter: str
    unit: str
    distribution: str
    reason: str


@dataclass(frozen=True)
class SSFPrior:
    """Independent, identical priors of `n_gaussians` Gaussians, and priors of the two levels (paper, 6 N + 2).

    The Gaussians are exchangeable: no ordering is imposed, and the evidence of the order counts all N! labellings of a
    footprint, as it must. C = r sqrt(A B) with r uniform on (-max_correlation, max_correlation), so every draw is
    positive definite.

    Parameters
    ----------
    n_gaussians
        Number of Gaussians in the SSF.
    offset_mm
        Prior of each centre coordinate u, v in the sensor frame.
    precision
        Prior of A and of B, mm^-2; the conditional sd of the Gaussian along x' is (2 A)^(-1/2).
    i_min, i_max
        Priors of the readings over albedo 0 and 1, in the reading's unit.
    amplitude
        Prior of each Gaussian's mass in units of pi `unit_mass_mm2`, that is of a / (unit_mass_mm2 sqrt(A B - C^2));
        the readings depend only on ratios.
    unit_mass_mm2
        That unit, mm^2; if `None`, `amplitude` is the prior of a itself, as in the paper.
    max_correlation
        Largest abs(C) / sqrt(A B), below 1.
    reasons
        Why each bound has its value, for the report: pairs of "offset_mm", "precision" or "levels" and words.

    Raises
    ------
    ParameterError
        If `n_gaussians`, `max_correlation` or `unit_mass_mm2` is out of range.
    """

    n_gaussians: int
    offset_mm: Marginal
    precision: Marginal
    i_min: Marginal
    i_max: Marginal
    amplitude: Marginal = _AMPLITUDE
    unit_mass_mm2: float | None = None
    max_correlation: float = _MAX_CORRELATION
    reasons: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        require(self.n_gaussians >= 1, "n_gaussians", self.n_gaussians, "1 or more")
        require(0 < self.max_correlation < 1, "max_correlation", self.max_correlation, "above 0, below 1")
        is_mass = self.unit_mass_mm2 is None or self.unit_mass_mm2 > 0
        require(is_mass, "unit_mass_mm2", self.unit_mass_mm2, "greater than 0, or None")

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Parameter names in the sensor's order: a_1, u_1, v_1, A_1, B_1, C_1, ..., I_min, I_max."""
        gaussians = (f"{p}_{n}" for n in range(1, self.n_gaussians + 1) for p in ("a", "u", "v", "A", "B", "C"))
        return (*gaussians, "I_min", "I_max")

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        """Map the unit cube to parameters, both (n_samples, 6 N + 2)."""
        u = checked_columns(u, self.names)
        out = np.empty(u.shape)
        g, x = view_by_kind_and_gaussian(out), view_by_kind_and_gaussian(u)
        g[1:3], g[3:5] = self.offset_mm.from_unit(x[1:3]), self.precision.from_unit(x[3:5])
        g[5] = self.max_correlation * (2 * x[5] - 1) * np.sqrt(g[3] * g[4])
        g[0] = self.amplitude.from_unit(x[0]) * self.amplitude_at_unit_mass(g[3] * g[4] - g[5] ** 2)
        out[:, -2], out[:, -1] = self.i_min.from_unit(u[:, -2]), self.i_max.from_unit(u[:, -1])
        return out

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        """Map parameters to the unit cube, both (n_samples, 6 N + 2)."""
        theta = checked_columns(theta, self.names)
        out = np.empty(theta.shape)
        x, g = view_by_kind_and_gaussian(out), view_by_kind_and_gaussian(theta)
        product = g[3] * g[4]
        x[0] = self.amplitude.to_unit(g[0] / self.amplitude_at_unit_mass(product - g[5] ** 2))
        x[1:3], x[3:5] = self.offset_mm.to_unit(g[1:3]), self.precision.to_unit(g[3:5])
        x[5] = np.clip(0.5 + 0.5 * g[5] / (self.max_correlation * np.sqrt(product)), 0.0, 1.0)
        out[:, -2], out[:, -1] = self.i_min.to_unit(theta[:, -2]), self.i_max.to_unit(theta[:, -1])
        return out

    def log_prob(self, theta: FloatArray) -> FloatArray:
        """Natural log of the density, (n_samples, 6 N + 2) -> (n_samples,); -inf outside the support."""
        theta = checked_columns(theta, self.names)
        # One contiguous row per kind of parameter, for speed.
        return self.log_prob_by_kind(np.ascontiguousarray(view_by_kind_and_gaussian(theta)), theta[:, -2], theta[:, -1])

    def log_prob_by_kind(self, g: FloatArray, i_min: FloatArray, i_max: FloatArray) -> FloatArray:
        """Return `log_prob`, (n_samples,), of parameters by kind (a, u, v, A, B, C), (6, N, n_samples), and levels."""
        precisions = np.maximum(g[3:5], 0.0)
        product, c = precisions[0] * precisions[1], g[5]
        scale = np.sqrt(product)
        inside = (scale > 0) & (np.abs(c) <= self.max_correlation * (1 + 1e-12) * scale)
        a_scale = self.amplitude_at_unit_mass(product - c * c)
        each = self.amplitude.log_prob(g[0] / a_scale) - np.log(np.maximum(a_scale * scale, _TINY))
        offset, precision = self.offset_mm.log_prob(g[1:3]), self.precision.log_prob(g[3:5])
        each += (offset[0] + offset[1]) + (precision[0] + precision[1])
        each -= math.log(2 * self.max_correlation)
        each[~inside] = -np.inf
        return np.asarray(each.sum(axis=0) + (self.i_min.log_prob(i_min) + self.i_max.log_prob(i_max)))

    @property
    def coordinates(self) -> MomentCoordinates:
        """The sampling coordinates for nested sampling."""
        return MomentCoordinates(self)

    def table_rows(self) -> tuple[PriorRow, ...]:
        """Return the rows of the report's table of priors, one per kind of parameter."""
        why, mass, ratios = dict(self.reasons), "", "readings depend only on ratios"
        if self.unit_mass_mm2 is not None:
            mass = f" times {self.unit_mass_mm2:.3g} sqrt(A_n B_n - C_n^2)"
            ratios = f"the mass of each Gaussian is uniform; {ratios}"
        within = f"uniform -{self.max_correlation:g} to {self.max_correlation:g} times sqrt(A_n B_n)"
        rows = (
            ("a_n", "1", f"{self.amplitude}{mass}", ratios),
            ("u_n, v_n", "mm", str(self.offset_mm), why.get("offset_mm", "given")),
            ("A_n, B_n", "mm^-2", str(self.precision), why.get("precision", "given")),
            ("C_n", "mm^-2", within, "every draw is positive definite"),
            ("I_min", "reading", str(self.i_min), why.get("levels", "given")),
            ("I_max", "reading", str(self.i_max), why.get("levels", "given")),
        )
        return tuple(PriorRow(*row) for row in rows)

    def amplitude_at_unit_mass(self, determinant: FloatArray) -> FloatArray:
        """Return the amplitude a of a Gaussian of mass pi `unit_mass_mm2`, for its A B - C^2; any shape in and out.

        It is 1 if the prior is of a (`unit_mass_mm2` None).
        """
        if self.unit_mass_mm2 is None:
            return np.ones_like(determinant)
        return self.unit_mass_mm2 * np.sqrt(np.maximum(determinant, _TINY))


@dataclass(frozen=True)
class MomentCoordinates:
    """Moments of a mixture as sampling coordinates, each determined by few readings (`probewise.priors.Coordinates`).

    A scan across an edge determines the variance along its direction, which is a nonlinear combination of A, B and C.
    Here the coordinates of each Gaussian are its centre, the log variances along x' and y', and the inverse hyperbolic
    tangent of its correlation. The first Gaussian also has its log amplitude in the prior's unit and, instead of its
    own centre, that of the whole footprint; the others have the log ratio of their mass to the first one's. I_min and
    I_max follow.

    The Gaussians are sorted by mass, greatest first, and the prior's density is multiplied by N!: the readings do not
    depend on the labels, so N! equal modes become one and the evidence is unchanged.
    """

    prior: SSFPrior

    def enter(self, theta: FloatArray) -> FloatArray:
        """Map parameters to coordinates, both (n_samples, 6 N + 2)."""
        n = self.prior.n_gaussians
        g = theta[:, : 6 * n].reshape(len(theta), n, 6)
        det = g[..., 3] * g[..., 4] - g[..., 5] ** 2
        log_mass = np.log(g[..., 0]) - 0.5 * np.log(det)
        order = np.argsort(-log_mass, axis=1)
        g = np.take_along_axis(g, order[..., None], axis=1)
        det, log_mass = (np.take_along_axis(a, order, axis=1) for a in (det, log_mass))
        out = np.empty_like(g)
        out[:, 0, 0] = np.log(g[:, 0, 0] / self.prior.amplitude_at_unit_mass(det[:, 0]))
        out[:, 1:, 0] = log_mass[:, 1:] - log_mass[:, :1]
        out[..., 1:3] = g[..., 1:3]
        out[..., 3] = np.log(0.5 * g[..., 4] / det)
        out[..., 4] = np.log(0.5 * g[..., 3] / det)
        out[..., 5] = np.arctanh(-g[..., 5] / np.sqrt(g[..., 3] * g[..., 4]))
        masses = np.concatenate([np.ones((len(out), 1)), np.exp(np.clip(out[:, 1:, 0], -100.0, 0.0))], axis=1)
        out[:, 0, 1:3] = np.einsum("nk,nkj->nj", masses / masses.sum(axis=1, keepdims=True), g[..., 1:3])
        return np.concatenate([out.reshape(len(theta), 6 * n), theta[:, 6 * n :]], axis=1)

    def leave(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates to parameters, (n_samples, 6 N + 2); also return the log prior density, (n_samples,).

        It is the density in the coordinates, -inf where the Gaussians are not sorted.
        """
        n = self.prior.n_gaussians
        # One contiguous row per kind of coordinate, for speed.
        g = np.ascontiguousarray(view_by_kind_and_gaussian(x))
        # A sampler may try extreme values, which must not overflow.
        log_variance = g[3:5].clip(-100.0, 100.0)
        log_first, log_ratio = g[0, 0].clip(-100.0, 50.0), g[0, 1:].clip(-100.0, 0.0)
        r = np.tanh(g[5])
        rest = np.maximum(1.0 - r * r, 1e-12)
        log_rest, both = np.log(rest), log_variance[0] + log_variance[1]
        out = np.empty_like(g)
        np.divide(0.5 * np.exp(-log_variance), rest, out=out[3:5])
        product = out[3] * out[4]
        np.multiply(-r, np.sqrt(product), out=out[5])
        log_a = np.log(self.prior.amplitude_at_unit_mass(product[0] * rest[0])) + log_first
        # The others' masses follow from the first one's: a = mass times the root of A B - C^2.
        half_log_det = -0.5 * (both + log_rest)
        log_a = np.concatenate([log_a[None], log_ratio + (log_a - half_log_det[0]) + half_log_det[1:]])
        np.exp(log_a, out=out[0])
        ratio = np.exp(log_ratio)
        whole = 1.0 + ratio.sum(axis=0)
        out[1:3] = g[1:3]
        out[1:3, 0] += (ratio * (g[1:3, :1] - g[1:3, 1:])).sum(axis=1)
        theta = x.copy()
        view_by_kind_and_gaussian(theta)[...] = out
        # d(A, B, C) / d(log variances, arctanh r), d a / d log a, and the first centre from that of the whole.
        jacobian = log_a - 1.5 * both - 2.0 * log_rest
        log_density = self.prior.log_prob_by_kind(out, theta[:, -2], theta[:, -1])
        log_density += jacobian.sum(axis=0)
        log_density += 2.0 * np.log(whole)
        log_density += math.lgamma(n + 1) - 3.0 * n * math.log(2.0)
        falling = (g[0, 1:2] <= 0.0).all(axis=0) & (g[0, 2:] <= g[0, 1:-1]).all(axis=0)
        usable = falling & (np.abs(g[3:5]) < 100.0).all(axis=(0, 1)) & np.isfinite(log_density)
        return theta, np.where(usable, log_density, -np.inf)


def view_by_kind_and_gaussian(columns: FloatArray) -> FloatArray:
    """View the Gaussians' columns, in (n_samples, 6 N + 2), as (6 kinds, N, n_samples), without a copy."""
    return columns[:, :-2].reshape(len(columns), columns.shape[1] // 6, 6).transpose(2, 1, 0)


@dataclass(frozen=True)
class ScanGeometry:
    """Lengths and ranges that bound what a recording can resolve and contain.

    `span_mm` is the median length of the scans that move, or the diagonal of all positions if none does; `step_mm` is
    the median step within scans, at most a fiftieth of the span. `low`, `high` are the extreme readings, `albedo_low`,
    `albedo_high` the extreme albedo at the commanded positions; `inverted` is True if dark positions give high
    readings.
    """

    step_mm: float
    span_mm: float
    low: float
    high: float
    albedo_low: float
    albedo_high: float
    inverted: bool


def scan_geometry(recording: Recording) -> ScanGeometry:
    """Measure a recording's `ScanGeometry` from its usable rows.

    ParameterError if no reading is usable, all are equal, the sensor never moves, or the albedo under it never changes.
    """
    plan = recording.plan
    usable = recording.usable
    readings = recording.readings[usable]
    named = recording.source or "recording"
    require(readings.size != 0, named, f"{len(recording)} rows, none usable", "readings present and within min..max")
    low, high = float(readings.min()), float(readings.max())
    found = f"all {readings.size} usable readings equal {low:g}"
    require(low < high, named, found, "readings that differ: scan an edge")
    found = f"readings of {low:g} to {high:g}, whose squares no float holds"
    require((high - low) ** 2 >= np.finfo(np.float64).tiny, named, found, "another unit of reading")
    place = np.stack([plan.x_mm, plan.y_mm], axis=-1)
    still = rounding_error(place)
    moves, lengths = list[FloatArray](), list[float]()
    for rows in plan.rows_by_scan():
        places = place[rows[usable[rows]]]
        steps = np.hypot(*np.diff(places, axis=0).T)
        if (steps > still).any():
            moves.append(steps[steps > still])
            lengths.append(float(np.hypot(*np.ptp(places, axis=0))))
    extent = float(np.hypot(*np.ptp(place[usable], axis=0)))
    moved = bool(lengths) or extent > still
    require(moved, "recording", "every usable reading taken at one place", "scans that move over an edge")
    span = float(np.median(lengths)) if lengths else extent
    # Places far apart, such as those a robot chooses, do not bound the footprint from below: use a factor of 50.
    step = min(float(np.median(np.concatenate(moves))) if moves else span, span / 50)
    regions, albedo = KnownScene(plan.patterns).regions(np.empty((1, 0))), np.empty(len(plan))
    for name, rows in plan.rows_by_pattern():
        albedo[rows] = regions[name].albedo(place[rows])[0]
    albedo = albedo[usable]
    albedo_low, albedo_high = float(albedo.min()), float(albedo.max())
    found = f"albedo {albedo_low:g} under every usable place"
    require(albedo_low < albedo_high, "recording", found, "places on both sides of an edge")
    covariance = float(np.mean((albedo - albedo.mean()) * (readings - readings.mean())))
    return ScanGeometry(step, span, low, high, albedo_low, albedo_high, inverted=covariance < 0)


def default_prior(recording: Recording, n_gaussians: int) -> SSFPrior:
    """Make the prior of an SSF of `n_gaussians` from the recording's step, span and range of readings.

    Centres lie within a quarter of the span from the mechanical origin, so that a scan centred on an edge contains the
    transition. Conditional sds range from half a step (nothing finer is resolved) to a quarter of the span (nothing
    wider is contained). The levels are estimated by extrapolating the readings to albedo 0 and 1; each prior reaches
    half of their difference to either side. The mass of each Gaussian is uniform. In directions without information,
    such as along a single edge, the posterior equals this prior.

    ParameterError if the recording has no contrast (see `scan_geometry`) or `n_gaussians` is below 1.
    """
    g = scan_geometry(recording)
    reach = g.span_mm / 4
    finest, widest = g.step_mm / 2, g.span_mm / 4
    gain = (g.high - g.low) / (g.albedo_high - g.albedo_low) * (-1 if g.inverted else 1)
    at_low = g.high if g.inverted else g.low
    black = at_low - gain * g.albedo_low
    white = black + gain
    half = abs(gain) / 2
    level = "within half the reading range of the extreme readings"
    if (g.albedo_low, g.albedo_high) != (0.0, 1.0):
        level += f", scaled from albedo {g.albedo_low:g}..{g.albedo_high:g} to 0..1"
    return SSFPrior(
        n_gaussians=n_gaussians,
        offset_mm=Uniform(-reach, reach),
        precision=LogUniform(1 / (2 * widest**2), 1 / (2 * finest**2)),
        i_min=Uniform(black - half, black + half),
        i_max=Uniform(white - half, white + half),
        unit_mass_mm2=2 * finest**2,  # the narrowest Gaussian of full mass has a = 1
        reasons=(
            ("offset_mm", f"a quarter of the scans' span of {g.span_mm:g} mm either side of the mechanical origin"),
            (
                "precision",
                f"conditional sd (2A)^(-1/2) from {finest:.3g} mm (half a scan step) to {widest:.3g} mm "
                "(a quarter of the span), equal belief per decade",
            ),
            ("levels", level),
        ),
    )


def paper_prior(recording: Recording, n_gaussians: int) -> SSFPrior:
    """Make the paper's prior: uniform in a, u, v, (A, B, C) and the levels, within the bounds of `default_prior`.

    The paper prints no bounds. (A, B, C) is uniform over the volume where A and B are within their bounds and C leaves
    the correlation within its own.
    """
    usual = default_prior(recording, n_gaussians)
    bounds = usual.precision
    assert isinstance(bounds, LogUniform)
    why = "with C_n, uniform over their volume, as in the paper, which prints no bounds; these are the usual ones"
    reasons = {**dict(usual.reasons), "precision": why}
    return replace(
        usual, precision=SquareRoot(bounds.low, bounds.high), unit_mass_mm2=None, reasons=tuple(reasons.items())
    )


def blind_axis_rad(recording: Recording) -> float | None:
    """Find the axis of the sensor frame along which the recording has no information on the SSF.

    Straight edges, stripes and ramps measure only the SSF's projection on their normal, in the sensor
    frame. If the normals of all usable rows agree, the recording contains no information along the
    perpendicular axis, and the posterior equals the prior there.

    Return the axis, radians anticlockwise from x', 0 to pi; None if there are two directions or more, a pattern of
    another kind (but uniform ones), or no straight pattern at all.
    """
    plan = recording.plan
    angles: list[FloatArray] = []
    for name, rows in plan.rows_by_pattern():
        pattern, used = plan.patterns[name], rows[recording.usable[rows]]
        if isinstance(pattern, HalfPlane | Ramp | Stripes):
            angles.append(pattern.normal_rad - plan.orientation_rad[used])
        elif used.size and not isinstance(pattern, UniformPattern):
            return None
    if not any(part.size for part in angles):
        return None
    seen = np.exp(2j * np.concatenate(angles))  # doubled angles identify a normal with its opposite
    if np.abs(seen - seen[0]).max() > _SAME_AXIS:
        return None
    return float((np.angle(seen[0]) / 2 + math.pi / 2) % math.pi)
