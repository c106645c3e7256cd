"""From scene to reading: the sensor model as a chain of stages (paper, eq. modelI)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import ParameterError
from probewise.recordings.plan import Plan
from probewise.scene.albedo import Region, Scene
from probewise.scene.regions import HalfPlaneRegion, QuadrantRegion
from probewise.sensor._normal import normal_cdf
from probewise.sensor.discrete import seen_discrete
from probewise.sensor.gaussian import ACCURATE_NODES, Spot, mass_in_quadrant, seen_by_one
from probewise.sensor.ssf import FieldSSF, SSFModel
from probewise.sensor.stages import (
    AnyEffect,
    Footprint,
    NoiseLevel,
    Poses,
    SceneView,
    Stage,
    require_columns,
)

__all__ = ["Chain", "FixedLevels", "FreeLevels", "Levels", "response"]


class Levels(Protocol):
    """The readings over black and over white."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        ...

    def values(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """I_min and I_max, each broadcasting to (n_samples, n_points)."""
        ...


@dataclass(frozen=True)
class FreeLevels:
    """Levels to be estimated: the paper's I_min and I_max."""

    @property
    def names(self) -> tuple[str, ...]:
        """I_min, I_max."""
        return ("I_min", "I_max")

    def values(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Columns of theta, each (n_samples, 1)."""
        return theta[:, :1], theta[:, 1:2]


@dataclass(frozen=True)
class FixedLevels:
    """Levels that are known, in units of the reading."""

    i_min: float
    i_max: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.i_min) and np.isfinite(self.i_max)):
            raise ParameterError("FixedLevels(i_min, i_max)", (self.i_min, self.i_max), "finite numbers")

    @property
    def names(self) -> tuple[str, ...]:
        """No free parameters."""
        return ()

    def values(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Give the two numbers, each (1, 1)."""
        return np.array([[self.i_min]]), np.array([[self.i_max]])


@dataclass(frozen=True)
class Chain:
    """A sensor model: pose, scene, footprint, seen fraction, response curve, gain, offset, lag, saturation.

    M = I_min + (I_max - I_min) R (paper, eq. modelI), with R what the SSF sees of the scene and
    any number of effects, each one function at one stage. Effects are held in the order of the
    stages, whatever the order in which they are given; those of one stage keep theirs. Columns
    of theta: the SSF's, the levels', the scene's, then the effects' as "effect.parameter".

    `n_nodes` is the number of quadrature nodes over curved edges (the default holds 1e-8 of the
    span, `FAST_NODES` 1e-4).
    """

    ssf: SSFModel
    levels: Levels
    scene: Scene
    effects: tuple[AnyEffect, ...] = ()
    n_nodes: int = field(default=ACCURATE_NODES, kw_only=True)

    def __post_init__(self) -> None:
        if isinstance(self.ssf, FieldSSF) and any(effect.stage == Stage.FOOTPRINT for effect in self.effects):
            names = [effect.name for effect in self.effects if effect.stage == Stage.FOOTPRINT]
            raise ParameterError("effects", names, "none at the footprint with a FieldSSF; use mixture_of_field")
        labels = [effect.name for effect in self.effects]
        if len(set(labels)) < len(labels):
            raise ParameterError("effects", labels, "each name once")
        object.__setattr__(self, "effects", tuple(sorted(self.effects, key=lambda effect: effect.stage)))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, one a column of theta."""
        own = (f"{effect.name}.{name}" for effect in self.effects for name in effect.prior.names)
        return (*self.ssf.names, *self.levels.names, *self.scene.names, *own)

    def with_effects(self, *effects: AnyEffect) -> Chain:
        """Add effects to the chain."""
        return replace(self, effects=(*self.effects, *effects))

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Noise-free readings.

        Parameters
        ----------
        theta
            Hypotheses, shape (n_samples, n_params), columns as `names`.
        plan
            Where, when and over what, n_points rows.

        Returns
        -------
        Readings, shape (n_samples, n_points).

        Raises
        ------
        ShapeError
            If theta has other columns than `names`.
        ParameterError
            If the plan has a pattern that the scene lacks, or theta names no proper SSF.
        """
        seen = self.seen(theta, plan)
        if not self.effects:
            return self._read(seen, theta)
        apply = self._applier(theta, plan)
        seen = apply(Stage.RESPONSE, apply(Stage.SEEN, seen))
        i_min, i_max = self._levels(theta)
        reading: FloatArray = i_min + apply(Stage.GAIN, (i_max - i_min) * seen)
        for stage in (Stage.OFFSET, Stage.LAG, Stage.SATURATION):
            reading = apply(stage, reading)
        shape = (len(theta), len(plan))
        return reading if reading.shape == shape else np.array(np.broadcast_to(reading, shape))

    def _levels(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        n_ssf = len(self.ssf.names)
        return self.levels.values(theta[:, n_ssf : n_ssf + len(self.levels.names)])

    def _read(self, seen: FloatArray, theta: FloatArray) -> FloatArray:
        """Turn R into readings where no effect acts, in place: `seen` is this call's own."""
        i_min, i_max = self._levels(theta)
        reading = seen if len(seen) == len(theta) else np.repeat(seen, len(theta), axis=0)
        reading *= i_max - i_min
        reading += i_min
        return reading

    def seen(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Seen white fraction R before any effect on it, shape (n_samples or 1, n_points)."""
        require_columns(theta, self.names)
        apply = self._applier(theta, plan)
        n_ssf = len(self.ssf.names)
        n_before = n_ssf + len(self.levels.names)
        poses = Poses(plan.x_mm[None], plan.y_mm[None], plan.orientation_rad[None])
        poses = apply(Stage.POSE, poses)
        regions = self.scene.regions(theta[:, n_before : n_before + len(self.scene.names)])
        view = apply(Stage.SCENE, SceneView(regions))
        if isinstance(self.ssf, FieldSSF):
            return _discrete_response(view.regions, self.ssf, poses, plan)
        footprint = apply(Stage.FOOTPRINT, self.ssf.footprint(theta[:, :n_ssf]))
        return response(view.regions, footprint, poses, plan, n_nodes=self.n_nodes)

    def noise_level(self, theta: FloatArray, plan: Plan, sd: FloatArray) -> NoiseLevel:
        """Noise of each reading: `sd` broadcasting to (n_samples, n_points), then the effects on it."""
        require_columns(theta, self.names)
        start = NoiseLevel(np.asarray(sd, dtype=np.float64), np.zeros((1, 1)))
        level: NoiseLevel = self._applier(theta, plan)(Stage.NOISE, start)
        return level

    def _applier(self, theta: FloatArray, plan: Plan) -> Callable[[Stage, Any], Any]:
        """Give a function that applies the effects of one stage to that stage's value."""

        def apply(stage: Stage, value: Any) -> Any:
            for effect, columns in self._columns:
                if effect.stage == stage:
                    value = effect.apply(value, theta[:, columns], plan)
            return value

        return apply

    @cached_property
    def _columns(self) -> list[tuple[AnyEffect, slice]]:
        """Columns of theta that belong to each effect."""
        end = len(self.ssf.names) + len(self.levels.names) + len(self.scene.names)
        pairs = []
        for effect in self.effects:
            start, end = end, end + len(effect.prior.names)
            pairs.append((effect, slice(start, end)))
        return pairs


def response(
    regions: Mapping[str, Region],
    footprint: Footprint,
    poses: Poses,
    plan: Plan,
    *,
    n_nodes: int = ACCURATE_NODES,
) -> FloatArray:
    """Integrate the footprint over each reading's pattern (paper, eq. R), by the closed forms.

    Parameters
    ----------
    regions
        Region by pattern name.
    footprint
        SSF in the sensor frame, arrays broadcasting to (n_samples, n_points, n_gaussians).
    poses
        Where the sensor stands, arrays broadcasting to (n_samples, n_points).
    plan
        Which pattern lies under each reading.
    n_nodes
        Nodes of the quadrature over curved edges.

    Returns
    -------
    R, shape (n_samples, n_points); n_samples is 1 where nothing depends on the sample.

    Raises
    ------
    ParameterError
        If the plan has a pattern that the regions lack.
    """
    parts = [(rows, _region_named(regions, name)) for name, rows in plan.rows_by_pattern()]
    place = (poses.x_mm, poses.y_mm, poses.orientation_rad)
    arrays = (footprint.weight, footprint.u_mm, footprint.v_mm, footprint.var_u, footprint.var_v, footprint.cov_uv)
    n_samples = max(1, *(a.shape[0] for a in (*arrays, *place)), *(region.n_regions for _, region in parts))
    n_gaussians = max(a.shape[2] for a in arrays)
    gaussians = [_Gaussian(*(a[:, :, g if a.shape[2] > 1 else 0] for a in arrays)) for g in range(n_gaussians)]
    out = np.zeros((n_samples, len(plan)))
    half_planes: list[tuple[IntArray, HalfPlaneRegion]] = []
    quadrants: list[tuple[IntArray, QuadrantRegion]] = []
    for rows, region in parts:
        if region.n_regions == 1 and poses.orientation_rad.shape[0] == 1:
            # Known straight edges of all patterns are taken together: calibration lives on them.
            if isinstance(region, HalfPlaneRegion):
                half_planes.append((rows, region))
                continue
            if isinstance(region, QuadrantRegion):
                quadrants.append((rows, region))
                continue
        for group in _by_orientation(rows, poses.orientation_rad):
            for gaussian in gaussians:
                spot = gaussian.spot(poses, group)
                out[:, group] += _columns_of(gaussian.weight, group) * seen_by_one(region, spot, n_nodes)
    if half_planes:
        _add_half_planes(out, half_planes, gaussians, poses)
    if quadrants:
        _add_quadrants(out, quadrants, gaussians, poses)
    return out


@dataclass(frozen=True, eq=False)
class _Gaussian:
    """One Gaussian of the footprint in the sensor frame, arrays broadcasting to (n_samples, n_points)."""

    weight: FloatArray
    u_mm: FloatArray
    v_mm: FloatArray
    var_u: FloatArray
    var_v: FloatArray
    cov_uv: FloatArray

    @property
    def varies(self) -> bool:
        """Whether it depends on the reading."""
        return any(a.shape[1] > 1 for a in (self.u_mm, self.v_mm, self.var_u, self.var_v, self.cov_uv))

    def spot(self, poses: Poses, rows: IntArray) -> Spot:
        """Turn it with the sensor into the lab frame, at the readings `rows`."""
        turn = _columns_of(poses.orientation_rad, rows)
        if turn.shape[0] == 1 and (turn == turn[:, :1]).all():
            turn = turn[:, :1]
        c, s = np.cos(turn), np.sin(turn)
        u, v, var_u, var_v, cov = (
            _columns_of(a, rows) for a in (self.u_mm, self.v_mm, self.var_u, self.var_v, self.cov_uv)
        )
        cross = 2 * c * s * cov
        return Spot(
            _columns_of(poses.x_mm, rows),
            _columns_of(poses.y_mm, rows),
            c * u - s * v,
            s * u + c * v,
            c * c * var_u + s * s * var_v - cross,
            s * s * var_u + c * c * var_v + cross,
            c * s * (var_u - var_v) + (c * c - s * s) * cov,
        )


_BLOCK = 2**14  # elements at a time: stays in the cache


def _add_half_planes(
    out: FloatArray, parts: list[tuple[IntArray, HalfPlaneRegion]], gaussians: list[_Gaussian], poses: Poses
) -> None:
    """Add what is seen of known half-planes: each Gaussian projected once for each distinct angle."""
    rows = np.concatenate([r for r, _ in parts])
    normal, offset, inside, outside = (
        np.concatenate([np.full(len(r), value) for (r, _), value in zip(parts, values, strict=True)])
        for values in (
            [region.normal_rad[0] for _, region in parts],
            [region.offset_mm[0] for _, region in parts],
            [region.inside for _, region in parts],
            [region.outside for _, region in parts],
        )
    )
    place = np.cos(normal) * _columns_of(poses.x_mm, rows) + np.sin(normal) * _columns_of(poses.y_mm, rows) - offset
    # In the sensor frame the normal is turned back by the sensor's orientation.
    angles = np.broadcast_to(normal - _columns_of(poses.orientation_rad, rows)[0], rows.shape)
    if any(gaussian.varies for gaussian in gaussians):
        distinct, which = angles, np.arange(len(rows))
    else:
        distinct, which = np.unique(angles, return_inverse=True)
    c, s = np.cos(distinct), np.sin(distinct)
    together = bool((np.diff(rows) == 1).all())  # then a view of the result takes the place of a copy
    share = out[:, rows[0] : rows[0] + len(rows)] if together else np.empty((len(out), len(rows)))
    step = max(1, _BLOCK // max(1, len(rows)))
    workspace = np.empty((min(step, len(out)), len(rows)))
    by_product = len(distinct) <= 16 and len(place) == 1
    hand_out = np.empty((0, 0))
    if by_product:
        own = np.eye(len(distinct))[:, which]
        hand_out = np.concatenate([own * place, own])
    for g, gaussian in enumerate(gaussians):
        u, v, var_u, var_v, cov, weight = (
            _columns_of(a, rows)
            for a in (gaussian.u_mm, gaussian.v_mm, gaussian.var_u, gaussian.var_v, gaussian.cov_uv, gaussian.weight)
        )
        per_sd = 1 / np.sqrt(c * c * var_u + s * s * var_v + 2 * c * s * cov)
        shift = c * u + s * v
        for start in range(0, len(out), step):
            block = slice(start, start + step)
            z = workspace[: len(share[block])]
            per_sd_here = _rows_of(per_sd, block)
            if by_product and len(shift) == len(per_sd) == len(out):
                # z = place / sd + shift / sd, each angle's handed out to its readings: one product.
                np.matmul(np.concatenate([per_sd_here, _rows_of(shift, block) * per_sd_here], axis=1), hand_out, out=z)
            else:
                np.add(_rows_of(shift, block)[:, which], _rows_of(place, block), out=z)
                z *= per_sd_here[:, which]
            normal_cdf(z, out=z)
            if g == 0:
                np.multiply(z, _rows_of(weight, block), out=share[block])
            else:
                z *= _rows_of(weight, block)
                share[block] += z
    if (inside != 1.0).any() or (outside != 0.0).any():
        share *= inside - outside
        share += outside
    if not together:
        out[:, rows] = share


def _add_quadrants(
    out: FloatArray, parts: list[tuple[IntArray, QuadrantRegion]], gaussians: list[_Gaussian], poses: Poses
) -> None:
    """Add what is seen of known quadrants, all patterns in one call."""
    rows = np.concatenate([r for r, _ in parts])
    of = np.repeat(np.arange(len(parts)), [len(r) for r, _ in parts])
    corner = np.concatenate([region.corner_mm for _, region in parts])[of]
    direction = np.concatenate([region.direction for _, region in parts])[of]
    inside = np.array([region.inside for _, region in parts])[of]
    outside = np.array([region.outside for _, region in parts])[of]
    share = np.zeros((len(out), len(rows)))
    for gaussian in gaussians:
        found = mass_in_quadrant(
            corner[:, 0], corner[:, 1], direction[:, 0], direction[:, 1], gaussian.spot(poses, rows)
        )
        share += _columns_of(gaussian.weight, rows) * found
    out[:, rows] = outside + (inside - outside) * share


def _rows_of(array: FloatArray, block: slice) -> FloatArray:
    """Take a block of the hypotheses, of an array whose sample axis may be 1."""
    return array if array.shape[0] == 1 else array[block]


def _discrete_response(regions: Mapping[str, Region], ssf: FieldSSF, poses: Poses, plan: Plan) -> FloatArray:
    found = []
    for name, rows in plan.rows_by_pattern():
        there = Poses(*(_columns_of(a, rows) for a in (poses.x_mm, poses.y_mm, poses.orientation_rad)))
        found.append((rows, seen_discrete(_region_named(regions, name), ssf.field, there)))
    out = np.zeros((max((len(part) for _, part in found), default=1), len(plan)))
    for rows, part in found:
        out[:, rows] = part
    return out


def _region_named(regions: Mapping[str, Region], name: str) -> Region:
    try:
        return regions[name]
    except KeyError:
        raise ParameterError("pattern", name, f"a pattern of the scene: {', '.join(regions) or 'none'}") from None


def _columns_of(array: FloatArray, rows: IntArray) -> FloatArray:
    """Take the columns of the readings `rows`, of an array whose point axis may be 1."""
    return array if array.shape[1] == 1 else array[:, rows]


def _by_orientation(rows: IntArray, orientation_rad: FloatArray) -> list[IntArray]:
    """Split rows into groups that share an orientation, where that does not depend on the sample.

    Moments of the footprint in the lab frame are then formed once a group, not once a reading.
    """
    if orientation_rad.shape[0] > 1 or orientation_rad.shape[1] == 1:
        return [rows]
    distinct, which = np.unique(orientation_rad[0, rows], return_inverse=True)
    if len(distinct) > max(8, len(rows) // 8):
        return [rows]
    return [rows[which == k] for k in range(len(distinct))]
