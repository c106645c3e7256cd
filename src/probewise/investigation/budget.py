"""The measurement budget beyond the first plan."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from probewise._kinds import checked_number
from probewise.errors import ParameterError
from probewise.recordings.plan import Plan


@dataclass(frozen=True)
class Budget:
    """Readings and minutes that may be spent after the first plan; either may be infinite.

    Minutes are measured by the times in the plans, breaks between rounds included.
    """

    readings: float = 400
    minutes: float = math.inf

    def __post_init__(self) -> None:
        for name in ("readings", "minutes"):
            if not checked_number(name, getattr(self, name)) >= 0:
                raise ParameterError(name, getattr(self, name), "0 or more")

    def minus(self, plan: Plan, after_s: float) -> Budget:
        """Return the budget without the cost of a plan, at least 0; minutes count from time `after_s` to its end."""
        return Budget(max(self.readings - len(plan), 0), max(self.minutes - _minutes_of_plan(plan, after_s), 0.0))

    def affordable_scans(self, plan: Plan, after_s: float) -> Plan | None:
        """Return the plan's first scans that fit the budget, in minutes from the time `after_s`; None if none does."""
        kept = np.zeros(0, dtype=np.int64)
        for rows in plan.rows_by_scan():
            more = np.concatenate([kept, rows])
            if len(more) > self.readings or _minutes_of_plan(plan.take(more), after_s) > self.minutes:
                break
            kept = more
        if len(kept) == len(plan):
            return plan
        return plan.take(kept) if kept.size else None

    def exhausted_part(self, plan: Plan) -> str:
        """Return which part of the budget a plan's first scan exceeds: "readings", otherwise "minutes"."""
        first = next((rows for rows in plan.rows_by_scan() if rows.size), ())
        return "readings" if len(first) > self.readings else "minutes"


def _minutes_of_plan(plan: Plan, after_s: float) -> float:
    return (float(plan.time_s.max()) - after_s) / 60.0
