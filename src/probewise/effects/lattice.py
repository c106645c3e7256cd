"""Undeclared quantisation: readings that lie on a lattice."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.extent import Extent
from probewise.effects.vocabulary import NoiseEffect
from probewise.priors import LogUniform, Product
from probewise.recordings.plan import Plan
from probewise.sensor.stages import NoiseParameters, Stage

_TELLING = 15.0  # least ratio of a lattice's step to the rounding of the printed values
_DIGITS = 1e-6  # of a step: below this a difference is rounding


@dataclass(frozen=True)
class Quantisation(NoiseEffect):
    """Readings rounded to a step that was not declared: step round(reading / step), after the noise."""

    smallest: float = 0.05
    largest: float = 20.0
    unit: str = field(default="", kw_only=True)

    name = "quantisation"
    words = "rounded readings"
    stage = Stage.NOISE
    units = ("reading",)
    covariates = ("lattice",)
    n_nodes = 16
    nodes_per_parameter = ()  # one node, from the readings
    seen_above: ClassVar[float] = 0.3
    """Smallest step, in noise sds, that counts: a finer lattice is only the printing of digits."""

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return the effect with steps from 0.1 to 20 % of the readings' range; None if a step is declared."""
        if extent.plan.instrumentation.step is not None:
            return None
        return cls(1e-3 * extent.span, 0.2 * extent.span, unit=extent.reading_unit)

    @cached_property
    def prior(self) -> Product:
        return Product({"step": LogUniform(self.smallest, self.largest)})

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        return replace(value, step=theta[:, :1])

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        return (
            f"the readings are rounded to steps of {value_with_sd(mean[0], sd[0], self.unit)}, which were not declared"
        )


def lattice_step(readings: FloatArray) -> float:
    """Find the step of a lattice that holds all readings; 0 where there is none.

    The result is 0 also for a step below 1e-5 of the range, and for fewer than three distinct readings. Readings
    printed to some digits lie on a lattice too; a coarser lattice is found through it, since printing moves each value
    by at most half a digit.
    """
    values = np.unique(readings[np.isfinite(readings)])
    if len(values) < 3:
        return 0.0
    least = 1e-6 * float(values[-1] - values[0])
    exact = _greatest_common_step(values, least)
    return _step_of_rounded_lattice(values, exact or 10 * least) or exact


def sd_of_estimated_lattice_step(readings: FloatArray, step: float) -> float:
    """Estimate the sd of a lattice's step, as fitted to distinct readings that were printed to some digits.

    The result is the printing's rounding error (sd) over the norm of the readings' centred lattice numbers; at least a
    millionth of the step.
    """
    values = np.unique(readings[np.isfinite(readings)])
    first = max(math.floor(-math.log10(step)), 0)  # the digits are no coarser than the step, which may be tiny
    digits = (
        10.0**-n
        for n in range(first, first + 10)
        if np.allclose(values, np.round(values, n), rtol=0, atol=1e-6 * 10.0**-n)
    )
    reach = float(np.linalg.norm(values - values.mean())) / step
    return max(next(digits, 0.0) / math.sqrt(12) / reach, _DIGITS * step)


def _step_of_rounded_lattice(values: FloatArray, rounding: float) -> float:
    """Fit the step of a lattice to rounded values, from the two closest outwards; 0 if one of them is off the lattice.

    `rounding` is the full width of the rounding error of each value.
    """
    gaps = np.diff(values)
    step, start = float(gaps.min()), float(values[np.argmin(gaps)])
    if step <= _TELLING * rounding:
        return 0.0
    reach, known = 0.0, 1.0  # distance up to which values are numbered, and how many steps the last fit spanned
    while reach < values[-1] - values[0]:
        further = 0.2 * step / rounding * known * step  # up to here every value's number is certain
        near = values[np.abs(values - start) <= further]
        if further <= reach or len(near) < 2:
            return 0.0
        number = np.round((near - start) / step)
        reach, known = further, max(float(np.ptp(number)), 1.0)
        step, start = np.polyfit(number, near, 1).tolist()
    off = np.abs(values - start - step * np.round((values - start) / step))
    return step if float(off.max()) <= 0.75 * rounding else 0.0


def _greatest_common_step(values: FloatArray, tolerance: float) -> float:
    """Find the greatest step of which all gaps of sorted values are multiples; 0 if at most ten times the tolerance.

    Euclid's algorithm on their differences; a remainder below the tolerance counts as rounding.
    """
    step = 0.0
    for gap in np.diff(values):
        larger, smaller = max(step, float(gap)), min(step, float(gap))
        while smaller > tolerance:
            rest = larger - smaller * round(larger / smaller)
            larger, smaller = smaller, abs(rest)
        step = larger
        if step <= 10 * tolerance:
            return 0.0
    return step
