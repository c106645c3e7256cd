"""Ready-made plans: the paper's calibration plan, and a two-way plan that detects more effects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from probewise._arrays import FloatArray
from probewise.recordings.patterns import Disc, HalfPlane, Pattern, Quadrant, Uniform
from probewise.recordings.plan import Instrumentation, Plan

LEGO = Instrumentation(
    unit="LEGO", min=0.0, max=100.0, sensor="LEGO 9844 light sensor", height_mm=14.0, controls=("orientation_deg",)
)
PATTERNS: dict[str, Pattern] = {
    "boundary": HalfPlane(0.0, 0.0),  # paper, S_BW
    "quadrant_a": Quadrant((0.0, 0.0), (1, 1)),  # paper, S_a to S_d
    "quadrant_b": Quadrant((0.0, 0.0), (-1, 1)),
    "quadrant_c": Quadrant((4.0, 4.0), (1, 1)),
    "quadrant_d": Quadrant((-4.0, 4.0), (-1, 1)),
    "white": Uniform(1.0),
    "black": Uniform(0.0),
    "disc": Disc((0.0, 0.0), 40.0),
}
ORIENTATIONS_DEG = (0, 90, 180, 270)
QUADRANTS = ("quadrant_a", "quadrant_b", "quadrant_c", "quadrant_d")
_FULL_BATTERY_MV, _DRAIN_MV_PER_S = 8300.0, 0.12
_JITTER = 0.1  # largest change of an interval, as a share of it
_READING_S = 1.2  # from one reading to the next, about, of the paper's arm
# Name, places (n, 2), patterns (one, or one per reading), degrees, seconds from one reading to the next.
_Scan: TypeAlias = tuple[str, FloatArray, tuple[str, ...], float, float]


def paper_plan() -> Plan:
    """Return the plan of the paper's 408 readings (section "Data Collection for SSF Estimation").

    Four scans across the black-and-white boundary from -50 to 50 mm in steps of 1 mm with the sensor at 0, 90, 180 and
    270 degrees, `edge_0` to `edge_270`, then one reading on each of the four quadrant patterns at 0 degrees,
    `quadrants`. To turn the sensor between scans, or to change the pattern, takes 30 s.
    """
    line, break_s = _line_places(-50, 50, 1), 30.0
    scans: list[_Scan] = [(f"edge_{deg}", line, ("boundary",), deg, _READING_S) for deg in ORIENTATIONS_DEG]
    return _plan_of_scans([*scans, ("quadrants", np.zeros((4, 2)), QUADRANTS, 0, break_s)], break_s)


def two_way_plan() -> Plan:
    """Return a plan of 961 readings that distinguishes lag from backlash and gain from offset.

    For each orientation: the boundary out and back (the way back at double speed for 180 and 270 degrees, since lag
    depends on speed and backlash does not), plain white and plain black every 8 mm. Then the four quadrants, and a scan
    along Y across a disc, the only one that moves in Y. Between scans there are 40 s.
    """
    out, flat, break_s = _line_places(-50, 50, 1), _line_places(-40, 40, 8), 40.0
    scans: list[_Scan] = []
    for deg in ORIENTATIONS_DEG:
        scans += [
            (f"edge_{deg}_out", out, ("boundary",), deg, _READING_S),
            (f"edge_{deg}_back", out[::-1], ("boundary",), deg, _READING_S / 2 if deg >= 180 else _READING_S),
            (f"white_{deg}", flat, ("white",), deg, _READING_S),
            (f"black_{deg}", flat, ("black",), deg, _READING_S),
        ]
    scans.append(("quadrants", np.zeros((4, 2)), QUADRANTS, 0, break_s))
    scans.append(("disc_y", _line_places(60, -60, -2)[:, ::-1] + [-5.0, 0.0], ("disc",), 0, _READING_S))
    return _plan_of_scans(scans, break_s)


def with_jittered_times(plan: Plan, *, rng: np.random.Generator) -> Plan:
    """Return the plan with time intervals changed by up to a tenth.

    Its covariate `battery_mv`, if any, is computed from the new times, with noise.
    """
    intervals = np.diff(plan.time_s, prepend=0.0)
    time_s = np.round(np.cumsum(intervals * rng.uniform(1 - _JITTER, 1 + _JITTER, len(plan))), 3).astype(np.float64)
    covariates = dict(plan.covariates)
    if "battery_mv" in covariates:
        covariates["battery_mv"] = np.round(_battery_mv(time_s) + rng.normal(0.0, 4.0, len(plan)))
    return replace(plan, time_s=time_s, covariates=covariates)


def _line_places(first: int, last: int, step: int) -> FloatArray:
    x_mm = np.arange(first, last + np.sign(step), step, dtype=np.float64)
    return np.stack([x_mm, np.zeros_like(x_mm)], axis=-1)


def _battery_mv(time_s: FloatArray) -> FloatArray:
    return _FULL_BATTERY_MV - _DRAIN_MV_PER_S * time_s


def _plan_of_scans(scans: Sequence[_Scan], break_s: float) -> Plan:
    """Join scans to a plan, with the time of each reading and the battery's voltage."""
    names, places, named, turns_deg, paces_s = zip(*scans, strict=True)
    counts = [len(each) for each in places]
    intervals = np.repeat(np.array(paces_s, dtype=np.float64), counts)
    intervals[np.cumsum(counts)[:-1]] = break_s
    time_s = np.round(np.cumsum(intervals), 3).astype(np.float64)
    x_mm, y_mm = np.concatenate(places).T
    under = [name for own, n in zip(named, counts, strict=True) for name in (own if len(own) == n else own * n)]
    patterns = {name: pattern for name, pattern in PATTERNS.items() if name in under}
    return Plan(
        x_mm=x_mm,
        y_mm=y_mm,
        orientation_rad=np.repeat([math.radians(deg) for deg in turns_deg], counts),
        time_s=time_s,
        scan=np.repeat(np.arange(len(scans)), counts),
        scan_names=names,
        pattern=np.array([list(patterns).index(name) for name in under]),
        pattern_names=tuple(patterns),
        patterns=patterns,
        covariates={"battery_mv": np.round(_battery_mv(time_s))},
        instrumentation=LEGO,
    )
