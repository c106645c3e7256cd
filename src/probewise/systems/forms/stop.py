"""A meter that stops at an undeclared end of its range, found from equal extreme readings before any fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from probewise._arrays import BoolArray
from probewise.effects import NoiseEffect
from probewise.effects.noise import lattice_step
from probewise.priors import Uniform
from probewise.recordings.plan import Recording
from probewise.sensor.stages import Stage

_LEAST_IN_TURN = 5  # successive readings of exactly one value
_LEAST_IN_ALL = 8
# Of the median change from one reading to the next: on a coarser lattice readings are equal without a stop.
_FINE = 0.1
# Share of the other readings that equal the one before. Eight equal readings in turn, or five and three, are then by
# chance in one of 1e5 places, and at the end of the range in fewer.
_OFTEN = 0.1


@dataclass(frozen=True)
class MeterStop:
    """Saturation of a meter at `level`, after the noise: its readings there are exactly equal.

    Readings at the stop are left out of the fit, so that the noise model does not change. In the stored model, the stop
    is the form `saturation` of the reading.
    """

    level: float
    is_ceiling: bool
    reading: str = "the reading"
    unit: str = ""

    @cached_property
    def effect(self) -> NoiseEffect:
        """The stop as an effect, whose level is certain to within rounding."""
        near = 1e-9 * (1 + abs(self.level))
        way, beyond = ("rises", np.maximum) if self.is_ceiling else ("falls", np.minimum)
        says = f"{self.reading} {way} no further than {self.level:.6g} {self.unit}".rstrip()
        prior = {"level": Uniform(self.level - near, self.level + near)}
        own = ("saturation", Stage.NOISE, prior, ("reading",), ("level",), lambda noise, theta, plan: noise)
        return NoiseEffect(
            *own,
            np.array([[[self.level]]]),
            lambda mean, sd: f"{says}, where the meter stops",
            amplitudes=(),
            known=np.array([self.level]),
            change_of_readings=lambda predicted: -beyond(predicted - self.level, 0.0),
        )


def meter_stops_and_masks(recording: Recording, reading: str = "the reading") -> Iterator[tuple[MeterStop, BoolArray]]:
    """Yield stops at the largest and smallest reading, with the mask of the rows there, (n_points,).

    At least eight readings must equal that reading exactly, five of them in succession: noise makes readings differ,
    unless the meter saturates after the noise. None where rounding is too coarse to tell, or at an end that was
    declared.
    """
    usable = np.flatnonzero(recording.usable)
    readings, scan = recording.readings[usable], recording.plan.scan[usable]
    in_turn = (np.diff(usable) == 1) & (np.diff(scan) == 0)  # of successive rows of a run
    steps = np.abs(np.diff(readings))[in_turn]
    typical = float(np.median(steps)) if steps.size else 0.0
    if len(readings) <= _LEAST_IN_ALL or not typical > 0 or lattice_step(readings) > _FINE * typical:
        return  # they are too few or too coarse for equal ones to tell of a stop
    for is_ceiling in (True, False):
        level = float(readings.max() if is_ceiling else readings.min())
        stands, there = readings == level, recording.readings == level
        if stands.sum() < _LEAST_IN_ALL or recording.censored[there].any():
            continue
        elsewhere = steps[~stands[1:][in_turn]]
        follows = np.append(False, stands[:-1] & stands[1:] & in_turn)
        streaks = np.diff(np.flatnonzero(np.append(~follows, True)))  # of rows at the stop, or one elsewhere
        if np.mean(elsewhere == 0) <= _OFTEN and streaks.max() >= _LEAST_IN_TURN:
            yield MeterStop(level, is_ceiling, reading, recording.plan.instrumentation.unit), there
