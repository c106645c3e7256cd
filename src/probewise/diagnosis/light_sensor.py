"""A light sensor on an arm over printed patterns, as an `Apparatus`: scans to take next, covariates, parts, words.

Repeat, reverse and respeed need only the arm; rotate, relight and raise the recording's `controls`; other targets need
a person. Some aliases cannot be separated by any scan over the same sheet: a sloping table and a gradient of the
paper's whiteness, or a displaced footprint and a displaced edge. A turned sheet, or stripes, separates them.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, cast

import numpy as np
from scipy.special import ndtr

from probewise._arrays import ROUNDING, FloatArray, IntArray
from probewise.diagnosis.apparatus import MOST_ADVISED_READINGS, Apparatus, Candidate, Words
from probewise.diagnosis.evidence import LEAST_ROWS, MOST_PARTS, Parts
from probewise.diagnosis.fit import Fit, Null
from probewise.diagnosis.locate import Covariate
from probewise.diagnosis.prepared import join_plans, last_known_value
from probewise.effects import EFFECTS, NUISANCES, RARE_EFFECTS, VOCABULARY, Effect, Extent, LightEffect
from probewise.effects.reference import median_gap_s, orientation_deg, sign_of_motion
from probewise.recordings.patterns import HalfPlane, Pattern, Stripes, Uniform
from probewise.recordings.plan import Plan, Recording
from probewise.scene import edge_distance, region_of
from probewise.sensor import COMMANDED

BREAK_S = 30.0  # seconds to turn the sensor, or to exchange the sheet
LAY_S = 60.0  # additional seconds to lay a new sheet


_LAY = "lay"  # the kind of a scan over another sheet


def candidate_scan(kind: str, description: str, plan: Plan) -> Candidate:
    """Return a scan that the arm could take."""
    minutes = (float(np.ptp(plan.time_s)) + BREAK_S) / 60.0 + (LAY_S if kind == _LAY else 0.0) / 60.0
    return Candidate(kind, description, plan, minutes)


def scan_started_after(scan: Candidate, plan: Plan) -> Candidate:
    """Move a scan to after a plan, with time to lay its sheet."""
    start_s = _earliest_start_s(plan) + (LAY_S if scan.kind == _LAY else 0.0)
    return replace(scan, plan=replace(scan.plan, time_s=scan.plan.time_s + (start_s - float(scan.plan.time_s[0]))))


def _earliest_start_s(plan: Plan) -> float:
    return float(plan.time_s.max(initial=0.0)) + BREAK_S


_MOST_SCANS = 6
_NEAR = 26  # readings of an excerpt around an edge
_TURN_DEG = 45.0
_RAISE = 1.25  # factor on the recording's height


class Excerpt(NamedTuple):
    """Part of a scan, as row numbers: every `stride`-th row, or those where readings change most.

    `suffix` is for the name of the new scan, `words` for its description.
    """

    suffix: str
    words: str
    rows: IntArray
    stride: int = 1


def excerpts_of_scan(scan: IntArray, strides: Sequence[int], level: FloatArray | None = None) -> list[Excerpt]:
    """Return the parts of a scan that could be scans of their own, of 8 to 102 readings.

    `strides`: strides to try; those that leave fewer than eight readings are skipped, and if all are, stride 1 is
    tried; `level`: expected readings, in the order of `scan`: adds the 26 successive readings over which they change
    most, if the scan is longer.
    """
    out = []
    for stride in [s for s in strides if len(scan[::s]) >= LEAST_ROWS] or [1]:
        rows = scan[::stride][:MOST_ADVISED_READINGS]
        if rows.size >= LEAST_ROWS:
            every, fast = ("second", "twice") if stride == 2 else (f"{stride}th", f"{stride} times")
            words = "" if stride == 1 else f" (every {every} reading, {fast} as fast)"
            if len(scan[::stride]) > MOST_ADVISED_READINGS:
                words += f", {MOST_ADVISED_READINGS} readings from its start"
            out.append(Excerpt("" if stride == 1 else f"_{stride}", words, rows, stride))
    if level is not None and scan.size > _NEAR:
        change = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(level)))])
        first = int(np.argmax(change[_NEAR - 1 :] - change[: 1 - _NEAR]))
        if change[first + _NEAR - 1] > change[first]:
            out.append(Excerpt("_near", " (where it changes most)", scan[first : first + _NEAR]))
    return out


def candidate_scans(plan: Plan, *, strides: Sequence[int] = (1,), level: FloatArray | None = None) -> list[Candidate]:
    """List the scans that could follow a plan, each timed to start after it.

    `level`: expected readings, (n_points,): adds the part of each scan where they change most.
    """
    controls, height_mm = plan.instrumentation.controls, plan.instrumentation.height_mm
    out: list[Candidate] = []
    for scan in rows_of_distinct_scans(plan):
        name = plan.scan_names[int(plan.scan[scan[0]])]
        degrees, take = math.degrees(float(plan.orientation_rad[scan[0]])) + _TURN_DEG, f"take scan {name}"
        for suffix, every, rows, stride in excerpts_of_scan(scan, strides, None if level is None else level[scan]):
            once = rows_as_next_scan(plan, rows, name)
            half = rows[: MOST_ADVISED_READINGS // 2 * 2 : 2]
            both = rows_as_next_scan(plan, np.concatenate([half, half[::-1]]), name)
            # Of every second reading, with unchanged time per reading.
            faster = f"at {2 * stride} times the speed (every {2 * stride}th reading)"
            faster = f"at double speed{every}" if stride == 1 else faster
            taken = [
                ("repeat", f"{take} again{every}", once, "again"),
                ("reverse", f"{take} backwards{every}", rows_as_next_scan(plan, rows[::-1], name), "reversed"),
                ("respeed", f"scan {name} forth and back {faster}", both, "both"),
            ]
            if "orientation_deg" in controls:
                turned = replace(once, orientation_rad=once.orientation_rad + math.radians(_TURN_DEG))
                words = f"{take} with the sensor turned to {degrees:.0f} degrees{every}"
                taken.append(("rotate", words, turned, "turned"))
            if "led" in controls:
                dark = replace(once, covariates={**once.covariates, "led": np.zeros(len(once))})
                taken.append(("relight", f"{take} with the LED off{every}", dark, "dark"))
            if "height_mm" in controls and height_mm is not None:
                commanded_mm = once.covariates.get("height_mm", np.full(len(once), np.nan))
                high_mm = _RAISE * np.where(np.isfinite(commanded_mm), commanded_mm, height_mm)
                where = f"{high_mm[0]:.4g} mm" if np.ptp(high_mm) == 0.0 else f"{_RAISE:g} times its height"
                raised = replace(once, covariates={**once.covariates, "height_mm": high_mm})
                taken.append(("raise", f"{take} with the sensor at {where}{every}", raised, "raised"))
            for kind, words, own, how in taken:
                out.append(candidate_scan(kind, words, replace(own, scan_names=(f"{name}{suffix}_{how}",))))
    return out


def rows_as_next_scan(plan: Plan, rows: IntArray, name: str) -> Plan:
    """Return rows of a plan, in order, as one new scan after it, at its pace; commanded values stay."""
    taken, controls = plan.take(rows), plan.instrumentation.controls
    return replace(
        taken,
        time_s=np.asarray(_earliest_start_s(plan) + median_gap_s(plan) * np.arange(len(rows)), dtype=np.float64),
        scan=np.zeros(len(rows), dtype=np.int64),
        scan_names=(name,),
        covariates={k: v for k, v in taken.covariates.items() if k in COMMANDED or k in controls},
        sessions=(),
    )


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


_FOOTPRINT = 1 / 14  # prior width of the footprint, as a share of a scan's length
_LEAST_CROSSED = 0.3  # least share of a scan's length that must go across an edge
_STRIDE = 4


def target_swaps(plan: Plan) -> list[Candidate]:
    """List scans over a white and a black sheet, along the other axis, and over moved or turned edges and stripes.

    Sheets and the other axis take the places of the plan's first moving scan; edges and stripes those of its first scan
    across a `HalfPlane`, if there is one.
    """
    scans = rows_of_distinct_scans(plan)
    if not scans:
        return []
    first, out = scans[0], []
    for colour, albedo in (("white", 1.0), ("black", 0.0)):
        flat = rows_as_next_scan(plan, first[:: max(len(first) // 20, 1)], f"{colour}_next")
        flat = _with_pattern(flat, f"plain_{colour}", Uniform(albedo))
        out.append(candidate_scan(_LAY, f"scan a plain {colour} surface", flat))
    name = plan.scan_names[int(plan.scan[first[0]])]
    for part in excerpts_of_scan(first, (_STRIDE // 2, _STRIDE)):
        words = f"scan at right angles to scan {name}, through its middle{part.words}"
        across = _rotated_scan(rows_as_next_scan(plan, part.rows, f"across{part.suffix}"))
        out.append(candidate_scan("across", words, across))
    edges = ((scan, plan.patterns.get(plan.pattern_names[int(plan.pattern[scan[0]])])) for scan in scans)
    laid = (_scans_over_moved_targets(plan, scan, edge) for scan, edge in edges if isinstance(edge, HalfPlane))
    return [*out, *next(filter(None, laid), [])]


def _scans_over_moved_targets(plan: Plan, scan: IntArray, edge: HalfPlane) -> list[Candidate]:
    """List scans over an edge turned by 180 or 90 degrees or moved, and over stripes."""
    name = plan.pattern_names[int(plan.pattern[scan[0]])]
    beyond = _distance_inside_edge_mm(plan, edge)[scan]
    length = float(np.ptp(beyond))
    if length < _LEAST_CROSSED * math.hypot(np.ptp(plan.x_mm[scan]), np.ptp(plan.y_mm[scan])):
        return []
    once = rows_as_next_scan(plan, scan, name)
    half_round = replace(edge, normal_rad=edge.normal_rad + math.pi, offset_mm=-edge.offset_mm)
    laid = [
        (f"{name}_half_round", f"turn pattern {name} by 180 degrees about its edge and scan it", once, half_round),
        (f"{name}_quarter", f"turn pattern {name} and its scan by 90 degrees", *_rotated_scan_and_edge(once, edge)),
    ]
    for end in (-1.0, 1.0):
        exactly_mm = float(beyond.mean()) + end * 0.3 * length
        aside_mm = float(np.round(exactly_mm)) or exactly_mm
        moved = replace(edge, offset_mm=edge.offset_mm + aside_mm)
        words = f"move pattern {name} by {aside_mm:g} mm along its normal and scan it"
        laid.append((f"{name}_by_{aside_mm:g}_mm", words, once, moved))
    laid_in_parts = []
    for label, words, whole, moved in laid:
        seen = ndtr(_distance_inside_edge_mm(whole, moved) / (_FOOTPRINT * length))
        parts = excerpts_of_scan(np.arange(len(whole)), (_STRIDE,), seen)
        laid_in_parts.append((label, words, whole, cast(Pattern, moved), parts))
    for number in (5, 10):
        period_mm = float(np.round(length / number)) or length / number
        stripes = Stripes(edge.normal_rad, period_mm, 0.5, 0.0, edge.inside, edge.outside)
        label, words = f"stripes_{period_mm:g}_mm", f"scan stripes {period_mm:g} mm apart in place of pattern {name}"
        laid_in_parts.append((label, words, plan, stripes, excerpts_of_scan(scan, (_STRIDE // 2, _STRIDE))))
    return [
        candidate_scan(
            _LAY,
            f"{words}{part.words}",
            _with_pattern(rows_as_next_scan(whole, part.rows, f"{label}{part.suffix}"), label, pattern),
        )
        for label, words, whole, pattern, parts in laid_in_parts
        for part in parts
    ]


def _with_pattern(scan: Plan, name: str, pattern: Pattern) -> Plan:
    """Set the pattern of a scan; if another pattern has this name, the name is extended by "_new"."""
    while name in scan.pattern_names and scan.patterns.get(name) != pattern:
        name += "_new"
    names = tuple(dict.fromkeys((*scan.pattern_names, name)))
    number = np.full(len(scan), names.index(name))
    return replace(scan, pattern=number, pattern_names=names, patterns={**scan.patterns, name: pattern})


def _rotated_scan(scan: Plan) -> Plan:
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


def _distance_inside_edge_mm(plan: Plan, edge: HalfPlane) -> FloatArray:
    return plan.x_mm * math.cos(edge.normal_rad) + plan.y_mm * math.sin(edge.normal_rad) - edge.offset_mm


_NOT_COLUMNS = frozenset({"time", "level", "edge_distance", "slope", "direction", "orientation", "scan", "place"})


def varying_covariates(plan: Plan, usable: IntArray, level: FloatArray, slope: FloatArray) -> list[Covariate]:
    """List the covariates that vary in this recording.

    `usable`: row numbers of the usable readings, shape (n_usable,); `level`, `slope`: predicted reading and its slope
    along the motion, both (n_usable,).
    """
    everything, scan = np.arange(len(usable)), plan.scan[usable]
    sign, degrees = sign_of_motion(plan)[usable], orientation_deg(plan)[usable]
    moving = np.flatnonzero(sign != 0)
    edge_mm = np.full(len(plan), np.inf)  # from the nearest edge of the row's pattern, if one is described
    for name, rows in plan.rows_by_pattern():
        if name in plan.patterns:
            region = region_of(plan.patterns[name])
            edge_mm[rows] = edge_distance(region, plan.x_mm[None, rows], plan.y_mm[None, rows])[0]
    pooled = {"time": plan.time_s[usable], "level": level, "edge_distance": edge_mm[usable]}
    pooled |= {f"column {k}" if k in _NOT_COLUMNS else k: values[usable] for k, values in plan.covariates.items()}
    out: list[Covariate] = []
    for name, values in pooled.items():
        there = np.flatnonzero(np.isfinite(values))
        # A slope or a distance that is about 0 everywhere is rounding error: of the level over 1 mm, of 1 mm.
        if there.size and _varies(values[there], 1.0 if name == "edge_distance" else 0.0):
            out.append(Covariate(name, values[there], there))
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
        if rows.size >= 16 and len(by_scan) <= 24:  # else too many
            along = x_mm[rows] if np.ptp(x_mm[rows]) >= np.ptp(y_mm[rows]) else y_mm[rows]
            if _varies(along):
                out.append(Covariate("place", along, rows, scan=name))
    return out


def _varies(values: FloatArray, size: float = 0.0) -> bool:
    return values.size > 1 and float(np.ptp(values)) > ROUNDING * max(size, float(np.abs(values).max()))


@dataclass(frozen=True)
class LightSensorApparatus(Apparatus):
    """A light sensor that an arm moves over patterns; `vocabulary` holds its possible effects, by name.

    `hands`: a person can exchange or turn sheets; otherwise the next scans are over the pattern of the last reading.
    """

    vocabulary: Mapping[str, LightEffect] = field(default_factory=lambda: dict(VOCABULARY))
    hands: bool = True
    words = Words(
        null="the sensor",
        find_signal="scan across an edge",
        settles_nothing="no reading that this apparatus can take tells them apart",
        units={"time": "s", "place": "mm", "edge_distance": "mm", "orientation": "degree"}
        | {"level": "{reading}", "slope": "{reading} per mm"},
    )

    def effects(self, recording: Recording, null: Null | None) -> dict[str, Effect]:
        extent, plan = Extent.of(recording), recording.plan
        out: dict[str, Effect] = {}
        for name, kind in {**self.vocabulary, **RARE_EFFECTS, **NUISANCES}.items():
            if null is None and kind.is_absorbed_by_ssf(plan):  # by a free SSF
                continue
            effect = kind.for_extent(extent)
            if effect is not None and (null is None or null.admits(effect)):
                out[name] = effect
        return out

    def user_effect_names(self, effects: Mapping[str, Effect]) -> frozenset[str]:
        return frozenset(effects.keys() - EFFECTS)

    def covariates_and_predicted_slope(self, found: Fit, recording: Recording) -> tuple[list[Covariate], FloatArray]:
        usable, plan = np.flatnonzero(recording.usable), found.model.plan
        step, (along_x, along_y) = 0.25, plan.direction_of_motion.T
        # All rows are shifted together, so that directions, and hence backlash, do not change.
        moved = (replace(plan, x_mm=plan.x_mm + s * along_x, y_mm=plan.y_mm + s * along_y) for s in (step, -step))
        ahead, behind = (found.model.predict(found.z[None, :], shifted)[0] for shifted in moved)
        slope = ((ahead - behind) / (2 * step))[usable]
        return varying_covariates(recording.plan, usable, found.predicted, slope), slope

    def covariate_of_effect(
        self, effect: Effect, change: FloatArray, without: FloatArray, plan: Plan, known: Sequence[Covariate]
    ) -> Covariate | None:
        whole, sign = [c for c in known if c.scan is None], sign_of_motion(plan)
        if np.ptp(sign) > 0 and all(c.name != "direction" for c in whole):  # one at rest serves for comparison
            whole.append(Covariate("direction", sign, np.arange(len(sign)), groups=True))
        shown = super().covariate_of_effect(effect, change, without, plan, whole)
        if shown is None or shown.name != "place":
            return shown
        # Along X or Y, of the readings approached along it, whichever has the larger change.
        along_x, along_y = (np.flatnonzero(plan.direction_of_motion[:, k] != 0) for k in (0, 1))
        strength = [float(np.abs(change[rows]).max(initial=0.0)) for rows in (along_x, along_y)]
        rows, values = (along_x, plan.x_mm) if strength[0] >= strength[1] else (along_y, plan.y_mm)
        return Covariate("place", values[rows], rows) if rows.size else shown

    def held_out_parts(self, recording: Recording) -> Parts:
        plan, usable = recording.plan, recording.usable
        scan = plan.scan[usable]
        if np.sum(np.bincount(scan) >= LEAST_ROWS) > MOST_PARTS:
            # All scans over one pattern in one orientation are one part: neighbouring scans would leak information.
            views = np.stack([plan.pattern[usable].astype(np.float64), orientation_deg(plan)[usable]])
            kinds, part = np.unique(views, axis=1, return_inverse=True)
            if kinds.shape[1] > 1:
                named = ((plan.pattern_names[int(code)], turn) for code, turn in kinds.T)
                return part.reshape(-1), tuple(f"{pattern}, {turn:.0f} degrees" for pattern, turn in named)
        return scan, plan.scan_names

    def plan_of_alternatives(self, candidates: Sequence[Candidate], after: Plan) -> Plan:
        plan = join_plans([candidate.plan for candidate in candidates])
        # What cannot be commanded, such as battery voltage, keeps its last known value until it is measured.
        read = {name: last_known_value(values) for name, values in after.covariates.items() if name not in COMMANDED}
        kept = {name: np.full(len(plan), last) for name, last in read.items() if math.isfinite(last)}
        return replace(plan, covariates={**kept, **plan.covariates})

    def plan_of_sequence(self, candidates: Sequence[Candidate], after: Plan) -> Plan:
        out: list[Candidate] = []
        for scan in candidates:
            out.append(scan_started_after(scan, out[-1].plan if out else after))
        return self.plan_of_alternatives(out, after)

    def settings_of(self, plan: Plan) -> FloatArray:
        number = np.array([zlib.crc32(name.encode()) for name in plan.pattern_names])[plan.pattern]
        return np.stack([plan.x_mm, plan.y_mm, orientation_deg(plan), number], axis=1)

    def candidate_measurements(
        self, plan: Plan, *, strides: Sequence[int] = (1,), level: FloatArray | None = None
    ) -> list[Candidate]:
        if self.hands:
            return [*candidate_scans(plan, strides=strides, level=level), *target_swaps(plan)]
        # Over the last reading's pattern and, unless the arm turns the sensor, in its orientation.
        last = int(np.argmax(plan.time_s))
        turned_rad = np.abs(np.angle(np.exp(1j * (plan.orientation_rad - plan.orientation_rad[last]))))
        able = (turned_rad < math.radians(_TURN_DEG) / 2) | ("orientation_deg" in plan.instrumentation.controls)
        rows = np.flatnonzero((plan.pattern == plan.pattern[last]) & able)
        return candidate_scans(plan.take(rows), strides=strides, level=None if level is None else level[rows])
