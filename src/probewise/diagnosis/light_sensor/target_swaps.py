"""Scans that need a person: over another or turned target, or along the other axis.

Some aliases cannot be separated by any scan over the same sheet: a sloping table and a gradient of the paper's
whiteness, or a displaced footprint and a displaced edge. A turned sheet, or stripes, separates them.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.light_sensor.candidate_scans import (
    excerpts_of_scan,
    rows_as_new_scan,
    rows_of_distinct_scans,
)
from probewise.diagnosis.light_sensor.scheduling import Scan, earliest_start_s
from probewise.effects.reference import median_gap_s
from probewise.recordings.patterns import HalfPlane, Pattern, Stripes, Uniform
from probewise.recordings.plan import Plan

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
    edges = ((scan, _pattern_under(plan, scan)) for scan in scans)
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


def _pattern_under(plan: Plan, scan: IntArray) -> Pattern | None:
    return plan.patterns.get(plan.pattern_names[int(plan.pattern[scan[0]])])


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
