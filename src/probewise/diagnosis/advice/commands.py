"""What the arm could be told to do next: repeat, reverse, respeed, rotate, relight, raise, or look at something else.

The first three need nothing but the arm, the next three what the recording's `controls` list, the last a hand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.joining import covariates_joined, join_plans, last_known
from probewise.recordings.plan import Plan
from probewise.sensor import COMMANDED

__all__ = [
    "MOST_READINGS",
    "Command",
    "Excerpt",
    "behind",
    "commands",
    "distinct_scans",
    "excerpts",
    "in_turn",
    "minutes_of",
    "one_after_another",
    "put_off",
    "reading_s",
    "rescheduled",
    "start_after",
]

BREAK_S = 30.0  # to turn the sensor, or to change what lies under it
LAY_S = 60.0  # more than that to lay something that the plan had not
MOST_READINGS = 102
_LEAST_ROWS = 8
_MOST_SCANS = 6
_NEAR = 26  # readings around an edge
_TURN_DEG = 45.0
_RAISE = 1.25  # of the height that the recording names
_WORDS = {1: "", 2: " (every second reading, twice as fast)"}


@dataclass(frozen=True, eq=False)
class Command:
    """One scan that the arm could take: which of the six R's, "across" or "lay", words for it, its readings."""

    kind: str
    description: str
    plan: Plan

    @property
    def minutes(self) -> float:
        """How long it takes, with the break before it."""
        return minutes_of(self.plan) + self.lay_s / 60.0

    @property
    def lay_s(self) -> float:
        """How much longer the break before it is, to lay something."""
        return LAY_S if self.kind == "lay" else 0.0


@dataclass(frozen=True, eq=False)
class Excerpt:
    """Some rows of a scan, every so many: a suffix for its name, words to go behind its own."""

    suffix: str
    words: str
    rows: IntArray
    stride: int = 1


def excerpts(scan: IntArray, *, strides: Sequence[int] = (1,), level: FloatArray | None = None) -> list[Excerpt]:
    """Take parts of a scan that are worth a scan of their own.

    Parameters
    ----------
    scan
        Its row numbers.
    strides
        Every reading, every fourth, ...: one excerpt for each that leaves eight; every reading where none does.
    level
        What is expected of its readings, in the order of `scan`: one excerpt more, where that changes most.
    """
    out = []
    for stride in [s for s in strides if len(scan[::s]) >= _LEAST_ROWS] or [1]:
        rows = scan[::stride][:MOST_READINGS]
        if rows.size >= _LEAST_ROWS:
            words = _WORDS.get(stride, f" (every {stride}th reading, {stride} times as fast)")
            out.append(Excerpt("" if stride == 1 else f"_{stride}", words, rows, stride))
    if level is not None and scan.size > _NEAR:
        change = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(level)))])
        first = int(np.argmax(change[_NEAR - 1 :] - change[: 1 - _NEAR]))
        if change[first + _NEAR - 1] > change[first]:
            rows = scan[first : first + _NEAR]
            out.append(Excerpt("_near", " (where it changes most)", rows))
    return out


def commands(plan: Plan, *, strides: Sequence[int] = (1,), level: FloatArray | None = None) -> list[Command]:
    """List what could be done with the scans of a plan, each pose of a scan once.

    Parameters
    ----------
    plan
        What was measured, or is to be.
    strides
        Take every reading of a scan, every fourth, ...: a list for each.
    level
        What is expected of every row, (n_points,): then also the part of each scan where that changes most.
    """
    controls = plan.instrumentation.controls
    height_mm = plan.instrumentation.height_mm
    gap_s, start_s = reading_s(plan), start_after(plan)
    out: list[Command] = []
    for scan in distinct_scans(plan):
        name = plan.scan_names[int(plan.scan[scan[0]])]
        degrees = math.degrees(float(plan.orientation_rad[scan[0]]))
        for part in excerpts(scan, strides=strides, level=None if level is None else level[scan]):
            rows, every, label = part.rows, part.words, f"{name}{part.suffix}"
            once = rescheduled(plan, rows, start_s, gap_s, label)
            both = np.concatenate([rows[: MOST_READINGS // 2 * 2 : 2], rows[: MOST_READINGS // 2 * 2 : 2][::-1]])
            out += [
                Command("repeat", f"take scan {name} again{every}", _named(once, "again")),
                Command(
                    "reverse",
                    f"take scan {name} backwards{every}",
                    rescheduled(plan, rows[::-1], start_s, gap_s, f"{label}_reversed"),
                ),
                Command(
                    "respeed",
                    f"scan {name} forth and back {_faster(part)}",
                    rescheduled(plan, both, start_s, gap_s, f"{label}_both"),
                ),
            ]
            if "orientation_deg" in controls:
                turned = replace(once, orientation_rad=once.orientation_rad + math.radians(_TURN_DEG))
                words = f"take scan {name} with the sensor turned to {degrees + _TURN_DEG:.0f} degrees{every}"
                out.append(Command("rotate", words, _named(turned, "turned")))
            if "led" in controls:
                dark = _commanded(once, "led", 0.0)
                out.append(Command("relight", f"take scan {name} with the LED off{every}", _named(dark, "dark")))
            if "height_mm" in controls and height_mm is not None:
                high = _commanded(once, "height_mm", _RAISE * height_mm)
                words = f"take scan {name} with the sensor at {_RAISE * height_mm:.4g} mm{every}"
                out.append(Command("raise", words, _named(high, "raised")))
    return out


def behind(plan: Plan, more: Sequence[Plan]) -> Plan:
    """Set plans behind a plan; a pattern of one name is one pattern.

    A covariate that the others lack keeps its last known value there, such as a battery's; what is commanded
    (the LED, the height) is as at calibration where a plan does not say.
    """
    plans = [plan, *more]
    starts = np.cumsum([0, *(len(p.scan_names) for p in plans)])
    names = tuple(dict.fromkeys(name for p in plans for name in p.pattern_names))
    numbers = [np.array([names.index(name) for name in p.pattern_names], dtype=np.int64) for p in plans]
    return replace(
        plan,
        x_mm=np.concatenate([p.x_mm for p in plans]),
        y_mm=np.concatenate([p.y_mm for p in plans]),
        orientation_rad=np.concatenate([p.orientation_rad for p in plans]),
        time_s=np.concatenate([p.time_s for p in plans]),
        scan=np.concatenate([p.scan + start for p, start in zip(plans, starts, strict=False)]),
        scan_names=tuple(name for p in plans for name in p.scan_names),
        pattern=np.concatenate([own[p.pattern] for own, p in zip(numbers, plans, strict=True)]),
        pattern_names=names,
        patterns={name: pattern for p in reversed(plans) for name, pattern in p.patterns.items()},
        covariates=covariates_joined(plans),
    )


def start_after(plan: Plan) -> float:
    """When a scan after a plan can begin, in s."""
    return float(plan.time_s.max(initial=0.0)) + BREAK_S


def minutes_of(plan: Plan) -> float:
    """Estimate how long a plan takes, with the break before it."""
    return (float(np.ptp(plan.time_s)) + BREAK_S) / 60.0 if len(plan) else 0.0


def rescheduled(plan: Plan, rows: IntArray, start_s: float, gap_s: float, name: str) -> Plan:
    """Take rows of a plan as one new scan, in their order, from `start_s` on, commanded as they were."""
    taken = plan.take(rows)
    controls = plan.instrumentation.controls
    return replace(
        taken,
        time_s=np.asarray(start_s + gap_s * np.arange(len(rows)), dtype=np.float64),
        scan=np.zeros(len(rows), dtype=np.int64),
        scan_names=(name,),
        covariates={k: v for k, v in taken.covariates.items() if k in COMMANDED or k in controls},
    )


def _faster(part: Excerpt) -> str:
    """Say how fast every second reading of an excerpt is taken; a reading takes as long as it did."""
    if part.stride == 1:
        return f"at double speed{part.words}"
    return f"at {2 * part.stride} times the speed (every {2 * part.stride}th reading)"


def _named(plan: Plan, how: str) -> Plan:
    return replace(plan, scan_names=(f"{plan.scan_names[0]}_{how}",))


def _commanded(plan: Plan, name: str, value: float) -> Plan:
    return replace(plan, covariates={**plan.covariates, name: np.full(len(plan), value)})


def distinct_scans(plan: Plan) -> list[IntArray]:
    """Row numbers of the first scans of all that move and differ in pattern, orientation or ends."""
    seen: dict[tuple[object, ...], IntArray] = {}
    for rows in plan.rows_by_scan():
        if rows.size < _LEAST_ROWS or not plan.direction[rows].any():
            continue
        places = ((round(float(plan.x_mm[r]), 3), round(float(plan.y_mm[r]), 3)) for r in (rows[0], rows[-1]))
        key = (int(plan.pattern[rows[0]]), round(float(plan.orientation_rad[rows[0]]), 4), *sorted(places))
        seen.setdefault(key, rows)
    return list(seen.values())[:_MOST_SCANS]


def one_after_another(scans: Sequence[Command], after: Plan) -> tuple[Plan, list[IntArray]]:
    """Lay scans out as one plan, so that a model looks at all of them in one prediction; and the rows of each.

    Covariates that they lack, such as a battery's, stay as they were at the end of the plan before them.
    """
    ends = np.cumsum([len(scan.plan) for scan in scans])
    rows = [np.arange(end - len(scan.plan), end) for end, scan in zip(ends.tolist(), scans, strict=True)]
    return _as_left(_joined(scans), after), rows


def in_turn(scans: Sequence[Command], after: Plan) -> Plan:
    """Take scans one after the other, with a break before each, a longer one where something has to be laid.

    Covariates that they lack are as expected, as in `one_after_another`: a column to be filled in with what is read.
    """
    out: list[Command] = []
    for scan in scans:
        out.append(_from(scan, start_after(out[-1].plan) if out else float(scan.plan.time_s[0])))
    return _as_left(_joined(out), after)


def _as_left(plan: Plan, after: Plan) -> Plan:
    """Fill in covariates that nobody commands with what they were at the end of the plan before."""
    read = {name: last_known(values) for name, values in after.covariates.items() if name not in COMMANDED}
    kept = {name: np.full(len(plan), last) for name, last in read.items() if math.isfinite(last)}
    return replace(plan, covariates={**kept, **plan.covariates})


def _joined(scans: Sequence[Command]) -> Plan:
    return join_plans([scan.plan for scan in scans])


def put_off(scan: Command, plan: Plan) -> Command:
    """Put a scan off until a plan is over, and what has to be laid for it is laid."""
    return _from(scan, start_after(plan))


def _from(scan: Command, start_s: float) -> Command:
    """Begin a scan at a time, or later by what it takes to lay something."""
    delay_s = start_s + scan.lay_s - float(scan.plan.time_s[0])
    return replace(scan, plan=replace(scan.plan, time_s=scan.plan.time_s + delay_s))


def reading_s(plan: Plan) -> float:
    """Seconds from one reading to the next, the median within scans; 1 s where nothing tells."""
    gaps = np.diff(plan.time_s)[np.diff(plan.scan) == 0]
    gaps = gaps[gaps > 0]
    return float(np.median(gaps)) if gaps.size else 1.0
