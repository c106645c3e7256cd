"""Adapt a plan to an arm: unit, range and step of its readings, and the columns that can be commanded."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

from probewise.errors import ParameterError

if TYPE_CHECKING:
    from probewise.arm import Geometry
    from probewise.recordings import Plan


SHIPPED = ("paper", "two_way")
"""Names of the plans that ship."""


def read_or_shipped_plan(text: str) -> Plan:
    """Return the shipped plan "paper" or "two_way", or read a plan from the file of that name."""
    from probewise.recordings import paper_plan, read_plan, two_way_plan

    shipped = dict(zip(SHIPPED, (paper_plan, two_way_plan), strict=True))
    return shipped[text]() if text in shipped else read_plan(text)


def plan_for_own_instrument(
    plan: Plan, *, unit: str | None = None, range_: str | None = None, step: str | None = None
) -> Plan:
    """Return the plan for a user's instrument: a given unit, range ("LOW,HIGH") or step replaces the plan's own.

    A new unit drops the plan's range, step and sensor. Measured covariates are left out.
    """
    said: dict[str, object] = {} if unit is None else {"unit": unit}
    if unit is not None:  # the declared values have another unit
        said |= {"min": None, "max": None, "step": None, "sensor": ""}
    if range_ is not None:
        said |= dict(zip(("min", "max"), _parse_numbers("--range", range_, 2), strict=True))
    if step is not None:
        (said["step"],) = _parse_numbers("--step", step, 1)
    instrumentation = dataclasses.replace(plan.instrumentation, **said)  # type: ignore[arg-type]
    return without_measured_covariates(dataclasses.replace(plan, instrumentation=instrumentation))


def plan_for_lego_arm(plan: Plan, geometry: Geometry) -> Plan:
    """Return the plan for the LEGO arm: in LEGO units, 1 to 100, at its reading height; no measured covariates."""
    instrumentation = dataclasses.replace(
        plan.instrumentation,
        unit="LEGO",
        min=1.0,
        max=100.0,
        step=1.0 if geometry.whole_percent else None,
        sensor=plan.instrumentation.sensor or "LEGO 9844 light sensor",
        height_mm=geometry.read_height_mm,
    )
    return without_measured_covariates(dataclasses.replace(plan, instrumentation=instrumentation))


def without_measured_covariates(plan: Plan) -> Plan:
    """Return the plan with only the covariates that can be commanded: its controls, "led" and "height_mm"."""
    can = {*plan.instrumentation.controls, "led", "height_mm"}
    return dataclasses.replace(plan, covariates={name: v for name, v in plan.covariates.items() if name in can})


def _parse_numbers(option: str, text: str, n: int) -> list[float]:
    try:
        numbers = [float(cell) for cell in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != n or not all(map(math.isfinite, numbers)):
        raise ParameterError(option, text, "LOW,HIGH such as 0,1023" if n == 2 else "a number such as 1")
    return numbers
