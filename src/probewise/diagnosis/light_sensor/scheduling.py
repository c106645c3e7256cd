"""Scans that the arm could take, and their concatenation into a plan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from probewise.diagnosis.joining import join_plans, last_known_value
from probewise.recordings.plan import Plan
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
        return duration_minutes(self.plan) + self.sheet_laying_s / 60.0

    @property
    def sheet_laying_s(self) -> float:
        """Additional break before it for laying a sheet, in seconds."""
        return LAY_S if self.kind == "lay" else 0.0


def earliest_start_s(plan: Plan) -> float:
    """Return the earliest start of a scan after a plan, in s."""
    return float(plan.time_s.max(initial=0.0)) + BREAK_S


def duration_minutes(plan: Plan) -> float:
    """Estimate the duration of a plan in minutes, including the break before it."""
    return (float(np.ptp(plan.time_s)) + BREAK_S) / 60.0 if len(plan) else 0.0


def plan_of_alternatives(scans: Sequence[Scan], after: Plan) -> Plan:
    """Concatenate alternative scans, each timed as if directly after a plan, to predict all of them at once.

    Covariates that the scans lack, such as battery voltage, keep their last value of that plan.
    """
    return _with_last_known_covariates(_joined_plan(scans), after)


def plan_of_sequence(scans: Sequence[Scan], after: Plan) -> Plan:
    """Concatenate scans with a break before each, a longer one if a sheet has to be laid.

    Covariates that the scans lack are filled as in `plan_of_alternatives`, to be replaced by measured values.
    """
    out: list[Scan] = []
    for scan in scans:
        out.append(_scan_started_at(scan, earliest_start_s(out[-1].plan) if out else float(scan.plan.time_s[0])))
    return _with_last_known_covariates(_joined_plan(out), after)


def _with_last_known_covariates(plan: Plan, after: Plan) -> Plan:
    """Fill covariates that cannot be commanded with their last known values of the preceding plan."""
    read = {name: last_known_value(values) for name, values in after.covariates.items() if name not in COMMANDED}
    kept = {name: np.full(len(plan), last) for name, last in read.items() if math.isfinite(last)}
    return replace(plan, covariates={**kept, **plan.covariates})


def _joined_plan(scans: Sequence[Scan]) -> Plan:
    return join_plans([scan.plan for scan in scans])


def scan_started_after(scan: Scan, plan: Plan) -> Scan:
    """Move a scan to after a plan, with time to lay its sheet."""
    return _scan_started_at(scan, earliest_start_s(plan))


def _scan_started_at(scan: Scan, start_s: float) -> Scan:
    """Start a scan at a time, plus the time to lay its sheet."""
    delay_s = start_s + scan.sheet_laying_s - float(scan.plan.time_s[0])
    return replace(scan, plan=replace(scan.plan, time_s=scan.plan.time_s + delay_s))
