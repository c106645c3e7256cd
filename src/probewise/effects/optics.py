"""Effects of the light on its way: the scene, the sensor's height, its footprint, edges, patches."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import ClassVar

import numpy as np

from probewise._arrays import TINY, FloatArray
from probewise.effects.effect import (
    AMPLITUDE,
    POSITIVE,
    Act,
    Declared,
    Effect,
    LightEffect,
    Say,
    acting,
    in_words,
    light_effect,
    one_of,
    scans_in_words,
    single_column_bank,
    sizes_inside,
)
from probewise.effects.reference import Extent, Origin, candidate_scan_groups, distinct_positions_mm, scan_indicator
from probewise.priors import HeavyTailedPrior, LogUniform, Normal, Product, Uniform
from probewise.recordings.patterns import Disc, HalfPlane, Polygon, Quadrant, Ramp, Stripes
from probewise.recordings.plan import Plan
from probewise.scene.regions import Region, edge_distance
from probewise.sensor.commanded import footprint_at_added_height, height_ratio
from probewise.sensor.gaussian import LabGaussian, mean_albedo_under_one_gaussian
from probewise.sensor.stages import Footprint, SceneView, Stage, View

_RADII = (0.04, 0.1, 0.25)  # of the line's length, for the bank; the prior reaches twice as far either way
_MARGIN = 0.1  # of the line's length: a patch may lie beyond its ends
_STRAIGHT = 0.02  # of a scan's length: the largest deviation from a straight line
_LEAST_PLACES = 8
_STEP = 1e-3  # of a standard deviation, for the central difference: its error is a millionth of this
_USUAL_MM = 14.0  # the height assumed where a recording gives none
_ANGLES = 8
_LEAST_ANGLE_RAD, _ONE_DIRECTION_RAD = np.radians([-89.5, 1.0])


@light_effect("edge_misplacement", Stage.SCENE, "misplaced edges", ("slope",))
def edge_misplacement(kind: LightEffect, of: Extent) -> Effect:
    """Every pattern is shifted by offset_mm: along its normal (half-plane, stripes, ramp), or along X (all others)."""
    act = acting(lambda value, plan, mm: _with_shifted_patterns(value, mm * np.ones(len(plan)), plan))
    says = in_words("the printed edges lie {0} mm from their described place, in all scans")
    return kind.bind(of, {"offset_mm": (AMPLITUDE, "mm")}, act, says, typical=of.small_shift_mm)


@light_effect("scan_misplacement", Stage.SCENE, "a misplaced pattern in one scan", ("scan", "slope"))
def scan_misplacement(kind: LightEffect, of: Extent) -> Effect | None:
    """In one scan the pattern is shifted by offset_mm: along its normal (half-plane, stripes, ramp), or along X."""

    def in_scan(name: str) -> Effect:
        act = acting(lambda value, plan, mm: _with_shifted_patterns(value, mm * scan_indicator(plan, (name,)), plan))
        says = in_words(f"in {scans_in_words((name,))} the pattern lies {{0}} mm from where it lies in the others")
        return kind.bind(of, {"offset_mm": (AMPLITUDE, "mm")}, act, says, typical=of.small_shift_mm, scans=(name,))

    names = tuple(dict.fromkeys(of.plan.scan_names))
    return one_of([in_scan(name) for name in names]) if len(names) > 1 else None


def _with_shifted_patterns(view: SceneView, by_mm: FloatArray, plan: Plan) -> SceneView:
    """Return the view with each reading's pattern shifted by `by_mm`, (n_samples, n_points): along its normal, or X."""
    angle = np.zeros(len(plan))
    for name, rows in plan.rows_by_pattern():
        pattern = plan.patterns.get(name)
        if isinstance(pattern, HalfPlane | Stripes | Ramp):
            angle[rows] = pattern.normal_rad
    return replace(view, dx_mm=view.dx_mm + by_mm * np.cos(angle), dy_mm=view.dy_mm + by_mm * np.sin(angle))


def gaussian_bump(squared_distance: FloatArray, radius: FloatArray) -> FloatArray:
    """Return exp(-d^2 / 2 r^2) of the squared distances d^2; the arrays broadcast."""
    return np.exp(-0.5 * squared_distance / radius**2)


@dataclass(frozen=True)
class ScanLine:
    """A line at `angle_rad` to X, `offset_mm` beside the origin, from `low_mm` to `high_mm` along it.

    Its points are s t + offset_mm n, s from low_mm to high_mm; t is the unit vector along the line, n is t turned by 90
    degrees.
    """

    angle_rad: float
    offset_mm: float
    low_mm: float
    high_mm: float

    @property
    def length_mm(self) -> float:
        """Length of the line, mm."""
        return self.high_mm - self.low_mm

    def lab_coordinates_mm(self, along_mm: FloatArray, beside_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return X and Y of points given by their position along the line and distance from it; arrays broadcast."""
        c, s, n = np.cos(self.angle_rad), np.sin(self.angle_rad), self.offset_mm + beside_mm
        return c * along_mm - s * n, s * along_mm + c * n

    def line_coordinates_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the position of points X, Y along the line, and their distance from it; arrays broadcast."""
        c, s = np.cos(self.angle_rad), np.sin(self.angle_rad)
        return c * x_mm + s * y_mm, c * y_mm - s * x_mm - self.offset_mm


def distinct_scan_lines(plan: Plan) -> tuple[ScanLine, ...]:
    """Return the distinct lines of the plan's straight scans that have eight distinct places or more."""
    found: list[ScanLine] = []
    for rows in plan.rows_by_scan():
        places = np.unique(np.stack([plan.x_mm[rows], plan.y_mm[rows]], axis=-1), axis=0)
        if len(places) < _LEAST_PLACES:
            continue
        # The angle to X of the principal axis, above -89.5 and up to 90.5 degrees.
        x_mm, y_mm = (axis - axis.mean() for axis in (places - places[0]).T)  # exactly 0 for an axis that rests
        angle = 0.5 * float(np.arctan2(2 * x_mm @ y_mm, x_mm @ x_mm - y_mm @ y_mm))
        angle = angle + np.pi if angle < _LEAST_ANGLE_RAD else angle
        along, across = ScanLine(angle, 0.0, 0.0, 1.0).line_coordinates_mm(*places.T)
        if len(distinct_positions_mm(along)) < _LEAST_PLACES or np.ptp(across) > _STRAIGHT * np.ptp(along):
            continue
        line = ScanLine(angle, float(across.mean()), float(along.min()), float(along.max()))
        for k, other in enumerate(found):
            apart = line.offset_mm / line.length_mm - other.offset_mm / other.length_mm
            if abs(line.angle_rad - other.angle_rad) < _ONE_DIRECTION_RAD and abs(apart) < 0.5 * _STRAIGHT:
                low_mm, high_mm = min(line.low_mm, other.low_mm), max(line.high_mm, other.high_mm)
                found[k] = replace(other, low_mm=low_mm, high_mm=high_mm)
                break
        else:
            found.append(line)
    return tuple(found)


@dataclass(frozen=True)
class PatchPrior:
    """Prior of a patch of either sign on or beside a line; parameters: its height (named `size`), x, y, r."""

    size: str
    typical: float
    line: ScanLine

    BESIDE: ClassVar[Normal] = Normal(0.0, 0.7)  # distance from the line in radii

    @property
    def names(self) -> tuple[str, ...]:
        """The height's name, then x, y, r."""
        return (self.size, "x", "y", "r")

    @property
    def radius_prior(self) -> LogUniform:
        """Log-uniform prior of the radius, mm: from 0.02 to 0.5 of the line's length."""
        return LogUniform(_RADII[0] / 2 * self.line.length_mm, _RADII[-1] * 2 * self.line.length_mm)

    @cached_property
    def _prior_seen_by_scan(self) -> Product:
        """Prior over what the scan shows: height on the line, place along it, distance in radii, radius."""
        line, margin, on_line = self.line, _MARGIN * self.line.length_mm, HeavyTailedPrior(self.typical)
        along = Uniform(line.low_mm - margin, line.high_mm + margin)
        return Product({"on_line": on_line, "along": along, "beside": self.BESIDE, "r": self.radius_prior})

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        """Map unit-cube coordinates to height, x, y, r; both (n_samples, 4)."""
        on_line, along, beside, r = self._prior_seen_by_scan.from_unit_cube(u).T
        x, y = self.line.lab_coordinates_mm(along, beside * r)
        return np.stack([on_line * np.exp(0.5 * beside**2), x, y, r], axis=-1)

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        """Map height, x, y, r to unit-cube coordinates; both (n_samples, 4)."""
        return self._prior_seen_by_scan.to_unit_cube(self._parameters_seen_by_scan(theta))

    def log_prob(self, theta: FloatArray) -> FloatArray:
        """Return the natural log of the density, (n_samples, 4) -> (n_samples,); -inf for a radius of 0 or below."""
        possible = theta[:, 3] > 0
        shown = self._parameters_seen_by_scan(np.where(possible[:, None], theta, 1.0))
        # d(on_line, beside) / d(height, y) = exp(-beside^2 / 2) / r
        log_density = self._prior_seen_by_scan.log_prob(shown) - 0.5 * shown[:, 2] ** 2 - np.log(shown[:, 3])
        return np.where(possible, log_density, -np.inf)

    def _parameters_seen_by_scan(self, theta: FloatArray) -> FloatArray:
        """Convert height, x, y, r to height on the line, place along it, distance in radii, radius: (n_samples, 4)."""
        height, x, y, r = theta.T
        along, beside_mm = self.line.line_coordinates_mm(x, y)
        beside = beside_mm / r
        return np.stack([height * np.exp(-0.5 * beside**2), along, beside, r], axis=-1)


def _patch(kind: LightEffect, of: Extent, size: str, unit: str, typical: float, act: Act, says: Say) -> Effect | None:
    """Return the effect of a patch on or beside one of the scanned lines; None without a line."""

    def on_line(line: ScanLine) -> Effect:
        patches = []
        for share in _RADII:
            r = share * line.length_mm
            along = np.arange(line.low_mm, line.high_mm + r / 2, r)
            x, y = line.lab_coordinates_mm(along, np.zeros_like(along))
            patches.append(single_column_bank(typical, x, y, r))
        parameters = dict.fromkeys((size, "x", "y", "r"), (AMPLITUDE, "mm")) | {size: (AMPLITUDE, unit)}
        free = kind.bind(of, parameters, act, says, np.concatenate(patches), amplitudes=(0,))
        return replace(free, parameters=PatchPrior(size, typical, line))

    return one_of([on_line(line) for line in distinct_scan_lines(of.plan)])


_NEAR = "within {3} mm of the place ({1}, {2}) mm"


@light_effect("glint", Stage.OFFSET, "a glint at one place", ("place",))
def glint(kind: LightEffect, of: Extent) -> Effect | None:
    """A reflection at one place, on black too: reading + amp exp(-d^2 / 2 r^2), d the distance from (x, y)."""

    @acting
    def act(value: FloatArray, plan: Plan, amp: FloatArray, x: FloatArray, y: FloatArray, r: FloatArray) -> FloatArray:
        return value + amp * gaussian_bump((plan.x_mm - x) ** 2 + (plan.y_mm - y) ** 2, r)

    says = f"{_NEAR} the readings are {{|0|}} too {{high/low}}, over black and white alike: a reflection"
    return _patch(kind, of, "amp", "reading", 0.02 * of.span, act, in_words(says, of.reading_unit))


@light_effect("albedo_gradient", Stage.SCENE, "unevenly white paper", ("place",), counts="place")
def albedo_gradient(kind: LightEffect, of: Extent) -> Effect:
    """Paper or illumination that is uneven across the table: S (1 + per_mm_x X + per_mm_y Y).

    X and Y are those of the lab frame, from the origin.
    """

    def act(value: SceneView, theta: FloatArray, plan: Plan) -> SceneView:
        return _with_changed_regions(value, plan, lambda region: RegionWithGradient(region, theta, of.origin))

    white = "the signal over white changes by {0} % per 100 mm along X and by {1} % per 100 mm along Y"
    says = f"{white}, that over black does not: the paper or its illumination is uneven"
    slopes: Declared = {"per_mm_x": (AMPLITUDE, "1/mm"), "per_mm_y": (AMPLITUDE, "1/mm")}
    return kind.bind(of, slopes, act, in_words(says, factors=(1e4, 1e4)), typical=0.02 / of.length_mm)


@light_effect("albedo_patch", Stage.SCENE, "a stain on the paper", ("place",))
def albedo_patch(kind: LightEffect, of: Extent) -> Effect | None:
    """A stain or a bright patch on every pattern: S + albedo exp(-d^2 / 2 r^2), d the distance from (x, y)."""

    def act(value: SceneView, theta: FloatArray, plan: Plan) -> SceneView:
        return _with_changed_regions(value, plan, lambda region: RegionWithPatch(region, theta))

    says = f"{_NEAR} every pattern is {{|0|}} % {{whiter/darker}} than it should be: a stain or a worn area"
    return _patch(kind, of, "albedo", "1", 0.05, act, in_words(says, factors=(100,)))


@dataclass(frozen=True, eq=False)
class ChangedRegion:
    """A region whose albedo an effect changes smoothly; its edges stay in place. Each sample has a row of `theta`."""

    region: Region
    theta: FloatArray

    @property
    def n_regions(self) -> int:
        """Number of regions, one for each sample; 1 where all samples share one."""
        return max(self.region.n_regions, len(self.theta))


@dataclass(frozen=True, eq=False)
class RegionWithGradient(ChangedRegion):
    """A region whose albedo is multiplied by 1 + theta . (X, Y), from `origin`; theta has shape (n_samples, 2)."""

    origin: Origin = field(default=Origin())

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        factor = np.asarray(1 + self.theta @ (points_mm - [self.origin.x_mm, self.origin.y_mm]).T)
        return self.region.albedo(points_mm) * factor


@mean_albedo_under_one_gaussian.register
def _mean_albedo_with_gradient(region: RegionWithGradient, gaussian: LabGaussian, n_nodes: int) -> FloatArray:
    """Return the mean albedo under each Gaussian, (n_samples, n_points), by Stein's lemma.

    The mean is the gradient's factor at the centre times the region's mean albedo, plus a central difference of the
    region's mean along the gradient.
    """
    a, b = region.theta[:, :1], region.theta[:, 1:]
    x, y = a * gaussian.var_x + b * gaussian.cov_xy, a * gaussian.cov_xy + b * gaussian.var_y  # C t
    rise = np.sqrt(np.maximum(a * x + b * y, TINY))  # sd of the field under the footprint, t.C t
    x, y = x / rise * _STEP, y / rise * _STEP

    def mean_albedo_at_shift(sign: float) -> FloatArray:
        moved = replace(gaussian, dx_mm=gaussian.dx_mm + sign * x, dy_mm=gaussian.dy_mm + sign * y)
        return mean_albedo_under_one_gaussian(region.region, moved, n_nodes)

    ahead, behind = mean_albedo_at_shift(1.0), mean_albedo_at_shift(-1.0)
    from_x = gaussian.x_mm + gaussian.dx_mm - region.origin.x_mm
    from_y = gaussian.y_mm + gaussian.dy_mm - region.origin.y_mm
    factor = 1 + a * from_x + b * from_y
    return np.asarray(factor * (ahead + behind) / 2 + rise * (ahead - behind) / (2 * _STEP))


@dataclass(frozen=True, eq=False)
class RegionWithPatch(ChangedRegion):
    """A region and a bell-shaped patch on it; theta holds its albedo, x, y, r, (n_samples, 4)."""

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        added, x, y, r = (self.theta[:, k : k + 1] for k in range(4))
        bump = gaussian_bump((points_mm[:, 0] - x) ** 2 + (points_mm[:, 1] - y) ** 2, r)
        return self.region.albedo(points_mm) + added * bump


@mean_albedo_under_one_gaussian.register
def _mean_albedo_with_patch(region: RegionWithPatch, gaussian: LabGaussian, n_nodes: int) -> FloatArray:
    """Return the mean albedo under each Gaussian: the region's, plus the patch's, a bell of covariance C + r^2."""
    albedo, x, y, r = (region.theta[:, k : k + 1] for k in range(4))
    from_x, from_y = gaussian.x_mm + gaussian.dx_mm - x, gaussian.y_mm + gaussian.dy_mm - y
    var_x, var_y = gaussian.var_x + r**2, gaussian.var_y + r**2
    det = var_x * var_y - gaussian.cov_xy**2
    distance = (var_y * from_x**2 + var_x * from_y**2 - 2 * gaussian.cov_xy * from_x * from_y) / det
    added = albedo * r**2 / np.sqrt(det) * np.exp(-0.5 * distance)
    return mean_albedo_under_one_gaussian(region.region, gaussian, n_nodes) + added


def _with_changed_regions(view: SceneView, plan: Plan, changed: Callable[[Region], Region]) -> SceneView:
    """Return a view of the regions over which at least one reading is taken, each changed."""
    with_readings = (name for name, _ in plan.rows_by_pattern() if name in view.regions)
    return replace(view, regions={name: changed(view.regions[name]) for name in with_readings})


@edge_distance.register
def _distance_to_edge(region: RegionWithGradient | RegionWithPatch, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Return the distance of points from the nearest edge of the region, which the effect leaves in place, mm."""
    return edge_distance(region.region, x_mm, y_mm)


@light_effect("height_gradient", Stage.FOOTPRINT, "a sloping table", ("place",), counts="place")
def height_gradient(kind: LightEffect, of: Extent) -> Effect:
    """A table that slopes: mm_per_mm X adds to the height; footprint x h/h0, signal x (h0/h)^2.

    h = h0 + mm_per_mm X with h0 of the recording's description, or 14 mm where it gives none; where a height is
    commanded, h is that height + mm_per_mm X. X counts from the origin.
    """

    def act(value: Footprint, theta: FloatArray, plan: Plan) -> Footprint:
        added = theta[:, :1] * (plan.x_mm - of.origin.x_mm) / _nominal_height_mm(plan)
        return footprint_at_added_height(value, added, plan)

    says = "the sensor's height above the surface {grows/shrinks} by {|0|} mm per 100 mm along X: the table slopes"
    typical = 0.01 * _nominal_height_mm(of.plan) / of.length_mm
    return kind.bind(of, {"mm_per_mm": (AMPLITUDE, "mm/mm")}, act, in_words(says, factors=(100,)), typical=typical)


@light_effect("height_offset", Stage.FOOTPRINT, "another sensor height in some scans", ("scan",))
def height_offset(kind: LightEffect, of: Extent) -> Effect | None:
    """One mounting or scan at another height: mm adds to the height there; footprint x h/h0, signal x (h0/h)^2.

    h0 and h are those of `height_gradient`.
    """

    def in_scans(scans: tuple[str, ...]) -> Effect:
        def act(value: Footprint, theta: FloatArray, plan: Plan) -> Footprint:
            added = theta * scan_indicator(plan, scans) / _nominal_height_mm(plan)
            return footprint_at_added_height(value, added, plan)

        says = in_words(f"in {scans_in_words(scans)} the sensor hangs {{|0|}} mm {{higher/lower}} than in the others")
        typical = 0.01 * _nominal_height_mm(of.plan)
        return kind.bind(of, {"mm": (AMPLITUDE, "mm")}, act, says, typical=typical, scans=scans)

    return one_of([in_scans(scans) for scans in candidate_scan_groups(of.plan)])


def _nominal_height_mm(plan: Plan) -> float:
    """Return the height in the recording's description, or 14 mm where it gives none."""
    return plan.instrumentation.height_mm or _USUAL_MM


@light_effect("slow_sinking", Stage.FOOTPRINT, "a sensor that slowly rises or sinks", ("time", "level"), counts="time")
def slow_sinking(kind: LightEffect, of: Extent) -> Effect:
    """The sensor sinks or rises: per_hour t h0 adds to the height; footprint x h/h0, signal x (h0/h)^2.

    t is the time since the origin in hours; h0 and h are those of `height_gradient`.
    """
    act = acting(lambda value, plan, rate: footprint_at_added_height(value, rate * of.origin.hours(plan), plan))
    says = "the sensor {rises/sinks} by {|0|} % of its height per hour: it is loose in its holder"
    words, typical = in_words(says, factors=(100,)), 0.01 / (of.duration_s / 3600)
    return kind.bind(of, {"per_hour": (AMPLITUDE, "1/h")}, act, words, typical=typical)


def _has_one_height(plan: Plan) -> bool:
    ratio = height_ratio(plan)
    return ratio is None or float(np.ptp(ratio)) == 0.0


_EDGE = ("edge_distance",)


@light_effect("edge_blur", Stage.FOOTPRINT, "soft printed edges", _EDGE, is_absorbed_by_ssf=_has_one_height)
def edge_blur(kind: LightEffect, of: Extent) -> Effect:
    """Printed edges are blurred by a Gaussian of sd_mm, which acts as a wider footprint over sharp edges would.

    The footprint's covariance grows by sd_mm^2 along each axis, whatever the sensor's orientation. It equals a wider
    SSF unless the height varies, which scales a footprint but not a blur.
    """

    def act(value: Footprint, theta: FloatArray, plan: Plan) -> Footprint:
        wider = theta[:, :, None] ** 2
        return replace(value, var_u=value.var_u + wider, var_v=value.var_v + wider)

    says, typical = in_words("the printed edges are soft: blurred by {0} mm (sd)"), 0.02 * of.length_mm
    return kind.bind(of, {"sd_mm": (POSITIVE, "mm")}, act, says, typical=typical, kind=_BlurEffect)


class _BlurEffect(Effect):
    def start(self, entry: FloatArray, amounts: FloatArray) -> FloatArray:
        """Return a starting sd, (1,): the entry's, its square scaled by the fitted amount."""
        return np.asarray(entry[0] * np.sqrt(max(float(amounts[0]), 1e-4)))


@light_effect("halo", Stage.FOOTPRINT, "scattered light around the spot", ("edge_distance",))
def halo(kind: LightEffect, of: Extent) -> Effect:
    """Light scattered in the lens: `share` of the footprint becomes one more Gaussian, of sd r_mm about its centre."""

    def act(value: Footprint, theta: FloatArray, plan: Plan) -> Footprint:
        share, variance = theta[:, :1, None], theta[:, 1:2, None] ** 2
        u_mm, v_mm = (np.sum(value.weight * mean, axis=2, keepdims=True) for mean in (value.u_mm, value.v_mm))
        more = Footprint(share, u_mm, v_mm, variance, variance, np.zeros((1, 1, 1)))
        return _with_more_gaussians(value, (1 - share) * value.weight, more)

    says = "a wide halo around the sensor's spot, of sd {1} mm, contributes {0} % of the light: the lens scatters it"
    radii = LogUniform(0.1 * of.length_mm, of.length_mm)
    parameters = {"share": (LogUniform(1e-3, 0.7), "1"), "r_mm": (radii, "mm")}
    bank = single_column_bank(0.02, sizes_inside(radii, 5, 1.2))
    return kind.bind(of, parameters, act, in_words(says, factors=(100,)), bank, amplitudes=(0,))


def _with_more_gaussians(value: Footprint, weight: FloatArray, more: Footprint) -> Footprint:
    """Return a footprint, its Gaussians with other weights, and more of them beside these."""

    def joined(own: FloatArray, added: FloatArray) -> FloatArray:
        shape = np.broadcast_shapes(own.shape[:2], added.shape[:2])
        first = np.broadcast_to(own, (*shape, max(own.shape[2], weight.shape[2])))
        second = np.broadcast_to(added, (*shape, max(added.shape[2], more.weight.shape[2])))
        return np.concatenate([first, second], axis=2)

    whole = Footprint(joined(weight, more.weight), *map(joined, value.moments, more.moments))
    return replace(whole, brightness=value.brightness)


@light_effect("edge_shadow", Stage.SEEN, "shadows along the edges", ("edge_distance",))
def edge_shadow(kind: LightEffect, of: Extent) -> Effect:
    """A raised edge casts a shadow: u - amp exp(-d^2 / 2 w^2), d the sensor's distance from the nearest edge.

    Here u is the seen white fraction; widths lie between a hundredth and a third of the longest scan. Patterns may be
    made in different ways, one glued on, another printed: raised edges may belong to all kinds of pattern, to one kind,
    or to all kinds but one.
    """
    by_type: dict[type, list[str]] = {}
    for name, _ in of.plan.rows_by_pattern():
        if isinstance(pattern := of.plan.patterns.get(name), HalfPlane | Quadrant | Disc | Polygon | Stripes):
            by_type.setdefault(type(pattern), []).append(name)
    kinds = [tuple(names) for names in by_type.values()]
    but_one = [tuple(itertools.chain(*kinds[:k], *kinds[k + 1 :])) for k in range(len(kinds))]
    choices = tuple(dict.fromkeys([(), *kinds, *but_one])) if len(kinds) > 1 else ((),)
    found = one_of([edge_shadow_of_patterns(kind, of, patterns) for patterns in choices])
    assert found is not None
    return found


def edge_shadow_of_patterns(kind: LightEffect, of: Extent, patterns: tuple[str, ...]) -> Effect:
    """Return the shadow along the edges of these patterns, () for all."""
    widths = LogUniform(0.01 * of.length_mm, of.length_mm / 3)

    def act(value: View, theta: FloatArray, plan: Plan) -> View:
        x_mm, y_mm = (np.broadcast_to(a, (len(a), len(plan))) for a in (value.poses.x_mm, value.poses.y_mm))
        parts = [
            (rows, edge_distance(value.regions[name], x_mm[:, rows], y_mm[:, rows]))
            for name, rows in plan.rows_by_pattern()
            if not patterns or name in patterns
        ]
        distance = np.full((max((len(part) for _, part in parts), default=1), len(plan)), np.inf)
        for rows, part in parts:
            distance[:, rows] = part
        return replace(value, seen=value.seen - theta[:, :1] * gaussian_bump(distance**2, theta[:, 1:2]))

    where = f"of an edge of pattern {', '.join(patterns)}" if patterns else "of an edge"
    looks = f"within {{1}} mm {where} the surface looks {{|0|}} % {{darker/brighter}} than the pattern explains"
    says = in_words(f"{looks}: the edge {{casts a shadow/reflects light}}", factors=(100,))
    parameters: Declared = {"amp": (AMPLITUDE, "1"), "w": (widths, "mm")}
    bank = single_column_bank(1.0, sizes_inside(widths, 6))
    source = partial(edge_shadow_of_patterns, kind, of, patterns)
    return kind.bind(of, parameters, act, says, bank, typical=0.01, patterns=patterns, source=source)


@light_effect("reflection", Stage.FOOTPRINT, "a reflection beside the spot", ("place", "edge_distance"))
def reflection(kind: LightEffect, of: Extent) -> Effect:
    """`share` of the light comes from a copy of the footprint, displaced by (dx_mm, dy_mm) in the lab frame."""
    farthest_mm = 0.5 * of.length_mm

    def act(value: Footprint, theta: FloatArray, plan: Plan) -> Footprint:
        share, dx, dy = np.clip(theta[:, :1, None], 0.0, 1.0), theta[:, 1:2, None], theta[:, 2:3, None]
        c, s = np.cos(plan.orientation_rad[None, :, None]), np.sin(plan.orientation_rad[None, :, None])
        u_mm, v_mm = value.u_mm + c * dx + s * dy, value.v_mm - s * dx + c * dy
        more = replace(value, weight=value.weight * share, u_mm=u_mm, v_mm=v_mm)
        return _with_more_gaussians(value, value.weight * (1 - share), more)

    angles, reach = 2 * math.pi * np.arange(_ANGLES) / _ANGLES, Uniform(-farthest_mm, farthest_mm)
    far = farthest_mm * np.array([0.2, 0.4, 0.8])[:, None]
    bank = single_column_bank(1.0, (far * np.cos(angles)).ravel(), (far * np.sin(angles)).ravel())
    spot = "a second spot, {1} mm along X and {2} mm along Y from the first, contributes {0} % of the light"
    says = in_words(f"{spot}: a reflection", factors=(100,))
    parameters: Declared = {"share": (POSITIVE, "1"), "dx_mm": (reach, "mm"), "dy_mm": (reach, "mm")}
    return kind.bind(of, parameters, act, says, bank, typical=0.02)
