"""Response of a Gaussian footprint to a region: closed forms and one-dimensional quadrature.

The first of the two independent routes to the response R (paper, eq. 8): exact integrals of each
Gaussian of the SSF over the region. The other, the paper's sum over pixels, is
`probewise.sensor.ssf.mean_albedo_by_pixels`. A new kind of region may register its closed form with
`mean_albedo_under_one_gaussian.register`; without one it is integrated numerically from its `albedo`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, lru_cache, singledispatch

import numpy as np
from scipy.special import ndtr, ndtri, owens_t

from probewise._arrays import FloatArray, IntArray
from probewise.errors import SlowWarning, require, warn
from probewise.scene.regions import (
    EllipseRegion,
    HalfPlaneRegion,
    ImageRegion,
    PolygonRegion,
    QuadrantRegion,
    RampRegion,
    Region,
    RegionsOfMixedKinds,
    StripesRegion,
    UniformRegion,
)
from probewise.scene.scenes import CardedRegion, mean_albedo_with_cards

ACCURATE_NODES = 64
FAST_NODES = 20

_REACH = 8.0  # standard deviations beyond which an edge has no effect (Phi(-8) = 6e-16)
_N_PLACES, _STEP = 4181, 2584  # successive Fibonacci numbers
_PIXELS_TOGETHER = 2**13  # of Gaussians together, at six nodes each: arrays of 400 kB, which stay in the cache


# A table of the standard normal's cumulative, fast enough for a billion calls.
_LIMIT = 8.5  # standard deviations: beyond, the cumulative is 0 or 1 within 1e-17
_CELLS = 2**13
PER_SD = _CELLS / (2 * _LIMIT)  # cells of the table per standard deviation
CENTRE = _CELLS / 2  # position of z = 0, in cells
_CACHED = 2**14  # elements that fit the cache together with the table
_NODES = (np.arange(_CELLS + 1) - CENTRE) / PER_SD
_VALUE, _SLOPE = ndtr(_NODES), np.exp(-0.5 * _NODES * _NODES) / (math.sqrt(2 * math.pi) * PER_SD)  # per cell
_VALUE[0], _VALUE[-1] = 0.0, 1.0
_SLOPE[0] = _SLOPE[-1] = 0.0


def normal_cdf_of_cells_in_place(cells: FloatArray) -> None:
    """Replace `cells`, z PER_SD + CENTRE, by the standard normal's cumulative of z; `cells` is contiguous float64.

    For callers that compute z as a product and can fold the table's scale into it. About the nearest entry z0 the
    cumulative is the parabola value + slope t (1 - z0 t / 2), t the distance from it.
    """
    entry, near = np.empty(cells.shape, dtype=np.intp), np.empty(cells.shape)
    np.clip(cells, 0.0, _CELLS, out=cells)
    np.rint(cells, out=near)
    cells -= near  # from -1/2 to 1/2
    entry[...] = near
    near -= CENTRE
    near *= cells
    near *= -0.5 / PER_SD**2
    near += 1.0
    cells *= near
    _SLOPE.take(entry, out=near, mode="clip")  # "clip" spares the check of bounds
    cells *= near
    _VALUE.take(entry, out=near, mode="clip")
    cells += near


def normal_cdf(z: FloatArray) -> FloatArray:
    """Evaluate the cumulative distribution of the standard normal, any shape, within 1e-10.

    A parabola about each of the table's entries: the third-order term is at most 0.4 (h / 2)^3 / 6 =
    7.5e-11. Large arrays are processed in blocks that fit the cache.
    """
    z = np.asarray(z, dtype=np.float64)
    if z.size < 1000:  # the calls cost more than the function
        return np.asarray(ndtr(z))
    out = np.multiply(z, PER_SD, order="C")  # so that the flat view below is no copy
    out += CENTRE
    flat = out.reshape(-1)
    for start in range(0, flat.size, _CACHED):
        normal_cdf_of_cells_in_place(flat[start : start + _CACHED])
    return out


@dataclass(frozen=True, eq=False)
class LabGaussian:
    """One Gaussian of the footprint in the lab frame, at every pose.

    All arrays broadcast to (n_samples, n_points), mm and mm^2: the sensor's position `x_mm`, `y_mm`; the Gaussian's
    centre relative to it, `dx_mm`, `dy_mm`; its covariance. Position and centre are kept apart because one depends on
    the reading and the other on the hypothesis: their sum, a larger array, is formed only on demand.
    """

    x_mm: FloatArray
    y_mm: FloatArray
    dx_mm: FloatArray
    dy_mm: FloatArray
    var_x: FloatArray
    var_y: FloatArray
    cov_xy: FloatArray

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape that the arrays broadcast to."""
        return np.broadcast_shapes(*(a.shape for a in vars(self).values()))

    @property
    def centre_and_covariance(self) -> tuple[FloatArray, ...]:
        """The Gaussian's centre x and y in the lab frame, and its var_x, var_y, cov_xy."""
        return (self.x_mm + self.dx_mm, self.y_mm + self.dy_mm, self.var_x, self.var_y, self.cov_xy)


def moments_in_lab_frame(
    turn_rad: FloatArray, u_mm: FloatArray, v_mm: FloatArray, var_u: FloatArray, var_v: FloatArray, cov_uv: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Turn means and covariances by `turn_rad` into the lab frame: dx, dy, var_x, var_y, cov_xy; arrays broadcast."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    cross = 2 * c * s * cov_uv
    return (
        c * u_mm - s * v_mm,
        s * u_mm + c * v_mm,
        c * c * var_u + s * s * var_v - cross,
        s * s * var_u + c * c * var_v + cross,
        c * s * (var_u - var_v) + (c * c - s * s) * cov_uv,
    )


@singledispatch
def mean_albedo_under_one_gaussian(region: Region, gaussian: LabGaussian, n_nodes: int) -> FloatArray:
    """Return the mean albedo under one Gaussian footprint: broadcasts to (n_samples, n_points).

    A region without a registered closed form is seen at 4,181 places: error about 1e-3, and a `SlowWarning` is issued.
    """
    kind = type(region).__name__
    warn(
        f"{kind} has no closed form: each footprint over it is summed over places, in milliseconds; register one with "
        f"probewise.sensor.gaussian.mean_albedo_under_one_gaussian.register({kind})",
        SlowWarning,
    )
    shape = np.broadcast_shapes(gaussian.shape, (region.n_regions, 1))
    out, number = np.empty(shape), np.arange(_N_PLACES)
    across, up = (ndtri((number * step % _N_PLACES + 0.5) / _N_PLACES) for step in (1, _STEP))  # a Fibonacci lattice
    x, y, var_x, var_y, cov = (np.broadcast_to(a, shape) for a in gaussian.centre_and_covariance)
    sd_x, slope = np.sqrt(var_x), cov / var_x
    sd_free = np.sqrt(var_y - slope * cov)
    for at in np.ndindex(*shape):
        off = sd_x[at] * across
        places = np.stack([x[at] + off, y[at] + slope[at] * off + sd_free[at] * up], axis=-1)
        out[at] = region.albedo(places)[at[0] if region.n_regions > 1 else 0].mean()
    return out


def _albedo_by_share_inside(outside: float, inside: float, share: FloatArray) -> FloatArray:
    if (outside, inside) == (0.0, 1.0):
        return share
    return outside + (inside - outside) * share


@mean_albedo_under_one_gaussian.register
def _mean_albedo_over_uniform(region: UniformRegion, gaussian: LabGaussian, n_nodes: int) -> FloatArray:
    return region.level[:, None]


@mean_albedo_under_one_gaussian.register
def _mean_albedo_over_half_plane(region: HalfPlaneRegion, gaussian: LabGaussian, n_nodes: int) -> FloatArray:
    """Return the mean albedo over a half-plane: the cumulative of the Gaussian projected on the normal."""
    cosine, sine = np.cos(region.normal_rad)[:, None], np.sin(region.normal_rad)[:, None]
    place = cosine * gaussian.x_mm + sine * gaussian.y_mm - region.offset_mm[:, None]
    shift = cosine * gaussian.dx_mm + sine * gaussian.dy_mm
    variance = cosine**2 * gaussian.var_x + sine**2 * gaussian.var_y + 2 * cosine * sine * gaussian.cov_xy
    per_sd = 1 / np.sqrt(variance)
    return _albedo_by_share_inside(region.outside, region.inside, normal_cdf((place + shift) * per_sd))


@mean_albedo_under_one_gaussian.register
def _mean_albedo_over_ramp(region: RampRegion, gaussian: LabGaussian, n_nodes: int) -> FloatArray:
    """Return the mean albedo over a ramp: the albedo at the Gaussian's mean, exact for a linear field."""
    cosine, sine = np.cos(region.normal_rad)[:, None], np.sin(region.normal_rad)[:, None]
    along = cosine * (gaussian.x_mm + gaussian.dx_mm) + sine * (gaussian.y_mm + gaussian.dy_mm)
    return region.per_mm[:, None] * along


@mean_albedo_under_one_gaussian.register
def _mean_albedo_over_stripes(region: StripesRegion, gaussian: LabGaussian, n_nodes: int) -> FloatArray:
    """Return the mean albedo over stripes: a sum of cumulatives or, over fine stripes, of a Fourier series."""
    cosine, sine = np.cos(region.normal_rad)[:, None], np.sin(region.normal_rad)[:, None]
    period, duty = region.period_mm[:, None], region.duty[:, None]
    along = cosine * (gaussian.x_mm + gaussian.dx_mm) + sine * (gaussian.y_mm + gaussian.dy_mm)
    along = along - region.phase_mm[:, None]
    sd = np.sqrt(cosine**2 * gaussian.var_x + sine**2 * gaussian.var_y + 2 * cosine * sine * gaussian.cov_xy)
    along, sd, period, duty = np.broadcast_arrays(along / period, sd / period, period, duty)  # in periods
    share = np.empty(along.shape)
    fine = sd > 0.4
    if fine.any():
        s, a, d = sd[fine], along[fine], duty[fine]
        total = d.copy()
        for j in range(1, 5):  # the fifth term is below exp(-2 (5 pi 0.4)^2) = 1e-34
            fade = np.exp(-2 * (np.pi * j * s) ** 2)
            total += 2 / (np.pi * j) * np.sin(np.pi * j * d) * np.cos(2 * np.pi * j * (a - d / 2)) * fade
        share[fine] = total
    coarse = ~fine
    if coarse.any():
        s, a, d = sd[coarse], along[coarse], duty[coarse]
        a = a - np.floor(a)
        total = np.zeros_like(a)
        for k in range(-4, 6):  # 8 sd are at most 3.2 periods
            total += normal_cdf((a - k) / s) - normal_cdf((a - k - d) / s)
        share[coarse] = total
    return _albedo_by_share_inside(region.outside, region.inside, share)


_FAR = 26.0  # sds: the mass beyond is 0, and exp is ten times slower where it underflows
_TRIANGLE_NODES = 8  # positive half of a 16-node rule: accurate to 1e-12


def probabilities_beyond_corner_and_sides(
    z1: FloatArray, z2: FloatArray, rho: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return P(x > z1, y > z2), P(x > z1), P(y > z2) of standard normals x, y of correlation rho; arrays broadcast.

    In the frame in which the Gaussian is the unit one about the origin, the quadrant is the wedge between two rays from
    the corner (Owen 1956). The line of side 1 passes the origin at distance z1; the corner lies `along` it from its
    foot. The mass that a side cuts off is half a half-plane minus the triangle between origin, foot and corner, V of
    Nicholson (1943): the integral over x from 0 to along/z1 of (1 - exp(-z1^2 (1 + x^2) / 2)) / (2 pi (1 + x^2)), by
    Gauss-Legendre quadrature. The integrand is smooth up to x = 1; where the corner lies further, V(h, k) is the mass
    of the rectangle minus V(k, h).
    """
    z = np.empty((2, *np.broadcast(z1, z2, rho).shape))
    z[0], z[1] = z1, z2
    along = (z[::-1] - rho * z) / np.sqrt(1 - rho**2)
    height, reach = np.abs(z), np.abs(along)
    half_height, half_reach = 0.5 - ndtr(-height), 0.5 - ndtr(-reach)
    long, short = np.maximum(height, reach), np.minimum(height, reach)
    ratio = short / np.maximum(long, np.finfo(float).tiny)
    node, weight = _half_legendre_rule(2 * _TRIANGLE_NODES)
    stretch = 1.0 + (ratio**2).reshape(1, -1) * node[:, None] ** 2
    mass = stretch * (-0.5 * np.minimum(long, _FAR) ** 2).reshape(1, -1)
    np.exp(mass, out=mass)
    np.subtract(1.0, mass, out=mass)
    mass /= stretch
    triangle = (weight @ mass).reshape(z.shape) * ratio / (2 * np.pi)
    triangle = np.where(reach > height, half_height * half_reach - triangle, triangle)
    sides = np.copysign(0.5 * half_height - np.copysign(triangle, along), z)
    opening = np.arccos(-rho) / (2 * np.pi)
    beyond = 0.5 - np.copysign(half_height, z)
    return np.clip(opening - sides[0] - sides[1], 0.0, 1.0), beyond[0], beyond[1]


@mean_albedo_under_one_gaussian.register
def _mean_albedo_over_quadrant(region: QuadrantRegion, gaussian: LabGaussian, n_nodes: int) -> FloatArray:
    """Return the mean albedo over a quadrant: a bivariate normal's mass, the inside reflected to the upper right."""
    (corner_x, corner_y), (dx, dy) = region.corner_mm.T[:, :, None], region.direction.T[:, :, None]
    sd_x, sd_y = np.sqrt(gaussian.var_x), np.sqrt(gaussian.var_y)
    z1 = dx * (corner_x - gaussian.x_mm - gaussian.dx_mm) / sd_x
    z2 = dy * (corner_y - gaussian.y_mm - gaussian.dy_mm) / sd_y
    share, *_ = probabilities_beyond_corner_and_sides(z1, z2, dx * dy * gaussian.cov_xy / (sd_x * sd_y))
    return _albedo_by_share_inside(region.outside, region.inside, share)


@mean_albedo_under_one_gaussian.register
def _mean_albedo_over_polygon(region: PolygonRegion, gaussian: LabGaussian, n_nodes: int) -> FloatArray:
    """Return the mean albedo over a polygon: a sum over edges of the angle seen from the mean, less the mass beyond.

    All is mapped to the frame in which the Gaussian is the unit one, with its mean at the origin.
    """
    sd_x = np.sqrt(gaussian.var_x)
    slope = gaussian.cov_xy / gaussian.var_x
    sd_free = np.sqrt(gaussian.var_y - slope * gaussian.cov_xy)

    def whitened(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        return x / sd_x, (y - slope * x) / sd_free

    mean_p, mean_q = whitened(gaussian.x_mm + gaussian.dx_mm, gaussian.y_mm + gaussian.dy_mm)
    turning = np.zeros(np.broadcast_shapes(mean_p.shape, mean_q.shape, (region.n_regions, 1)))
    for k in range(region.edges_mm.shape[1]):
        p1, q1 = whitened(region.edges_mm[:, k, 0, :1], region.edges_mm[:, k, 0, 1:])
        p2, q2 = whitened(region.edges_mm[:, k, 1, :1], region.edges_mm[:, k, 1, 1:])
        length = np.hypot(p2 - p1, q2 - q1)
        safe = np.where(length > 0, length, 1.0)
        ep, eq = (p2 - p1) / safe, (q2 - q1) / safe
        height = p1 * eq - q1 * ep - (mean_p * eq - mean_q * ep)
        start = p1 * ep + q1 * eq - (mean_p * ep + mean_q * eq)
        end = start + length
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            angle = np.arctan(end / height) - np.arctan(start / height)
        angle[height == 0] = 0.0
        near = (np.abs(height) < _REACH) & (start < _REACH) & (end > -_REACH) & (height != 0)
        angle[near] -= 2 * np.pi * _mass_beyond_edges(height[near], start[near], end[near])
        turning += angle
    return _albedo_by_share_inside(region.outside, region.inside, np.clip(turning / (2 * np.pi), 0.0, 1.0))


@mean_albedo_under_one_gaussian.register
def _mean_albedo_over_region_with_cards(region: CardedRegion, gaussian: LabGaussian, n_nodes: int) -> FloatArray:
    """Return the mean albedo over a region with cards laid on it, from those over the region and each card."""
    covered = [mean_albedo_under_one_gaussian(card.region, gaussian, n_nodes) for card in region.cards]
    below = mean_albedo_under_one_gaussian(region.region, gaussian, n_nodes)
    return mean_albedo_with_cards(below, region.cards, covered)


def _mass_beyond_edges(height: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the unit Gaussian's signed mass beyond each edge, seen from the origin, (n_edges,), by Owen's T.

    `height` is the signed distance of the edge's line from the origin, positive where the edge runs anticlockwise about
    it, and the mass has the same sign; `start` and `end` are positions along the line. An end out of reach counts as
    infinitely far, where T is half the mass beyond the line.
    """
    half = 0.5 * ndtr(-np.abs(height))
    with np.errstate(over="ignore"):
        slopes = [along / height for along in (start, end)]
    to_start, to_end = (np.copysign(half, slope) for slope in slopes)
    for beyond, along, slope in zip((to_start, to_end), (start, end), slopes, strict=True):
        seen = np.abs(along) < _REACH
        beyond[seen] = owens_t(height[seen], slope[seen])
    return np.asarray(to_end - to_start)


@cache
def _half_legendre_rule(n_nodes: int) -> tuple[FloatArray, FloatArray]:
    require(n_nodes >= 2 and n_nodes % 2 == 0, "n_nodes", n_nodes, "an even number, 2 or more")
    node, weight = np.polynomial.legendre.leggauss(n_nodes)
    return node[n_nodes // 2 :], weight[n_nodes // 2 :]


@mean_albedo_under_one_gaussian.register
def _mean_albedo_over_ellipse(region: EllipseRegion, gaussian: LabGaussian, n_nodes: int) -> FloatArray:
    """Return the mean albedo over an ellipse: mapped to the unit disc, exact along chords, by quadrature across."""
    a, b = region.semi_axes_mm[:, :1], region.semi_axes_mm[:, 1:]
    cosine, sine = np.cos(region.angle_rad)[:, None], np.sin(region.angle_rad)[:, None]
    round_edge = bool((region.semi_axes_mm[:, 0] == region.semi_axes_mm[:, 1]).all())
    if round_edge:  # whatever the angle
        cosine, sine = np.ones_like(cosine), np.zeros_like(sine)
    place_x = gaussian.x_mm - region.center_mm[:, :1] + gaussian.dx_mm
    place_y = gaussian.y_mm - region.center_mm[:, 1:] + gaussian.dy_mm
    p, q = (cosine * place_x + sine * place_y) / a, (cosine * place_y - sine * place_x) / b
    cross = 2 * cosine * sine * gaussian.cov_xy
    var_p = (cosine**2 * gaussian.var_x + sine**2 * gaussian.var_y + cross) / a**2
    var_q = (sine**2 * gaussian.var_x + cosine**2 * gaussian.var_y - cross) / b**2
    twist = cosine * sine * (gaussian.var_y - gaussian.var_x) + (cosine**2 - sine**2) * gaussian.cov_xy
    share = _mass_in_unit_disc(p, q, var_p, var_q, twist / (a * b), n_nodes)
    return _albedo_by_share_inside(region.outside, region.inside, share)


def _mass_in_unit_disc(
    p: FloatArray, q: FloatArray, var_p: FloatArray, var_q: FloatArray, cov_pq: FloatArray, n_nodes: int
) -> FloatArray:
    """Return the mass of Gaussians, arrays broadcasting to (n_samples, n_points), inside the unit circle.

    Only the (sample, reading) pairs whose edge is within reach are integrated.
    """
    reach = float(np.clip(4.3 + (n_nodes - 20) / 20, 4.0, 6.5))  # sds: truncation and quadrature errors balance
    largest = np.sqrt(0.5 * (var_p + var_q) + np.hypot(0.5 * (var_p - var_q), cov_pq))
    distance = np.sqrt(p * p + q * q)
    near = np.abs(distance - 1) < reach * largest
    share = np.array(np.broadcast_to((distance < 1).astype(np.float64), near.shape))
    if not near.any():
        return share
    every = (p, q, distance, var_p, var_q, cov_pq)
    p, q, d, var_p, var_q, cov_pq = (np.broadcast_to(a, near.shape)[near] for a in every)
    at_centre = d == 0
    safe = np.where(at_centre, 1.0, d)
    c = np.where(at_centre, 1.0, p / safe)
    s = q / safe
    cc, ss, cs = c * c, s * s, c * s
    cross = 2 * cs * cov_pq
    var_r, var_t = cc * var_p + ss * var_q + cross, ss * var_p + cc * var_q - cross
    share[near] = _mass_in_disc_by_chords(d, var_r, var_t, cs * (var_q - var_p) + (cc - ss) * cov_pq, reach, n_nodes)
    return np.clip(share, 0.0, 1.0)


_BLOCK = 2**13  # nodes at a time: they fit the cache
_FLAT, _BENT = 0.01, 0.4  # curvature of an edge, in footprints of sd 1, up to which few and some nodes suffice


def _mass_in_disc_by_chords(
    d: FloatArray, var_r: FloatArray, var_t: FloatArray, cov: FloatArray, reach: float, n_nodes: int
) -> FloatArray:
    """Return the mass in the unit disc of Gaussians with mean (d, 0), radial and tangential variances; (n_pairs,) each.

    Along parallel chords the integral is a difference of two cumulatives; across them it is a quadrature. The chords
    have the direction in which the mean lies from the nearest point of the edge, nearest in sds (to first order).
    Neighbouring chords then meet the edge equally many sds from their own mean, but for its curvature, so that few
    Gauss-Hermite nodes suffice. Where the edge curves within a footprint, or the footprint covers much of the disc,
    chords along the footprint's long axis and Gauss-Legendre nodes take their place.
    """
    lean = (1 - d) * cov / var_r  # the nearest point is (1, lean), but for its length
    x, y = var_r + cov * lean, cov + var_t * lean
    length = np.copysign(np.hypot(x, y), x)
    det = var_r * var_t - cov * cov
    curvature = det * ((1 + lean * lean) / np.abs(x + lean * y)) ** 1.5
    x, y = x / length, y / length
    spread, twist = var_r - var_t, 2 * x * y
    var_y = var_r - x * x * spread - twist * cov
    sd_y = np.sqrt(var_y)
    per_sd = sd_y / np.sqrt(det)
    slope = (x * x - y * y) * cov - 0.5 * twist * spread
    mean_x, mean_y = d * x, -d * y
    found = np.empty(len(d))
    left = np.ones(len(d), dtype=np.bool_)
    tilt = slope / sd_y * per_sd
    for n, most in ((n_nodes // 4, _FLAT), (2 * n_nodes // 5, _BENT)):
        inside = np.abs(mean_y) + _hermite_rule(n)[0][-1] * sd_y < 1
        rows = np.flatnonzero(left & inside & (curvature < most))
        left[rows] = False
        for r in _blocks_of_rows(rows, n):
            found[r] = _mass_in_disc_by_skewed_chords(mean_x[r], mean_y[r], sd_y[r], per_sd[r], tilt[r], n)
    rule = _half_legendre_rule(n_nodes)
    for r in _blocks_of_rows(np.flatnonzero(left), n_nodes):
        found[r] = _mass_in_disc_by_long_chords(d[r], var_r[r], var_t[r], cov[r], reach, rule)
    return found


def _blocks_of_rows(rows: IntArray, n_nodes: int) -> Iterator[IntArray]:
    step = max(1, _BLOCK // n_nodes)
    return (rows[start : start + step] for start in range(0, len(rows), step))


def _normal_cdf_overwriting(z: FloatArray) -> FloatArray:
    """Replace z by its normal cumulative, from the table whatever the size of z, and return it."""
    z *= PER_SD
    z += CENTRE
    normal_cdf_of_cells_in_place(z)
    return z


def _mass_in_disc_by_skewed_chords(
    mean_x: FloatArray, mean_y: FloatArray, sd_y: FloatArray, per_sd: FloatArray, tilt: FloatArray, n_nodes: int
) -> FloatArray:
    """Return the mass of Gaussians in the unit disc, (n_pairs,), from chords skewed so that few nodes suffice.

    Chords are integrated exactly along x, with Gauss-Hermite nodes in y; the mean in x moves by `tilt` conditional sds
    for each sd in y.
    """
    node, weight = _hermite_rule(n_nodes)
    along = node[:, None] * sd_y
    along += mean_y
    along *= along
    np.subtract(1.0, along, out=along)
    np.sqrt(along, out=along)
    across = node[:, None] * tilt
    found = weight @ _normal_cdf_overwriting((along - mean_x) * per_sd - across)
    back = np.flatnonzero(node[-1] * np.abs(tilt) - mean_x * per_sd > -_REACH)
    if back.size:
        behind = (-along[:, back] - mean_x[back]) * per_sd[back] - across[:, back]
        found[back] -= weight @ _normal_cdf_overwriting(behind)
    return np.asarray(found)


def _mass_in_disc_by_long_chords(
    d: FloatArray,
    var_r: FloatArray,
    var_t: FloatArray,
    cov: FloatArray,
    reach: float,
    rule: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """Return the mass of Gaussians in the unit disc, (n_pairs,), from chords along the long axis of each Gaussian.

    The integral along chords is exact; across, it is a quadrature in u, where y = sin(4 arctan u) removes the root at
    the end of the chords.
    """
    half, spread = 0.5 * (var_r + var_t), 0.5 * (var_r - var_t)
    twist = np.hypot(spread, cov)
    long = np.sqrt(half + twist)
    short = np.sqrt(var_r * var_t - cov * cov) / long
    cosine = np.sqrt(0.5 + 0.5 * spread / np.where(twist > 0, twist, 1.0))
    mean_x, mean_y = d * cosine, d * np.sqrt(1 - cosine * cosine)
    low, high = (_tangent_of_quarter_arcsine((mean_y + side * reach * short).clip(-1.0, 1.0)) for side in (-1, 1))
    node, weight = rule
    u = np.concatenate([-node[::-1], node])[:, None] * (0.5 * (high - low)) + 0.5 * (high + low)
    widen = 1 / (1 + u * u)
    sine = 2 * u * widen
    x = 1 - 2 * sine * sine
    y = 2 * sine * (1 - u * u) * widen
    per_long = 1 / long
    inner = _normal_cdf_overwriting((x - mean_x) * per_long)
    inner -= _normal_cdf_overwriting((-x - mean_x) * per_long)
    y -= mean_y
    y /= short
    inner *= np.exp(-0.5 * y * y) * x * widen
    mass = np.concatenate([weight[::-1], weight]) @ inner
    return np.asarray(mass * ((high - low) * 2 / (np.sqrt(2 * np.pi) * short)))


def _tangent_of_quarter_arcsine(y: FloatArray) -> FloatArray:
    half = y / (1 + np.sqrt(1 - y * y))
    return np.asarray(half / (1 + np.sqrt(1 + half * half)))


@cache
def _hermite_rule(n_nodes: int) -> tuple[FloatArray, FloatArray]:
    node, weight = np.polynomial.hermite_e.hermegauss(n_nodes)
    return node, weight / weight.sum()


@mean_albedo_under_one_gaussian.register
def _mean_albedo_over_mixed_regions(region: RegionsOfMixedKinds, gaussian: LabGaussian, n_nodes: int) -> FloatArray:
    """Return the mean albedo, (n_samples, n_points), of regions of several kinds: each by the rule for its kind."""
    out = np.empty(np.broadcast_shapes(gaussian.shape, (region.n_regions, 1)))
    for rows, part in region.rows_and_regions():
        own = LabGaussian(*(a[rows] if len(a) != 1 else a for a in vars(gaussian).values()))
        out[rows] = mean_albedo_under_one_gaussian(part, own, n_nodes)
    return out


@mean_albedo_under_one_gaussian.register
def _mean_albedo_over_image(region: ImageRegion, gaussian: LabGaussian, n_nodes: int) -> FloatArray:
    """Return an image's mean albedo: exact along x in each row of pixels, by Gauss-Legendre in panels across it."""
    x, y, var_x, var_y, cov = (array.ravel() for array in np.broadcast_arrays(*gaussian.centre_and_covariance))
    shape, pixel = np.array(region.values.shape), region.pixel_mm
    slope = cov / var_y
    # In pixels from the lower left corner; rows, counted from below, come before columns.
    centre = np.stack([y - region.origin_mm[1], x - region.origin_mm[0]], axis=1) / pixel
    sd = np.sqrt(np.stack([var_y, var_x], axis=1)) / pixel
    s_free = np.sqrt(var_x - slope * cov) / pixel
    first = np.clip(np.floor(centre - _REACH * sd), 0, shape).astype(np.int64)
    size = np.clip(np.floor(centre + _REACH * sd) + 1, 0, shape).astype(np.int64) - first
    n_panels = np.ceil(1 / np.minimum(np.minimum(sd[:, 0], s_free / np.maximum(np.abs(slope), 1e-9)), 1.0))
    n_cells = size.prod(axis=1) * n_panels
    out, left = np.zeros(len(x)), np.argsort(-n_cells, kind="stable")[: np.count_nonzero(n_cells > 0)]
    while left.size:  # those with windows of about one size together
        of, left = np.split(left, [max(1, int(_PIXELS_TOGETHER / n_cells[left[0]]))])
        inner, weight = _rule_over_row(int(n_panels[of].max()))
        rows, columns = (
            np.minimum(first[of, axis], shape[axis] - n)[:, None] + np.arange(n)
            for axis, n in enumerate(size[of].max(axis=0))
        )
        height = rows[..., None] + inner - centre[of, 0, None, None]  # (n_together, n_rows, n_inner)
        edges = np.append(columns, columns[:, -1:] + 1, axis=1) - centre[of, 1, None]
        z = edges[:, None, None, :] - (slope[of, None, None] * height)[..., None]
        z /= s_free[of, None, None, None]
        albedo = region.values[(shape[0] - 1 - rows)[:, :, None], columns[:, None, :]]
        falls = -np.diff(albedo, axis=-1, prepend=0.0, append=0.0)
        seen = np.matmul(normal_cdf(z), falls[..., None])[..., 0]
        s_y = sd[of, 0, None, None]
        density = np.exp(-0.5 * (height / s_y) ** 2) / (np.sqrt(2 * np.pi) * s_y)
        out[of] = np.sum(seen * density * weight, axis=(1, 2))
    return out.reshape(gaussian.shape)


@lru_cache(maxsize=64)
def _rule_over_row(n_panels: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of a Gauss-Legendre rule over a row of pixels, (0, 1), in `n_panels` equal parts."""
    node, weight = np.polynomial.legendre.leggauss(6)
    nodes = ((np.arange(n_panels)[:, None] + 0.5 * (node + 1)) / n_panels).ravel()
    return nodes, np.tile(0.5 * weight / n_panels, n_panels)
