"""A light sensor on an arm over printed patterns, as an `Apparatus`: covariates, held-out parts, next scans, words."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.apparatus import Apparatus, Words
from probewise.diagnosis.arm_scans import (
    Scan,
    candidate_scans,
    plan_of_alternatives,
    plan_of_sequence,
    rows_repeatable_without_hands,
    target_swaps,
)
from probewise.diagnosis.fit import Fit, Null
from probewise.diagnosis.held_out import LEAST_ROWS, MOST_PARTS, Parts
from probewise.diagnosis.locate import Covariate
from probewise.effects import EFFECTS, NUISANCES, RARE_EFFECTS, VOCABULARY, EffectKind, Extent, LightEffect, NamedEffect
from probewise.effects.reference import orientation_deg, sign_of_motion
from probewise.recordings.plan import Plan, Recording
from probewise.scene import edge_distance, region_of


def held_out_parts(recording: Recording) -> Parts:
    """Return the part of each usable reading, (n_usable,), and the names of the parts: scans.

    If more than ten scans have eight readings or more, all scans over one pattern in one orientation are one part,
    since neighbouring scans would leak information; unless there is only one such part.
    """
    plan, usable = recording.plan, recording.usable
    scan = plan.scan[usable]
    if np.sum(np.bincount(scan) >= LEAST_ROWS) > MOST_PARTS:
        views = np.stack([plan.pattern[usable].astype(np.float64), orientation_deg(plan)[usable]])
        kinds, part = np.unique(views, axis=1, return_inverse=True)
        if kinds.shape[1] > 1:
            return part.reshape(-1), tuple(
                f"{plan.pattern_names[int(code)]}, {turn:.0f} degrees" for code, turn in kinds.T
            )
    return scan, plan.scan_names


_NOT_COLUMNS = frozenset({"time", "level", "edge_distance", "slope", "direction", "orientation", "scan", "place"})
_MOST_SCANS = 24  # number of scans above which residuals are not located in single scans


def slope_along_motion(predict: Callable[[Plan], FloatArray], plan: Plan) -> FloatArray:
    """Differentiate predictions of a plan along each row's direction of motion, in readings per mm, (n_points,)."""
    step = 0.25
    ahead, behind = (
        replace(
            plan,
            x_mm=plan.x_mm + s * plan.direction_of_motion[:, 0],
            y_mm=plan.y_mm + s * plan.direction_of_motion[:, 1],
        )
        for s in (step, -step)
    )
    # All rows are shifted together, so that directions, and hence backlash, do not change.
    return np.asarray((predict(ahead) - predict(behind)) / (2 * step))


def varying_covariates(plan: Plan, usable: IntArray, level: FloatArray, slope: FloatArray) -> list[Covariate]:
    """List the covariates that vary in this recording.

    `usable`: row numbers of the usable readings, shape (n_usable,); `level`, `slope`: predicted reading and its slope
    along the motion, both (n_usable,).
    """
    everything = np.arange(len(usable))
    sign = sign_of_motion(plan)[usable]
    moving = np.flatnonzero(sign != 0)
    scan = plan.scan[usable]
    degrees = orientation_deg(plan)[usable]
    pooled: Mapping[str, FloatArray] = {
        "time": plan.time_s[usable],
        "level": level,
        "edge_distance": _edge_distance_mm(plan)[usable],
        **{f"column {k}" if k in _NOT_COLUMNS else k: values[usable] for k, values in plan.covariates.items()},
    }
    out: list[Covariate] = []
    for name, values in pooled.items():
        there = np.flatnonzero(np.isfinite(values))
        if there.size and _varies(values[there], 1.0 if name == "edge_distance" else 0.0):
            out.append(Covariate(name, values[there], there))
    # A slope or a distance that is about 0 everywhere is rounding error: of the level over 1 mm, of 1 mm.
    if moving.size and _varies(slope[moving], float(np.abs(level).max(initial=0.0))):
        out.append(Covariate("slope", slope[moving], moving))
    if _varies(sign[moving]):
        out.append(Covariate("direction", sign[moving], moving, groups=True))
    if _varies(degrees):
        out.append(Covariate("orientation", degrees, everything, groups=True))
    if len(np.unique(scan)) > 1:
        out.append(Covariate("scan", scan.astype(np.float64), everything, groups=True))
    return out + _place_covariates_along_scans(plan, usable)


def _place_covariates_along_scans(plan: Plan, usable: IntArray) -> list[Covariate]:
    """List the places (x or y, mm) along all scans in the longer direction, and along each longer scan alone."""
    x_mm, y_mm, scan = plan.x_mm[usable], plan.y_mm[usable], plan.scan[usable]
    by_scan = [np.flatnonzero(scan == k) for k in range(len(plan.scan_names))]
    along_x = np.ptp(x_mm) >= np.ptp(y_mm)
    alike = [rows for rows in by_scan if rows.size and (np.ptp(x_mm[rows]) >= np.ptp(y_mm[rows])) == along_x]
    rows = np.sort(np.concatenate(alike)) if alike else np.arange(len(usable))
    longest = (x_mm if along_x else y_mm)[rows]
    out = [Covariate("place", longest, rows)] if _varies(longest) else []
    for rows, name in zip(by_scan, plan.scan_names, strict=True):
        if rows.size >= 16 and len(by_scan) <= _MOST_SCANS:
            along = x_mm[rows] if np.ptp(x_mm[rows]) >= np.ptp(y_mm[rows]) else y_mm[rows]
            if _varies(along):
                out.append(Covariate("place", along, rows, scan=name))
    return out


def covariate_of_effect(
    effect: NamedEffect[Any], change: FloatArray, without: FloatArray, plan: Plan, known: Sequence[Covariate]
) -> Covariate | None:
    """Return the first of an effect's covariates that varies here; None if none varies, or `change` is 0 everywhere.

    `change`: its change of the readings, (n_points,); `without`: predicted readings without it, (n_points,), the values
    of the covariate `level`; `plan`: plan of the readings; a place is along the scans with the largest change.
    """
    pooled = {c.name: c for c in known if c.scan is None}
    sign = sign_of_motion(plan)
    if "direction" not in pooled and np.ptp(sign) > 0:  # a reading at rest has no direction, but serves for comparison
        pooled["direction"] = Covariate("direction", sign, np.arange(len(sign)), groups=True)
    name = next((name for name in effect.covariates if name in pooled), None)
    if name is None or not np.any(change):
        return None
    if name == "level":
        return replace(pooled[name], values=without[pooled[name].rows])
    return (_place_covariate_of_larger_change(change, plan) if name == "place" else None) or pooled[name]


def _place_covariate_of_larger_change(change: FloatArray, plan: Plan) -> Covariate | None:
    """Return the places along X or Y, for readings approached along it, whichever has the larger change."""
    along_x, along_y = (np.flatnonzero(plan.direction_of_motion[:, k] != 0) for k in (0, 1))
    strength = [float(np.abs(change[rows]).max(initial=0.0)) for rows in (along_x, along_y)]
    rows, values = (along_x, plan.x_mm) if strength[0] >= strength[1] else (along_y, plan.y_mm)
    return Covariate("place", values[rows], rows) if rows.size else None


def _edge_distance_mm(plan: Plan) -> FloatArray:
    """Return the distance of each row from the nearest edge of its pattern, mm; infinite without a described edge."""
    out = np.full(len(plan), np.inf)
    for name, rows in plan.rows_by_pattern():
        if name in plan.patterns:
            region = region_of(plan.patterns[name])
            out[rows] = edge_distance(region, plan.x_mm[None, rows], plan.y_mm[None, rows])[0]
    return out


def _varies(values: FloatArray, size: float = 0.0) -> bool:
    """Return whether values differ by more than 1e-9 of the largest, or of `size` if that is larger."""
    return values.size > 1 and float(np.ptp(values)) > 1e-9 * max(size, float(np.abs(values).max()))


@dataclass(frozen=True)
class LightSensorApparatus(Apparatus):
    """A light sensor that an arm moves over patterns; `vocabulary` holds its possible effects, by name.

    `hands`: a person can exchange or turn sheets; otherwise the next scans are over the pattern of the last reading.
    """

    vocabulary: Mapping[str, EffectKind] = field(default_factory=lambda: dict(VOCABULARY))
    hands: bool = True
    words = Words(
        null="the sensor",
        find_signal="scan across an edge",
        settles_nothing="no reading that this apparatus can take tells them apart",
        units={
            "time": "s",
            "place": "mm",
            "edge_distance": "mm",
            "orientation": "degree",
            "level": "{reading}",
            "slope": "{reading} per mm",
        },
    )

    def effects(self, recording: Recording, null: Null | None) -> dict[str, NamedEffect[Any]]:
        """Scale effects to a recording, by name: the vocabulary, effects out of it with a formula, and drifting noise.

        Left out are effects that cannot act there or on the given null. Without a given null the SSF is free and
        absorbs effects on the SSF, so these are left out.
        """
        extent, plan = Extent.of(recording), recording.plan
        kinds = {**self.vocabulary, **RARE_EFFECTS, **NUISANCES}
        if null is None:
            absorbed = {
                n for n, kind in kinds.items() if isinstance(kind, LightEffect) and kind.is_absorbed_by_ssf(plan)
            }
            kinds = {name: kind for name, kind in kinds.items() if name not in absorbed}
        able = {name: effect for name, kind in kinds.items() if (effect := kind.for_extent(extent)) is not None}
        return {name: effect for name, effect in able.items() if null is None or null.admits(effect)}

    def user_effect_names(self, effects: Mapping[str, NamedEffect[Any]]) -> frozenset[str]:
        """Return the names of effects defined outside this library."""
        return frozenset(effects.keys() - EFFECTS)

    def covariates_and_predicted_slope(self, found: Fit, recording: Recording) -> tuple[list[Covariate], FloatArray]:
        """Return the covariates that vary, and the predicted slope along the motion, per mm, (n_usable,)."""
        usable, model, z = np.flatnonzero(recording.usable), found.model, found.z[None, :]
        slope = slope_along_motion(lambda moved: model.predict(z, moved)[0], model.plan)[usable]
        return varying_covariates(recording.plan, usable, found.predicted, slope), slope

    covariate_of_effect = staticmethod(covariate_of_effect)
    held_out_parts = staticmethod(held_out_parts)
    plan_of_alternatives = staticmethod(plan_of_alternatives)
    plan_of_sequence = staticmethod(plan_of_sequence)

    def settings_of(self, plan: Plan) -> FloatArray:
        """Return place, orientation and a number for the pattern of each row, (n_points, 4)."""
        number = np.array([zlib.crc32(name.encode()) for name in plan.pattern_names])[plan.pattern]
        return np.stack([plan.x_mm, plan.y_mm, orientation_deg(plan), number], axis=1)

    def candidate_measurements(
        self, plan: Plan, *, strides: Sequence[int] = (1,), level: FloatArray | None = None
    ) -> list[Scan]:
        """List the scans that the arm can take, and with `hands` those over an exchanged or turned target."""
        if self.hands:
            return [*candidate_scans(plan, strides=strides, level=level), *target_swaps(plan)]
        rows = rows_repeatable_without_hands(plan)
        return candidate_scans(plan.take(rows), strides=strides, level=None if level is None else level[rows])
