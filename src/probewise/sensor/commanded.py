"""Commanded sensor height and LED: the plan's optional columns `height_mm` and `led`.

At height h instead of the description's h0 the footprint is scaled by h/h0 and the signal by (h0/h)^2; with
the LED off there is no signal. Without a column, or at NaN, the sensor is as it was calibrated.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Footprint

COMMANDED = ("height_mm", "led")


def has_commanded_height_or_led(plan: Plan) -> bool:
    """Return whether a plan commands the LED, or a height other than the description's."""
    return "led" in plan.covariates or height_ratio(plan) is not None


def led_state(plan: Plan) -> FloatArray:
    """Return the LED's state at each reading, 0 to 1, (n_points,), or (1,) without a column `led`; 1 at NaN.

    Raises ParameterError for a state outside 0 to 1: it multiplies the signal.
    """
    led = plan.covariates.get("led")
    if led is None:
        return np.ones(1)
    for beyond in led[(led < 0.0) | (led > 1.0)]:
        raise ParameterError("led", float(beyond), "0 (off) to 1 (on), NaN where it was not recorded")
    return np.where(np.isfinite(led), led, 1.0)


def height_ratio(plan: Plan) -> FloatArray | None:
    """Return h/h0 of each reading, (n_points,), 1 at NaN; None if no height is known or all are the description's.

    Raises ParameterError for a height of 0 or below.
    """
    height_mm, usual_mm = plan.covariates.get("height_mm"), plan.instrumentation.height_mm
    if height_mm is None or usual_mm is None:
        return None
    for beyond in height_mm[height_mm <= 0.0]:
        raise ParameterError("height_mm", float(beyond), "greater than 0, NaN where it was not commanded")
    ratio = np.where(np.isfinite(height_mm), height_mm / usual_mm, 1.0)
    return None if (ratio == 1.0).all() else ratio


@lru_cache(maxsize=32)  # models are predicted many times over one plan, and recognise it
def with_declared_height_commanded(plan: Plan, calibrated_mm: float | None) -> Plan:
    """Return a plan that declares the calibrated height, and commands the height that it declared before.

    Rows that command a height keep theirs. If either height is unknown, or both are equal, the plan is returned as it
    is.
    """
    own_mm = plan.instrumentation.height_mm
    if own_mm is None or calibrated_mm is None or own_mm == calibrated_mm:
        return plan
    column = plan.covariates.get("height_mm", np.full(len(plan), np.nan))
    return replace(
        plan,
        covariates={**plan.covariates, "height_mm": np.where(np.isfinite(column), column, own_mm)},
        instrumentation=replace(plan.instrumentation, height_mm=calibrated_mm),
    )


def footprint_at_commanded_height(footprint: Footprint, plan: Plan) -> Footprint:
    """Scale the footprint by h/h0 of the plan's commanded heights, and divide its brightness by the square."""
    ratio = height_ratio(plan)
    return footprint if ratio is None else _scaled_footprint(footprint, ratio[None, :])


def footprint_at_added_height(footprint: Footprint, added: FloatArray, plan: Plan) -> Footprint:
    """Scale the footprint for a height `added` to the commanded one, in h0, (n_samples or 1, n_points).

    The given footprint is that at the commanded height h, so it is scaled by (h + added h0) / h; h0 is the
    description's, and the factor is clipped to 0.1 to 10.
    """
    commanded = height_ratio(plan)
    # A fit may try heights that no arm can take: the result only has to stay finite.
    return _scaled_footprint(footprint, np.clip(1 + (added if commanded is None else added / commanded), 0.1, 10.0))


def _scaled_footprint(footprint: Footprint, ratio: FloatArray) -> Footprint:
    k = ratio[:, :, None]
    return replace(
        footprint,
        u_mm=footprint.u_mm * k,
        v_mm=footprint.v_mm * k,
        var_u=footprint.var_u * k**2,
        var_v=footprint.var_v * k**2,
        cov_uv=footprint.cov_uv * k**2,
        brightness=footprint.brightness / ratio**2,
    )
