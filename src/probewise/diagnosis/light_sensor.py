"""A light sensor on an arm over printed patterns, as an `Apparatus`: scans to take next, covariates, parts, words.

Repeat, reverse and respeed need only the arm; rotate, relight and raise the recording's `controls`; other targets need
a person. Some aliases cannot be separated by any scan over the same sheet: a sloping table and a gradient of the
paper's whiteness, or a displaced footprint and a displaced edge. A turned sheet, or stripes, separates them.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import ndtr

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.apparatus import MOST_READINGS, Apparatus, Words
from probewise.diagnosis.fit import Fit, Null
from probewise.diagnosis.held_out import LEAST_ROWS, MOST_PARTS, Parts
from probewise.diagnosis.locate import Covariate
from probewise.diagnosis.prepared import join_plans, last_known_value
from probewise.effects import EFFECTS, NUISANCES, RARE_EFFECTS, VOCABULARY, EffectKind, Extent, LightEffect, NamedEffect
from probewise.effects.reference import median_gap_s, orientation_deg, sign_of_motion
from probewise.recordings.patterns import HalfPlane, Pattern, Stripes, Uniform
from probewise.recordings.plan import Plan, Recording
from probewise.scene import edge_distance, region_of
from probewise.sensor import COMMANDED

BREAK_S = 30.0  # seconds to turn the sensor, or to exchange the sheet
LAY_S = 60.0  # additional seconds to lay a new sheet


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan that the arm could take: kind, description as an instruction, and plan.

    `kind`: "repeat", "reverse", "respeed", "rotate", "relight", "raise", "across" or, with another sheet, "lay".
    """

    kind: str
    description: str
    plan: Plan

    @property
    def minutes(self) -> float:
        """Duration in minutes, including the break before it."""
        scanning = (float(np.ptp(self.plan.time_s)) + BREAK_S) / 60.0 if len(self.plan) else 0.0
        return scanning + self.sheet_laying_s / 60.0

    @property
    def sheet_laying_s(self) -> float:
        """Additional break before it for laying a sheet, in seconds."""
        return LAY_S if self.kind == "lay" else 0.0


def earliest_start_s(plan: Plan) -> float:
    """Return the earliest start of a scan after a plan, in s."""
    return float(plan.time_s.max(initial=0.0)) + BREAK_S


def plan_of_alternatives(commands: Sequence[Scan], after: Plan) -> Plan:
    """Concatenate alternative scans, each timed as if directly after a plan, to predict all of them at once.

    Covariates that the scans lack, such as battery voltage, keep their last value of that plan.
    """
    return _with_last_known_covariates(commands, after)


def plan_of_sequence(commands: Sequence[Scan], after: Plan) -> Plan:
    """Concatenate scans with a break before each, a longer one if a sheet has to be laid.

    Covariates that the scans lack are filled as in `plan_of_alternatives`, to be replaced by measured values.
    """
    out: list[Scan] = []
    for scan in commands:
        out.append(_scan_started_at(scan, earliest_start_s(out[-1].plan) if out else float(scan.plan.time_s[0])))
    return _with_last_known_covariates(out, after)


def _with_last_known_covariates(scans: Sequence[Scan], after: Plan) -> Plan:
    """Concatenate scans; covariates that cannot be commanded have their last known values of the preceding plan."""
    plan = join_plans([scan.plan for scan in scans])
    read = {name: last_known_value(values) for name, values in after.covariates.items() if name not in COMMANDED}
    kept = {name: np.full(len(plan), last) for name, last in read.items() if math.isfinite(last)}
    return replace(plan, covariates={**kept, **plan.covariates})


def scan_started_after(scan: Scan, plan: Plan) -> Scan:
    """Move a scan to after a plan, with time to lay its sheet."""
    return _scan_started_at(scan, earliest_start_s(plan))


def _scan_started_at(scan: Scan, start_s: float) -> Scan:
    """Start a scan at a time, plus the time to lay its sheet."""
    delay_s = start_s + scan.sheet_laying_s - float(scan.plan.time_s[0])
    return replace(scan, plan=replace(scan.plan, time_s=scan.plan.time_s + delay_s))


_MOST_SCANS = 6
_NEAR = 26  # readings of an excerpt around an edge
_TURN_DEG = 45.0
_RAISE = 1.25  # factor on the recording's height
_WORDS = {1: "", 2: " (every second reading, twice as fast)"}


@dataclass(frozen=True, eq=False)
class Excerpt:
    """Part of a scan, as row numbers: every `stride`-th row, or those where readings change most.

    `suffix` is for the name of the new scan, `words` for its description.
    """

    suffix: str
    words: str
    rows: IntArray
    stride: int = 1


def excerpts_of_scan(
    scan: IntArray, *, strides: Sequence[int] = (1,), level: FloatArray | None = None
) -> list[Excerpt]:
    """Return the parts of a scan that could be scans of their own, of 8 to 102 readings.

    `strides`: strides to try; those that leave fewer than eight readings are skipped, and if all are, stride 1 is
    tried; `level`: expected readings, in the order of `scan`: adds the 26 successive readings over which they change
    most, if the scan is longer.
    """
    out = []
    for stride in [s for s in strides if len(scan[::s]) >= LEAST_ROWS] or [1]:
        rows = scan[::stride][:MOST_READINGS]
        if rows.size >= LEAST_ROWS:
            words = _WORDS.get(stride, f" (every {stride}th reading, {stride} times as fast)")
            if len(scan[::stride]) > MOST_READINGS:
                words += f", {MOST_READINGS} readings from its start"
            out.append(Excerpt("" if stride == 1 else f"_{stride}", words, rows, stride))
    if level is not None and scan.size > _NEAR:
        change = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(level)))])
        first = int(np.argmax(change[_NEAR - 1 :] - change[: 1 - _NEAR]))
        if change[first + _NEAR - 1] > change[first]:
            rows = scan[first : first + _NEAR]
            out.append(Excerpt("_near", " (where it changes most)", rows))
    return out


def candidate_scans(plan: Plan, *, strides: Sequence[int] = (1,), level: FloatArray | None = None) -> list[Scan]:
    """List the scans that could follow a plan, each timed to start after it.

    `level`: expected readings, (n_points,): adds the part of each scan where they change most.
    """
    controls = plan.instrumentation.controls
    height_mm = plan.instrumentation.height_mm
    gap_s, start_s = median_gap_s(plan), earliest_start_s(plan)
    out: list[Scan] = []
    for scan in rows_of_distinct_scans(plan):
        name = plan.scan_names[int(plan.scan[scan[0]])]
        degrees = math.degrees(float(plan.orientation_rad[scan[0]]))
        for part in excerpts_of_scan(scan, strides=strides, level=None if level is None else level[scan]):
            rows, every, label = part.rows, part.words, f"{name}{part.suffix}"
            once = rows_as_new_scan(plan, rows, start_s, gap_s, label)
            both = np.concatenate([rows[: MOST_READINGS // 2 * 2 : 2], rows[: MOST_READINGS // 2 * 2 : 2][::-1]])
            out += [
                Scan("repeat", f"take scan {name} again{every}", _with_scan_name_suffix(once, "again")),
                Scan(
                    "reverse",
                    f"take scan {name} backwards{every}",
                    rows_as_new_scan(plan, rows[::-1], start_s, gap_s, f"{label}_reversed"),
                ),
                Scan(
                    "respeed",
                    f"scan {name} forth and back {_faster_scan_words(part)}",
                    rows_as_new_scan(plan, both, start_s, gap_s, f"{label}_both"),
                ),
            ]
            if "orientation_deg" in controls:
                turned = replace(once, orientation_rad=once.orientation_rad + math.radians(_TURN_DEG))
                words = f"take scan {name} with the sensor turned to {degrees + _TURN_DEG:.0f} degrees{every}"
                out.append(Scan("rotate", words, _with_scan_name_suffix(turned, "turned")))
            if "led" in controls:
                dark = replace(once, covariates={**once.covariates, "led": np.zeros(len(once))})
                out.append(
                    Scan("relight", f"take scan {name} with the LED off{every}", _with_scan_name_suffix(dark, "dark"))
                )
            if "height_mm" in controls and height_mm is not None:
                commanded_mm = once.covariates.get("height_mm", np.full(len(once), np.nan))
                high_mm = _RAISE * np.where(np.isfinite(commanded_mm), commanded_mm, height_mm)
                where = f"{high_mm[0]:.4g} mm" if np.ptp(high_mm) == 0.0 else f"{_RAISE:g} times its height"
                raised = replace(once, covariates={**once.covariates, "height_mm": high_mm})
                words = f"take scan {name} with the sensor at {where}{every}"
                out.append(Scan("raise", words, _with_scan_name_suffix(raised, "raised")))
    return out


def rows_repeatable_without_hands(plan: Plan) -> IntArray:
    """Return the rows over the last reading's pattern and, unless the arm turns the sensor, in its orientation."""
    last = int(np.argmax(plan.time_s))
    same_sheet = plan.pattern == plan.pattern[last]
    turned_rad = np.abs(np.angle(np.exp(1j * (plan.orientation_rad - plan.orientation_rad[last]))))
    as_mounted = turned_rad < math.radians(_TURN_DEG) / 2
    return np.flatnonzero(same_sheet & (as_mounted | ("orientation_deg" in plan.instrumentation.controls)))


def rows_as_new_scan(plan: Plan, rows: IntArray, start_s: float, gap_s: float, name: str) -> Plan:
    """Return rows of a plan, in order, as one new scan from `start_s` on, one every `gap_s`; commanded values stay."""
    taken = plan.take(rows)
    controls = plan.instrumentation.controls
    return replace(
        taken,
        time_s=np.asarray(start_s + gap_s * np.arange(len(rows)), dtype=np.float64),
        scan=np.zeros(len(rows), dtype=np.int64),
        scan_names=(name,),
        covariates={k: v for k, v in taken.covariates.items() if k in COMMANDED or k in controls},
        sessions=(),
    )


def _faster_scan_words(part: Excerpt) -> str:
    """Describe the speed of a scan of every second reading of an excerpt, with unchanged time per reading."""
    if part.stride == 1:
        return f"at double speed{part.words}"
    return f"at {2 * part.stride} times the speed (every {2 * part.stride}th reading)"


def _with_scan_name_suffix(plan: Plan, how: str) -> Plan:
    return replace(plan, scan_names=(f"{plan.scan_names[0]}_{how}",))


def rows_of_distinct_scans(plan: Plan) -> list[IntArray]:
    """Return the row numbers of the first six moving scans of eight rows or more, without repeats and reversals."""
    seen: dict[tuple[object, ...], IntArray] = {}
    turned_deg = orientation_deg(plan)
    for rows in plan.rows_by_scan():
        if rows.size < LEAST_ROWS or not plan.direction_of_motion[rows].any():
            continue
        places = ((round(float(plan.x_mm[r]), 3), round(float(plan.y_mm[r]), 3)) for r in (rows[0], rows[-1]))
        key = (int(plan.pattern[rows[0]]), round(float(turned_deg[rows[0]]), 2), *sorted(places))
        seen.setdefault(key, rows)
    return list(seen.values())[:_MOST_SCANS]


_FLAT_ROWS = 20  # readings over a uniform surface
_FOOTPRINT = 1 / 14  # prior width of the footprint, as a share of a scan's length
_ASIDE = 0.3  # displacement of an edge, as a share of a scan's length
_LEAST_CROSSED = 0.3  # least share of a scan's length that must go across an edge
_STRIPES = (5, 10)  # numbers of stripes per scan
_STRIDE = 4


def target_swaps(plan: Plan) -> list[Scan]:
    """List scans over a white and a black sheet, along the other axis, and over moved or turned edges and stripes.

    Sheets and the other axis take the places of the plan's first moving scan; edges and stripes those of its first scan
    across a `HalfPlane`, if there is one.
    """
    scans = rows_of_distinct_scans(plan)
    if not scans:
        return []
    first = scans[0]
    out = []
    for colour, albedo in (("white", 1.0), ("black", 0.0)):
        flat = _rows_as_next_scan(plan, first[:: max(len(first) // _FLAT_ROWS, 1)], f"{colour}_next")
        out.append(
            Scan("lay", f"scan a plain {colour} surface", _with_pattern(flat, f"plain_{colour}", Uniform(albedo)))
        )
    name = plan.scan_names[int(plan.scan[first[0]])]
    for part in excerpts_of_scan(first, strides=(_STRIDE // 2, _STRIDE)):
        across = _rotated_scan(_rows_as_next_scan(plan, part.rows, f"across{part.suffix}"))
        out.append(Scan("across", f"scan at right angles to scan {name}, through its middle{part.words}", across))
    edges = ((scan, plan.patterns.get(plan.pattern_names[int(plan.pattern[scan[0]])])) for scan in scans)
    laid = (_scans_over_moved_targets(plan, scan, edge) for scan, edge in edges if isinstance(edge, HalfPlane))
    return [*out, *next(filter(None, laid), [])]


def _scans_over_moved_targets(plan: Plan, scan: IntArray, edge: HalfPlane) -> list[Scan]:
    """List scans over an edge turned by 180 or 90 degrees or moved, and over stripes."""
    name = plan.pattern_names[int(plan.pattern[scan[0]])]
    beyond = _distance_inside_edge_mm(plan, scan, edge)
    length = float(np.ptp(beyond))
    if length < _LEAST_CROSSED * math.hypot(np.ptp(plan.x_mm[scan]), np.ptp(plan.y_mm[scan])):
        return []
    once = _rows_as_next_scan(plan, scan, name)
    half_round = replace(edge, normal_rad=edge.normal_rad + math.pi, offset_mm=-edge.offset_mm)
    laid = [
        (f"{name}_half_round", f"turn pattern {name} by 180 degrees about its edge and scan it", once, half_round),
        (f"{name}_quarter", f"turn pattern {name} and its scan by 90 degrees", *_rotated_scan_and_edge(once, edge)),
    ]
    middle_mm = float(beyond.mean())
    for end in (-1.0, 1.0):
        exactly_mm = middle_mm + end * _ASIDE * length
        aside_mm = float(np.round(exactly_mm)) or exactly_mm
        moved = replace(edge, offset_mm=edge.offset_mm + aside_mm)
        laid.append(
            (
                f"{name}_by_{aside_mm:g}_mm",
                f"move pattern {name} by {aside_mm:g} mm along its normal and scan it",
                once,
                moved,
            )
        )
    out = []
    for label, words, whole, pattern in laid:
        rows = np.arange(len(whole))
        seen = ndtr(_distance_inside_edge_mm(whole, rows, pattern) / (_FOOTPRINT * length))
        for part in excerpts_of_scan(rows, strides=(_STRIDE,), level=seen):
            taken = _with_pattern(_rows_as_next_scan(whole, part.rows, f"{label}{part.suffix}"), label, pattern)
            out.append(Scan("lay", f"{words}{part.words}", taken))
    for number in _STRIPES:
        period_mm = float(np.round(length / number)) or length / number
        stripes = Stripes(edge.normal_rad, period_mm, 0.5, 0.0, edge.inside, edge.outside)
        label, words = f"stripes_{period_mm:g}_mm", f"scan stripes {period_mm:g} mm apart in place of pattern {name}"
        for part in excerpts_of_scan(scan, strides=(_STRIDE // 2, _STRIDE)):
            taken = _with_pattern(_rows_as_next_scan(plan, part.rows, f"{label}{part.suffix}"), label, stripes)
            out.append(Scan("lay", f"{words}{part.words}", taken))
    return out


def _rows_as_next_scan(plan: Plan, rows: IntArray, name: str) -> Plan:
    return rows_as_new_scan(plan, rows, earliest_start_s(plan), median_gap_s(plan), name)


def _with_pattern(scan: Plan, name: str, pattern: Pattern) -> Plan:
    """Set the pattern of a scan; if another pattern has this name, the name is extended by "_new"."""
    while name in scan.pattern_names and scan.patterns.get(name) != pattern:
        name += "_new"
    names = tuple(dict.fromkeys((*scan.pattern_names, name)))
    number = np.full(len(scan), names.index(name))
    return replace(scan, pattern=number, pattern_names=names, patterns={**scan.patterns, name: pattern})


def _rotated_scan(scan: Plan) -> Plan:
    """Rotate a scan's places by 90 degrees about their middle, anticlockwise."""
    x_mm, y_mm = scan.x_mm.mean(), scan.y_mm.mean()
    return replace(scan, x_mm=x_mm - (scan.y_mm - y_mm), y_mm=y_mm + (scan.x_mm - x_mm))


def _rotated_scan_and_edge(scan: Plan, edge: HalfPlane) -> tuple[Plan, HalfPlane]:
    """Rotate a scan with the edge under it, at the same distance from the scan's middle."""
    normal_rad = edge.normal_rad + math.pi / 2
    x_mm, y_mm = scan.x_mm.mean(), scan.y_mm.mean()
    moved_mm = sum(
        sign * (x_mm * math.cos(angle) + y_mm * math.sin(angle))
        for sign, angle in ((1, normal_rad), (-1, edge.normal_rad))
    )
    return _rotated_scan(scan), replace(edge, normal_rad=normal_rad, offset_mm=float(edge.offset_mm + moved_mm))


def _distance_inside_edge_mm(plan: Plan, rows: IntArray, edge: HalfPlane) -> FloatArray:
    """Return the signed distance of rows from an edge, along its normal, in mm."""
    return plan.x_mm[rows] * math.cos(edge.normal_rad) + plan.y_mm[rows] * math.sin(edge.normal_rad) - edge.offset_mm


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
_MOST_SCANS_ALONE = 24  # number of scans above which residuals are not located in single scans


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
        if rows.size >= 16 and len(by_scan) <= _MOST_SCANS_ALONE:
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
