"""Possible next scans over the targets in place: repeat, reverse, respeed, rotate, relight, raise.

The first three need only the arm, the others the recording's `controls`. Other targets are in `target_swaps`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.light_sensor.scheduling import Scan, earliest_start_s
from probewise.diagnosis.scheduling import MOST_READINGS
from probewise.effects import orientation_deg
from probewise.effects.reference import median_gap_s
from probewise.recordings.plan import Plan
from probewise.sensor import COMMANDED

_LEAST_ROWS = 8
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

    Parameters
    ----------
    scan
        Its row numbers.
    strides
        Strides to try; those that leave fewer than eight readings are skipped, and if all are, stride 1 is tried.
    level
        Expected readings, in the order of `scan`: adds the 26 successive readings over which they change most, if the
        scan is longer.
    """
    out = []
    for stride in [s for s in strides if len(scan[::s]) >= _LEAST_ROWS] or [1]:
        rows = scan[::stride][:MOST_READINGS]
        if rows.size >= _LEAST_ROWS:
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

    Parameters
    ----------
    plan
        The plan measured, or to be measured.
    strides
        Strides to try for each scan.
    level
        Expected readings, (n_points,): adds the part of each scan where they change most.
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
                dark = _with_commanded_value(once, "led", 0.0)
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


def _with_commanded_value(plan: Plan, name: str, value: float) -> Plan:
    return replace(plan, covariates={**plan.covariates, name: np.full(len(plan), value)})


def rows_of_distinct_scans(plan: Plan) -> list[IntArray]:
    """Return the row numbers of the first six moving scans of eight rows or more, without repeats and reversals."""
    seen: dict[tuple[object, ...], IntArray] = {}
    turned_deg = orientation_deg(plan)
    for rows in plan.rows_by_scan():
        if rows.size < _LEAST_ROWS or not plan.direction_of_motion[rows].any():
            continue
        places = ((round(float(plan.x_mm[r]), 3), round(float(plan.y_mm[r]), 3)) for r in (rows[0], rows[-1]))
        key = (int(plan.pattern[rows[0]]), round(float(turned_deg[rows[0]]), 2), *sorted(places))
        seen.setdefault(key, rows)
    return list(seen.values())[:_MOST_SCANS]
