"""Polarised light: the signal varies as the cosine of twice the sensor's orientation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.linear import LinearEffect
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Stage

_MOST_EQUAL = 0.01


@dataclass(frozen=True)
class Polarisation(LinearEffect[FloatArray]):
    """Glossy paper partly polarises the light, and the sensor is more sensitive to one polarisation (law of Malus).

    signal x (1 + cos_frac cos 2 psi + sin_frac sin 2 psi), psi the sensor's orientation.
    """

    typical: float = 0.02

    name = "polarisation"
    words = "a signal that depends on the orientation"
    stage = Stage.GAIN
    units = ("1", "1")
    covariates = ("orientation",)
    parameters = ("cos_frac", "sin_frac")

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect; None where all orientations are equal or opposite."""
        columns = _columns(extent.plan)
        return cls() if np.ptp(columns, axis=1).max() > _MOST_EQUAL else None

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        return np.asarray(value * (1 + theta @ _columns(plan)))

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        size = float(np.hypot(*mean))
        size_sd = float(np.hypot(*(mean * sd))) / size if size > 0 else float(np.hypot(*sd))
        strongest_deg = float(np.rad2deg(np.arctan2(mean[1], mean[0])) / 2) % 180
        return (
            f"the signal varies by {value_with_sd(size, size_sd, factor=100)} % with twice the orientation and is "
            f"strongest at {strongest_deg:.0f} degrees: the light is polarised"
        )


def _columns(plan: Plan) -> FloatArray:
    """Return the cosine and the sine of twice the orientation, (2, n_points)."""
    return np.stack([np.cos(2 * plan.orientation_rad), np.sin(2 * plan.orientation_rad)])
