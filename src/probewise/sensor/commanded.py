"""What a recording says was commanded beside the place: the sensor's height and its LED.

A plan's columns `height_mm` and `led` (recording-format). A reading at another height than the one of the
description is seen through a footprint scaled by h/h0, with a signal scaled by (h0/h)^2; without the LED
there is no signal. Where a plan does not say (no column, NaN) the sensor is as it was calibrated.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from probewise._arrays import FloatArray
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Footprint

__all__ = ["COMMANDED", "height_ratio", "is_commanded", "light_of", "raised", "raised_as_commanded"]

COMMANDED = ("height_mm", "led")


def is_commanded(plan: Plan) -> bool:
    """Tell whether a plan asks for another height than the description's, or names the LED."""
    return "led" in plan.covariates or height_ratio(plan) is not None


def light_of(plan: Plan) -> FloatArray:
    """Return the share of the LED's light, 0 or 1 a reading, (n_points,) or (1,)."""
    led = plan.covariates.get("led")
    return np.ones(1) if led is None else np.where(np.isfinite(led), led, 1.0)


def height_ratio(plan: Plan) -> FloatArray | None:
    """Return h/h0 a reading, (n_points,); None where the height is the description's throughout, or not known."""
    height_mm, usual_mm = plan.covariates.get("height_mm"), plan.instrumentation.height_mm
    if height_mm is None or usual_mm is None:
        return None
    ratio = np.where(np.isfinite(height_mm), height_mm / usual_mm, 1.0)
    return None if (ratio == 1.0).all() else ratio


def raised_as_commanded(footprint: Footprint, plan: Plan) -> Footprint:
    """Scale the footprint by the height that was commanded over the description's."""
    ratio = height_ratio(plan)
    return footprint if ratio is None else raised(footprint, ratio[None, :])


def raised(footprint: Footprint, ratio: FloatArray) -> Footprint:
    """Scale the footprint by h/h0, (n_samples, n_points), and dim it by its square."""
    # No arm drives its sensor into the table: what a fit tries there must only be finite.
    ratio = np.clip(ratio, 0.1, 10.0)
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
