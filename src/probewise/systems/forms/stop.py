"""A meter that stops at an undeclared end of its range, found from equal extreme readings before any fit."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.effects import Extent, NoiseEffect, lattice_step
from probewise.priors import Product, Uniform
from probewise.recordings.plan import Plan, Recording
from probewise.sensor import Stage
from probewise.sensor.stages import NoiseParameters

_LEAST_IN_TURN = 5  # successive readings of exactly one value
_LEAST_IN_ALL = 8
# Of the median change from one reading to the next: on a coarser lattice readings are equal without a stop.
_FINE = 0.1
# Share of the other readings that equal the one before. Eight equal readings in turn, or five and three, are then by
# chance in one of 1e5 places, and at the end of the range in fewer.
_OFTEN = 0.1


@dataclass(frozen=True)
class MeterStop(NoiseEffect):
    """Saturation of a meter at `level`, after the noise: its readings there are exactly equal.

    Readings at the stop are left out of the fit, so that the noise model does not change. In the stored model, the stop
    is the form `saturation` of the reading.
    """

    level: float
    is_ceiling: bool
    reading: str = "the reading"
    unit: str = ""

    name: ClassVar[str] = "saturation"
    stage: ClassVar[Stage] = Stage.NOISE
    units: ClassVar[tuple[str, ...]] = ("reading",)
    covariates: ClassVar[tuple[str, ...]] = ("level",)
    amplitudes: ClassVar[tuple[int, ...]] = ()
    nodes_per_parameter: ClassVar[tuple[int, ...]] = ()
    changes_the_mean: ClassVar[bool] = True

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Return None: readings alone show a stop; see `find_meter_stop_and_mask`."""
        return None

    @property
    def parameters_known_before_fit(self) -> FloatArray:
        """The level, (1,)."""
        return np.array([self.level])

    @cached_property
    def prior(self) -> Product:
        """Prior of the level: certain to within rounding."""
        near = 1e-9 * (1 + abs(self.level))
        return Product({"level": Uniform(self.level - near, self.level + near)})

    def apply(self, value: NoiseParameters, theta: FloatArray, plan: Plan) -> NoiseParameters:
        """Return the noise unchanged."""
        return value

    def change_of_readings(self, predicted: FloatArray) -> FloatArray:
        """Return the change of predicted readings, of any shape, by the stop: 0 or level - predicted."""
        beyond = np.maximum if self.is_ceiling else np.minimum
        return -beyond(predicted - self.level, 0.0)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Return a sentence on the level at which the readings end; mean and sd are not used."""
        way = "rises" if self.is_ceiling else "falls"
        return f"{self.reading} {way} no further than {self.level:.6g} {self.unit}".rstrip() + ", where the meter stops"


def find_meter_stop_and_mask(recording: Recording, reading: str = "the reading") -> tuple[MeterStop, BoolArray] | None:
    """Find a stop at the largest or smallest reading; return it and the mask of the rows there, (n_points,), or None.

    At least eight readings, five of them in succession, must equal that reading exactly: noise makes readings differ,
    unless the meter saturates after the noise. None also if rounding is too coarse to tell, or if that end was
    declared.
    """
    usable = np.flatnonzero(recording.usable)
    readings, scan = recording.readings[usable], recording.plan.scan[usable]
    if len(readings) <= _LEAST_IN_ALL:
        return None
    in_turn = (np.diff(usable) == 1) & (np.diff(scan) == 0)
    steps = np.abs(np.diff(readings))[in_turn]
    typical = float(np.median(steps)) if steps.size else 0.0
    if not typical or lattice_step(readings) > _FINE * typical:
        return None
    for is_ceiling in (True, False):
        level = float(readings.max() if is_ceiling else readings.min())
        stands = readings == level
        elsewhere = steps[~stands[1:][in_turn]]
        if level in recording.plan.instrumentation.declared_ends or np.mean(elsewhere == 0) > _OFTEN:
            continue
        if stands.sum() >= _LEAST_IN_ALL and _longest_streak(stands, in_turn) >= _LEAST_IN_TURN:
            unit = recording.plan.instrumentation.unit
            return MeterStop(level, is_ceiling, reading, unit), recording.readings == level
    return None


def _longest_streak(stands: BoolArray, in_turn: BoolArray) -> int:
    """Return the largest number of successive rows at the stop; `in_turn` marks rows that follow the one before."""
    longest = current = int(stands[0])
    for at, follows in zip(stands[1:].tolist(), in_turn.tolist(), strict=True):
        current = (current + 1 if follows else 1) if at else 0
        longest = max(longest, current)
    return longest
