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
from probewise.diagnosis.commands import (
    MOST_READINGS,
    Command,
    distinct_scans,
    excerpts,
    reading_s,
    rescheduled,
    start_after,
)
from probewise.recordings.patterns import HalfPlane, Pattern, Stripes, Uniform
from probewise.recordings.plan import Plan

__all__ = ["layings"]

_FLAT_ROWS = 20  # readings of a plain surface
_FOOTPRINT = 1 / 14  # of a scan's length, as wide as is believed before any reading
_ASIDE = 0.3  # of a scan's length, how far from its middle an edge is moved
_LEAST_CROSSED = 0.3  # of its length, that a scan goes across an edge rather than along it
_STRIPES = (5, 10)  # how many go into a scan
_STRIDE = 4


def layings(plan: Plan) -> list[Command]:
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
        out.append(Command("lay", f"scan a plain {colour} surface", _over(flat, f"plain_{colour}", Uniform(albedo))))
    name = plan.scan_names[int(plan.scan[first[0]])]
    across = _on_other_axis(_scan(plan, first[:MOST_READINGS], "across"))
    out.append(Command("across", f"scan across scan {name}, along the other axis", across))
    for scan in scans:
        edge = _pattern_under(plan, scan)
        if isinstance(edge, HalfPlane):
            return [*out, *_laid_otherwise(plan, scan, edge)]
    return out


def _laid_otherwise(plan: Plan, scan: IntArray, edge: HalfPlane) -> list[Command]:
    """Turn the sheet of an edge on it, half round or by a quarter; move it; lay stripes."""
    name = plan.pattern_names[int(plan.pattern[scan[0]])]
    length = float(np.ptp(_beyond(plan, scan, edge)))
    if length < _LEAST_CROSSED * math.hypot(np.ptp(plan.x_mm[scan]), np.ptp(plan.y_mm[scan])):
        return []
    once = _scan(plan, scan, name)
    half_round = replace(edge, normal_rad=edge.normal_rad + math.pi, offset_mm=-edge.offset_mm)
    laid = [
        (f"{name}_half_round", f"{name}, turned half round on its edge", once, half_round),
        (f"{name}_quarter", f"{name}, turned by a quarter, along the other axis", *_mirrored(once, edge)),
    ]
    middle_mm = float(_beyond(plan, scan, edge).mean())
    for end in (-1.0, 1.0):
        aside_mm = float(np.round(middle_mm + end * _ASIDE * length))
        moved = replace(edge, offset_mm=edge.offset_mm + aside_mm)
        laid.append((f"{name}_by_{aside_mm:g}_mm", f"{name}, moved by {aside_mm:g} mm along its normal", once, moved))
    out = []
    for label, words, whole, pattern in laid:
        rows = np.arange(len(whole))
        seen = ndtr(_beyond(whole, rows, pattern) / (_FOOTPRINT * length))
        for part in excerpts(rows, strides=(_STRIDE,), level=seen):
            taken = _over(_scan(whole, part.rows, f"{label}{part.suffix}"), label, pattern)
            out.append(Command("lay", f"scan {words}{part.words}", taken))
    for number in _STRIPES:
        period_mm = float(np.round(length / number)) or length / number
        stripes = Stripes(edge.normal_rad, period_mm, 0.5, 0.0, edge.inside, edge.outside)
        label, words = f"stripes_{period_mm:g}_mm", f"scan stripes {period_mm:g} mm apart in place of {name}"
        for part in excerpts(scan, strides=(_STRIDE // 2, _STRIDE)):
            taken = _over(_scan(plan, part.rows, f"{label}{part.suffix}"), label, stripes)
            out.append(Command("lay", f"{words}{part.words}", taken))
    return out


def _pattern_under(plan: Plan, scan: IntArray) -> Pattern | None:
    return plan.patterns.get(plan.pattern_names[int(plan.pattern[scan[0]])])


def _scan(plan: Plan, rows: IntArray, name: str) -> Plan:
    return rescheduled(plan, rows, start_after(plan), reading_s(plan), name)


def _over(scan: Plan, name: str, pattern: Pattern) -> Plan:
    """Lay a pattern under all of a scan."""
    names = (*scan.pattern_names, name)
    number = np.full(len(scan), len(names) - 1)
    return replace(scan, pattern=number, pattern_names=names, patterns={**scan.patterns, name: pattern})


def _on_other_axis(scan: Plan) -> Plan:
    """Mirror a scan's places on the diagonal through their middle."""
    x_mm, y_mm = scan.x_mm.mean(), scan.y_mm.mean()
    return replace(scan, x_mm=x_mm + (scan.y_mm - y_mm), y_mm=y_mm + (scan.x_mm - x_mm))


def _mirrored(scan: Plan, edge: HalfPlane) -> tuple[Plan, HalfPlane]:
    """Mirror a scan and the edge under it."""
    c, s = math.cos(edge.normal_rad), math.sin(edge.normal_rad)
    turned = math.pi / 2 - edge.normal_rad  # its normal has cosine and sine swapped
    offset_mm = edge.offset_mm + (s - c) * (scan.x_mm.mean() - scan.y_mm.mean())
    return _on_other_axis(scan), replace(edge, normal_rad=turned, offset_mm=float(offset_mm))


def _beyond(plan: Plan, rows: IntArray, edge: HalfPlane) -> FloatArray:
    """How far places are inside an edge, in mm."""
    return plan.x_mm[rows] * math.cos(edge.normal_rad) + plan.y_mm[rows] * math.sin(edge.normal_rad) - edge.offset_mm
