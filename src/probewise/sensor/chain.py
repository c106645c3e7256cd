"""The sensor model as a chain of stages, from scene to reading (paper, section 2.5, eq. 7)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise._kinds import checked_number, require_like
from probewise.errors import ParameterError, require
from probewise.recordings.columns import how_to_describe_pattern
from probewise.recordings.plan import Plan
from probewise.scene.regions import HalfPlaneRegion, QuadrantRegion, Region
from probewise.scene.scenes import Card, CardedScene, Scene
from probewise.sensor.commanded import (
    footprint_at_commanded_height,
    has_commanded_height_or_led,
    led_state,
    with_declared_height_commanded,
)
from probewise.sensor.gaussian import ACCURATE_NODES, LabGaussian, mean_albedo_under_one_gaussian, moments_in_lab_frame
from probewise.sensor.ssf import FreeMixture, SSFModel
from probewise.sensor.stages import (
    AnyEffect,
    Footprint,
    NoiseParameters,
    Poses,
    SceneView,
    SensorModel,
    Stage,
    View,
    effects_with_columns,
    parameter_names_of_effects,
    require_theta_columns,
)
from probewise.sensor.straight import StraightCorners, StraightEdges, select_reading_columns

_MANY = 8  # Gaussians, from which on it pays to look for hypotheses that share their geometry
_MOST_NUMBERS = 2_000_000  # held in memory at once of footprints that differ between readings
_SAME = 1e-9  # mm and mm^2: smaller differences are rounding
_FEW = 8  # hypotheses: up to so many are computed together even where they share no geometry


class Levels(Protocol):
    """A sensor's levels (its readings over black, I_min, and white, I_max), as a function of the parameters."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        ...

    def values(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return I_min and I_max from the levels' columns of theta, each broadcasting to (n_samples, n_points)."""
        ...


@dataclass(frozen=True)
class FreeLevels:
    """Levels to be estimated: the paper's I_min and I_max."""

    @property
    def names(self) -> tuple[str, ...]:
        return ("I_min", "I_max")

    def values(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        return theta[:, :1], theta[:, 1:2]


@dataclass(frozen=True)
class FixedLevels:
    """Levels that are known, in units of the reading."""

    i_min: float
    i_max: float

    def __post_init__(self) -> None:
        both = self.i_min, self.i_max
        for name, level in zip(("i_min", "i_max"), both, strict=True):
            checked_number(name, level)
        require(np.isfinite(both).all(), "FixedLevels(i_min, i_max)", both, "finite numbers")

    @property
    def names(self) -> tuple[str, ...]:
        return ()

    def values(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.array([[self.i_min]]), np.array([[self.i_max]])


def require_levels(levels: object, order: str) -> None:
    """Raise ParameterError, with the hint `order` in its text, unless `levels` has `names` and `values`."""
    require_like("levels", levels, ("names", "values"), f"FreeLevels() or FixedLevels(i_min, i_max), {order}")


def require_scene(scene: object, order: str) -> None:
    """Raise ParameterError, with the hint `order` in its text, unless `scene` has `names` and `regions`."""
    allowed = f"a scene such as HypothesisScene(Circle()) or KnownScene(plan.patterns), {order}"
    require_like("scene", scene, ("names", "regions"), allowed)


@dataclass(frozen=True)
class Chain:
    """A sensor model: pose, scene, footprint, seen fraction, response curve, gain, offset, lag, saturation.

    M = I_min + (I_max - I_min) R (paper, eq. 7), with R the SSF's response to the scene and
    any number of effects, each one function at one stage. Effects are sorted by stage and, within
    a stage, by name, whatever the order in which they are given. Columns of theta: the SSF's,
    the levels', the scene's, then the effects' as "effect.parameter".

    Blur and halo are those at the commanded height: by the order of names they come first, so a sloping table or
    another error of the height scales them too, as in recordings simulated by `probewise.world`. Blurred print does not
    scale, strictly; at usual sizes another order changes readings by less than 0.3 % of I_max - I_min.

    `n_nodes` is the number of quadrature nodes over curved edges (the default is accurate to 1e-8 of
    I_max - I_min, `FAST_NODES` to 1e-4, mostly 1e-5). `calibrated_height_mm` is the height at which SSF and levels
    hold, so that a plan may declare another; None: the height that a plan declares.
    """

    ssf: SSFModel
    levels: Levels
    scene: Scene
    effects: tuple[AnyEffect, ...] = ()
    n_nodes: int = field(default=ACCURATE_NODES, kw_only=True)
    calibrated_height_mm: float | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        order = "in the order Chain(ssf, levels, scene)"
        require_like("ssf", self.ssf, ("names", "footprint"), f"an SSF such as FreeMixture(1) or FixedMixture, {order}")
        require_levels(self.levels, order)
        require_scene(self.scene, order)
        labels = [effect.name for effect in self.effects]
        require(len(set(labels)) == len(labels), "effects", labels, "each name once")
        object.__setattr__(self, "effects", tuple(sorted(self.effects, key=lambda e: (e.stage, e.name))))

    @cached_property
    def names(self) -> tuple[str, ...]:
        return (*self.ssf.names, *self.levels.names, *self.scene.names, *parameter_names_of_effects(self.effects))

    def with_effects(self, *effects: AnyEffect) -> Chain:
        """Return the chain with these effects added."""
        return replace(self, effects=(*self.effects, *effects))

    def plan_at_calibrated_height(self, plan: Plan) -> Plan:
        """Return the plan with the calibrated height declared; where it declared another, that one is commanded."""
        return with_declared_height_commanded(plan, self.calibrated_height_mm)

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Predict noise-free readings.

        `theta`: hypotheses, shape (n_samples, n_params), columns as `names`; `plan`: pose, time and pattern of every
        reading, n_points rows. Returns readings, shape (n_samples, n_points). Raises ShapeError if the columns of theta
        do not match `names`; ParameterError if the plan has a pattern that the scene lacks, or theta holds no valid
        SSF.
        """
        plan = self.plan_at_calibrated_height(plan)
        at_once = len(theta)
        if any(effect.stage == Stage.FOOTPRINT for effect in self.effects):  # fewer, for memory
            at_once = max(_MOST_NUMBERS // max(len(plan) * (len(self.ssf.names) // 6), 1), 1)
        if at_once < len(theta):
            blocks = (theta[first : first + at_once] for first in range(0, len(theta), at_once))
            return np.concatenate([self.predict(block, plan) for block in blocks])
        view = self.simulated_view(theta, plan)
        if self.effects or has_commanded_height_or_led(plan):
            return self.readings_from_simulated_view(view, theta, plan)
        i_min, i_max = self._levels_from_theta(theta)
        reading = view.seen if len(view.seen) == len(theta) else np.repeat(view.seen, len(theta), axis=0)
        reading *= i_max - i_min
        reading += i_min
        return reading

    def readings_from_simulated_view(self, view: View, theta: FloatArray, plan: Plan) -> FloatArray:
        """Compute readings from a result of `simulated_view`, (n_samples, n_points): the stages from SEEN on.

        `view` may hold one hypothesis where those of theta differ only in these stages.
        """
        plan = self.plan_at_calibrated_height(plan)
        apply = self._stage_applier(theta, plan)
        seen = apply(Stage.RESPONSE, apply(Stage.SEEN, view).seen)
        i_min, i_max = self._levels_from_theta(theta)
        reading: FloatArray = i_min + apply(Stage.GAIN, (i_max - i_min) * led_state(plan) * view.brightness * seen)
        for stage in (Stage.OFFSET, Stage.LAG, Stage.SATURATION):
            reading = apply(stage, reading)
        shape = (len(theta), len(plan))
        return reading if reading.shape == shape else np.array(np.broadcast_to(reading, shape))

    def _levels_from_theta(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        n_ssf = len(self.ssf.names)
        return self.levels.values(theta[:, n_ssf : n_ssf + len(self.levels.names)])

    def simulated_view(self, theta: FloatArray, plan: Plan) -> View:
        """Return the sensor's view of the scene: the stages of `predict` before SEEN, with their effects."""
        require_theta_columns(theta, self.names)
        plan = self.plan_at_calibrated_height(plan)
        layout = self._layout_under_poses(theta, plan)
        plain = footprint_at_commanded_height(self.ssf.footprint(theta[:, : len(self.ssf.names)]), plan)
        footprint: Footprint = self._stage_applier(theta, plan)(Stage.FOOTPRINT, plain)
        geometries = self._hypotheses_by_geometry(theta, footprint)
        if geometries is None:
            seen = response(layout, footprint, n_nodes=self.n_nodes)
        else:
            alone = self._layout_under_poses(theta[geometries[0]].repeat(footprint.weight.shape[2], axis=0), plan)
            seen = _response_of_each_geometry(alone, footprint, *geometries, n_nodes=self.n_nodes)
        return View(seen, layout.poses, layout.regions, footprint.brightness)

    def poses(self, theta: FloatArray, plan: Plan) -> Poses:
        """Return the true poses, the plan's with effects on the pose applied: lab frame, (n_samples or 1, n_points)."""
        plan = self.plan_at_calibrated_height(plan)
        told = Poses(plan.x_mm[None], plan.y_mm[None], plan.orientation_rad[None])
        found: Poses = self._stage_applier(theta, plan)(Stage.POSE, told)
        return found

    def _hypotheses_by_geometry(self, theta: FloatArray, footprint: Footprint) -> tuple[IntArray, IntArray] | None:
        """Group hypotheses that differ only in the weights of their Gaussians; None where grouping saves nothing.

        Returns the index of each group's first hypothesis, (n_geometries,), and each one's group, (n_samples,).
        """
        few = not isinstance(self.ssf, FreeMixture) or self.ssf.n_gaussians < _MANY
        if few or footprint.weight.shape[1] > 1:
            return None
        own = np.ones(theta.shape[1], dtype=np.bool_)
        n_ssf = len(self.ssf.names)
        own[:n_ssf:6] = False
        own[n_ssf : n_ssf + len(self.levels.names)] = False
        for effect, columns in self._effects_and_columns:
            own[columns] = effect.stage <= Stage.FOOTPRINT
        numbers: dict[bytes, int] = {}  # of the geometries, in order of their first hypothesis
        which = np.array([numbers.setdefault(row.tobytes(), len(numbers)) for row in theta[:, own]])
        if 2 * len(numbers) > len(theta) > _FEW:
            return None
        first = np.unique(which, return_index=True)[1]
        # An effect may place a Gaussian by the weights of others, as a halo about their common centre.
        moved = (np.abs(a - a[first][which]).max() > _SAME for a in footprint.moments if len(a) == len(theta))
        return None if len(first) < len(theta) and any(moved) else (first, which)

    def _layout_under_poses(self, theta: FloatArray, plan: Plan) -> RegionsAndPoses:
        """Return the regions and the poses over them; cached for the last plan if no parameter moves scene or poses."""
        fixed = not self.scene.names and all(effect.stage > Stage.SCENE for effect in self.effects)
        known = self._layout_cache.get(plan) if fixed else None
        if known is not None:
            return known
        apply = self._stage_applier(theta, plan)
        start = len(self.ssf.names) + len(self.levels.names)
        regions = self.scene.regions(theta[:, start : start + len(self.scene.names)])
        poses = self.poses(theta, plan)
        view: SceneView = apply(Stage.SCENE, SceneView(regions))
        x_mm, y_mm = poses.x_mm - view.dx_mm, poses.y_mm - view.dy_mm
        layout = RegionsAndPoses(view.regions, Poses(x_mm, y_mm, poses.orientation_rad), plan)
        if fixed:
            self._layout_cache.clear()
            self._layout_cache[plan] = layout
        return layout

    @cached_property
    def _layout_cache(self) -> dict[Plan, RegionsAndPoses]:
        """Layout of the last plan, by that plan, where no parameter changes it; otherwise empty."""
        return {}

    def noise_parameters(self, theta: FloatArray, plan: Plan, sd: FloatArray) -> NoiseParameters:
        """Return the noise of each reading: `sd`, broadcasting to (n_samples, n_points), with effects on the noise."""
        require_theta_columns(theta, self.names)
        plan = self.plan_at_calibrated_height(plan)
        start = NoiseParameters(np.asarray(sd, dtype=np.float64), np.zeros((1, 1)))
        if not any(effect.stage == Stage.NOISE for effect in self.effects):
            return start
        start = replace(start, seen=self.simulated_view(theta, plan).seen)
        noise: NoiseParameters = self._stage_applier(theta, plan)(Stage.NOISE, start)
        return noise

    def _stage_applier(self, theta: FloatArray, plan: Plan) -> Callable[[Stage, Any], Any]:
        """Return a function that applies the effects of one stage to that stage's value."""

        def apply(stage: Stage, value: Any) -> Any:
            for effect, columns in self._effects_and_columns:
                if effect.stage == stage:
                    value = effect.apply(value, theta[:, columns], plan)
            return value

        return apply

    @cached_property
    def _effects_and_columns(self) -> list[tuple[AnyEffect, slice]]:
        first = len(self.ssf.names) + len(self.levels.names) + len(self.scene.names)
        return effects_with_columns(self.effects, first)


def cards_of(model: SensorModel) -> tuple[Card, ...]:
    """Return the known cards on a model's field; empty if its scene has none."""
    scene = getattr(model, "scene", None)
    return scene.cards if isinstance(scene, CardedScene) else ()


@dataclass(frozen=True, eq=False)
class RegionsAndPoses:
    """The region under each reading and the sensor's pose relative to it: all that does not depend on the SSF.

    Using the layout raises ParameterError if the plan has a pattern that the regions lack.

    `regions`: region by pattern name; `poses`: true poses minus the displacement of each reading's pattern from its
    described place, arrays broadcasting to (n_samples, n_points); `plan`: which pattern lies under each reading.
    """

    regions: Mapping[str, Region]
    poses: Poses
    plan: Plan

    @cached_property
    def n_samples(self) -> int:
        """Number of hypotheses over which the poses or regions vary, or 1."""
        return max([1, *map(len, self.poses.arrays), *(region.n_regions for _, region in self.rows_and_regions)])

    @cached_property
    def rows_and_regions(self) -> list[tuple[IntArray, Region]]:
        """Row indices of the readings over each region, and the region: a pair for each pattern of the plan."""
        return [(rows, region_named(self.regions, name)) for name, rows in self.plan.rows_by_pattern()]

    @cached_property
    def straight_batches(self) -> tuple[StraightEdges | StraightCorners, ...]:
        """Straight edges and corners of all patterns that are the same for all hypotheses, in a batch of each kind.

        Empty where poses differ between hypotheses.
        """
        if any(len(a) > 1 for a in self.poses.arrays):
            return ()
        known = [(rows, region) for rows, region in self.rows_and_regions if region.n_regions == 1]
        edges = [(rows, region) for rows, region in known if isinstance(region, HalfPlaneRegion)]
        corners = [(rows, region) for rows, region in known if isinstance(region, QuadrantRegion)]
        return (
            *((StraightEdges.from_regions(edges, self.poses),) if edges else ()),
            *((StraightCorners.from_regions(corners, self.poses),) if corners else ()),
        )

    @cached_property
    def rows_and_regions_by_orientation(self) -> list[tuple[IntArray, Region]]:
        """As `rows_and_regions`, but split by orientation, where that does not depend on the sample.

        Moments of the footprint in the lab frame are then computed once per group instead of once per reading.
        """
        turn, out = self.poses.orientation_rad, list[tuple[IntArray, Region]]()
        for rows, region in self.rows_and_regions:
            groups = [rows]
            if len(turn) == 1 < turn.shape[1]:
                distinct, which = np.unique(turn[0, rows], return_inverse=True)
                if len(distinct) <= max(8, len(rows) // 8):
                    groups = [rows[which == k] for k in range(len(distinct))]
            out += [(group, region) for group in groups]
        return out


def response(layout: RegionsAndPoses, footprint: Footprint, *, n_nodes: int = ACCURATE_NODES) -> FloatArray:
    """Integrate the footprint over each reading's pattern (paper, eq. 8).

    By closed forms, and quadrature at curved edges. A kind of region without a closed form is seen at some thousand
    places: error about 1e-3, with a `SlowWarning`.

    Returns R, shape (n_samples, n_points); n_samples is 1 where it is the same for all hypotheses.

    `layout`: what lies under the sensor at each reading; `footprint`: SSF in the sensor frame, arrays broadcasting to
    (n_samples, n_points, n_gaussians); `n_nodes`: nodes of the quadrature over curved edges.
    """
    parts = (footprint.weight, *footprint.moments)
    out = np.zeros((max(layout.n_samples, *map(len, parts)), len(layout.plan)))
    batches = () if any(a.shape[1] > 1 for a in parts) else layout.straight_batches
    for part in batches:
        out[:, part.rows] = part.response(footprint)
    for rows, region in layout.rows_and_regions_by_orientation:
        if any((part.rows == rows[0]).any() for part in batches):
            continue
        x, y, turn = (select_reading_columns(a, rows) for a in layout.poses.arrays)
        if turn.shape[0] == 1 and (turn == turn[:, :1]).all():
            turn = turn[:, :1]
        for g in range(footprint.weight.shape[2]):
            one = (select_reading_columns(a[:, :, g if a.shape[2] > 1 else 0], rows) for a in footprint.moments)
            seen = mean_albedo_under_one_gaussian(region, LabGaussian(x, y, *moments_in_lab_frame(turn, *one)), n_nodes)
            out[:, rows] += select_reading_columns(footprint.weight[:, :, g], rows) * seen
    return out


def _response_of_each_geometry(
    layout: RegionsAndPoses, footprint: Footprint, first: IntArray, which: IntArray, *, n_nodes: int
) -> FloatArray:
    """Integrate as `response` does, but each Gaussian of each geometry only once: the response is linear in weights.

    `layout` is that of each geometry, repeated n_gaussians times; `footprint` that of all hypotheses, with weights that
    are the same at every reading. Returns R of every hypothesis, (n_samples, n_points).
    """
    n_samples, n_gaussians = len(which), footprint.weight.shape[2]

    def one_row_per_gaussian(array: FloatArray) -> FloatArray:
        """Make each Gaussian a row: (n_samples or 1, n, n_gaussians) -> (n_geometries n_gaussians, n, 1)."""
        own = np.broadcast_to(array, (n_samples, *array.shape[1:]))[first]
        return np.moveaxis(own, 2, 1).reshape(-1, array.shape[1], 1)

    one_each = Footprint(np.ones((len(first) * n_gaussians, 1, 1)), *map(one_row_per_gaussian, footprint.moments))
    parts = response(layout, one_each, n_nodes=n_nodes).reshape(-1, n_gaussians, len(layout.plan))
    weight = np.broadcast_to(footprint.weight[:, 0], (n_samples, n_gaussians))
    return np.stack([own @ parts[at] for own, at in zip(weight, which, strict=True)])


def region_named(regions: Mapping[str, Region], name: str) -> Region:
    """Return the region of the pattern `name`.

    Raises ParameterError, which says how to describe the pattern, if there is no such region.
    """
    try:
        return regions[name]
    except KeyError:
        raise ParameterError("pattern", name, how_to_describe_pattern(name, list(regions))) from None
