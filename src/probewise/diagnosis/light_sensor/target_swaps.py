"""What else could be laid under the sensor, or scanned along the other axis: what the arm alone cannot bring about.

A slope of the table against one of the paper's whiteness, a sensor that looks beside itself against an edge that lies
elsewhere: no scan over the same sheet parts them, however it is taken. The sheet turned round does, or stripes.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.light_sensor.commands import distinct_scans, excerpts, reading_s, rescheduled
from probewise.diagnosis.light_sensor.scheduling import Scan, start_after
from probewise.recordings.patterns import HalfPlane, Pattern, Stripes, Uniform
from probewise.recordings.plan import Plan

__all__ = ["target_swaps"]

_FLAT_ROWS = 20  # readings of a plain surface
_FOOTPRINT = 1 / 14  # of a scan's length, as wide as is believed before any reading
_ASIDE = 0.3  # of a scan's length, how far from its middle an edge is moved
_LEAST_CROSSED = 0.3  # of its length, that a scan goes across an edge rather than along it
_STRIPES = (5, 10)  # how many go into a scan
_STRIDE = 4


def target_swaps(plan: Plan) -> list[Scan]:
    """List scans over plain surfaces, along the other axis, and over an edge of the plan laid otherwise.

    All begin as the plan's first scan that moves does, or as its first over a `HalfPlane`, the sensor as it was there.
    """
    scans = distinct_scans(plan)
    if not scans:
        return []
    first = scans[0]
    out = []
    for colour, albedo in (("white", 1.0), ("black", 0.0)):
        flat = _scan(plan, first[:: max(len(first) // _FLAT_ROWS, 1)], f"{colour}_next")
        out.append(Scan("lay", f"scan a plain {colour} surface", _over(flat, f"plain_{colour}", Uniform(albedo))))
    name = plan.scan_names[int(plan.scan[first[0]])]
    for part in excerpts(first, strides=(_STRIDE // 2, _STRIDE)):
        across = _turned(_scan(plan, part.rows, f"across{part.suffix}"))
        out.append(Scan("across", f"scan across scan {name}, along the other axis{part.words}", across))
    edges = ((scan, _pattern_under(plan, scan)) for scan in scans)
    laid = (_laid_otherwise(plan, scan, edge) for scan, edge in edges if isinstance(edge, HalfPlane))
    return [*out, *next(filter(None, laid), [])]


def _laid_otherwise(plan: Plan, scan: IntArray, edge: HalfPlane) -> list[Scan]:
    """Turn the sheet of an edge, half round or by a quarter; move it; lay stripes."""
    name = plan.pattern_names[int(plan.pattern[scan[0]])]
    beyond = _beyond(plan, scan, edge)
    length = float(np.ptp(beyond))
    if length < _LEAST_CROSSED * math.hypot(np.ptp(plan.x_mm[scan]), np.ptp(plan.y_mm[scan])):
        return []
    once = _scan(plan, scan, name)
    half_round = replace(edge, normal_rad=edge.normal_rad + math.pi, offset_mm=-edge.offset_mm)
    laid = [
        (f"{name}_half_round", f"{name}, turned half round about where its edge should be", once, half_round),
        (f"{name}_quarter", f"{name}, turned by a quarter with the scan", *_both_turned(once, edge)),
    ]
    middle_mm = float(beyond.mean())
    for end in (-1.0, 1.0):
        exactly_mm = middle_mm + end * _ASIDE * length
        aside_mm = float(np.round(exactly_mm)) or exactly_mm
        moved = replace(edge, offset_mm=edge.offset_mm + aside_mm)
        laid.append((f"{name}_by_{aside_mm:g}_mm", f"{name}, moved by {aside_mm:g} mm along its normal", once, moved))
    out = []
    for label, words, whole, pattern in laid:
        rows = np.arange(len(whole))
        seen = ndtr(_beyond(whole, rows, pattern) / (_FOOTPRINT * length))
        for part in excerpts(rows, strides=(_STRIDE,), level=seen):
            taken = _over(_scan(whole, part.rows, f"{label}{part.suffix}"), label, pattern)
            out.append(Scan("lay", f"scan {words}{part.words}", taken))
    for number in _STRIPES:
        period_mm = float(np.round(length / number)) or length / number
        stripes = Stripes(edge.normal_rad, period_mm, 0.5, 0.0, edge.inside, edge.outside)
        label, words = f"stripes_{period_mm:g}_mm", f"scan stripes {period_mm:g} mm apart in place of {name}"
        for part in excerpts(scan, strides=(_STRIDE // 2, _STRIDE)):
            taken = _over(_scan(plan, part.rows, f"{label}{part.suffix}"), label, stripes)
            out.append(Scan("lay", f"{words}{part.words}", taken))
    return out


def _pattern_under(plan: Plan, scan: IntArray) -> Pattern | None:
    return plan.patterns.get(plan.pattern_names[int(plan.pattern[scan[0]])])


def _scan(plan: Plan, rows: IntArray, name: str) -> Plan:
    return rescheduled(plan, rows, start_after(plan), reading_s(plan), name)


def _over(scan: Plan, name: str, pattern: Pattern) -> Plan:
    """Lay a pattern under all of a scan; a name that is taken stands for something else."""
    while name in scan.pattern_names and scan.patterns.get(name) != pattern:
        name += "_new"
    names = tuple(dict.fromkeys((*scan.pattern_names, name)))
    number = np.full(len(scan), names.index(name))
    return replace(scan, pattern=number, pattern_names=names, patterns={**scan.patterns, name: pattern})


def _turned(scan: Plan) -> Plan:
    """Turn a scan's places by a quarter about their middle, anticlockwise."""
    x_mm, y_mm = scan.x_mm.mean(), scan.y_mm.mean()
    return replace(scan, x_mm=x_mm - (scan.y_mm - y_mm), y_mm=y_mm + (scan.x_mm - x_mm))


def _both_turned(scan: Plan, edge: HalfPlane) -> tuple[Plan, HalfPlane]:
    """Turn a scan and the edge under it, which stays as far from the scan's middle."""
    normal_rad = edge.normal_rad + math.pi / 2
    x_mm, y_mm = scan.x_mm.mean(), scan.y_mm.mean()
    moved_mm = sum(
        sign * (x_mm * math.cos(angle) + y_mm * math.sin(angle))
        for sign, angle in ((1, normal_rad), (-1, edge.normal_rad))
    )
    return _turned(scan), replace(edge, normal_rad=normal_rad, offset_mm=float(edge.offset_mm + moved_mm))


def _beyond(plan: Plan, rows: IntArray, edge: HalfPlane) -> FloatArray:
    """How far places are inside an edge, in mm."""
    return plan.x_mm[rows] * math.cos(edge.normal_rad) + plan.y_mm[rows] * math.sin(edge.normal_rad) - edge.offset_mm
