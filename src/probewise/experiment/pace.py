"""Paced time of a run, counted in readings, so that priors of drifts do not depend on the speed of the instrument.

Priors of effects in time are set before the speed of the instrument is known. So these effects use paced time, which is
0 at the first reading and scaled so that each reading takes eight seconds on average.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.arm.instrument import Reading
from probewise.effects.known import WrappedEffect
from probewise.recordings.plan import Plan, Recording
from probewise.sensor.stages import Effect, Poses

EACH_S = 8.0
"""Seconds of paced time that each reading takes on average."""

_COLUMN = "paced_s"


@dataclass(frozen=True)
class Pace:
    """Start time of a run in seconds, and mean seconds per reading."""

    start_s: float = 0.0
    each_s: float = EACH_S

    @classmethod
    def from_readings(cls, readings: Sequence[Reading]) -> Self:
        """Take the start and the mean seconds per reading of some readings; the default pace for fewer than two."""
        if len(readings) < 2 or readings[-1].time_s <= readings[0].time_s:
            return cls(readings[0].time_s if readings else 0.0)
        return cls(readings[0].time_s, (readings[-1].time_s - readings[0].time_s) / (len(readings) - 1))

    def plan_with_paced_time(self, plan: Plan) -> Plan:
        """Return the plan with a column of paced time."""
        own = (plan.time_s - self.start_s) * (EACH_S / self.each_s)
        return replace(plan, covariates={**plan.covariates, _COLUMN: own})

    def recording_with_paced_time(self, recording: Recording) -> Recording:
        """Return the recording with a column of paced time in its plan."""
        return replace(recording, plan=self.plan_with_paced_time(recording.plan))


def paced_time_s(plan: Plan) -> FloatArray | None:
    """Return the paced time of each reading, (n_points,); None if the plan has no such column."""
    return plan.covariates.get(_COLUMN)


class DescribedEffect(Effect[Any], Protocol):
    """An effect that can describe itself in a sentence."""

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Describe the effect, given posterior means and sds of its parameters."""
        ...


@dataclass(frozen=True, eq=False)
class EffectInPacedTime(WrappedEffect[FloatArray]):
    """An effect whose times and rates are in paced time; in recorded time if the plan has no paced time."""

    effect: DescribedEffect

    powers: ClassVar[Mapping[str, int]] = {"at_s": 1, "tau_s": 1, "per_hour": -1}

    def apply(self, value: FloatArray, theta: FloatArray, plan: Plan) -> FloatArray:
        """Apply the effect in paced time, or in recorded time if the plan has no paced time."""
        own = paced_time_s(plan)
        return np.asarray(self.effect.apply(value, theta, plan if own is None else replace(plan, time_s=own)))

    def theta_in_seconds(self, theta: FloatArray, pace: Pace) -> FloatArray:
        """Convert parameters, any shape (..., n_params), from paced time to seconds."""
        powers = np.array([self.powers.get(name, 0) for name in self.prior.names])
        return np.asarray(theta * (pace.each_s / EACH_S) ** powers)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Describe the effect, given posterior means and sds of its parameters."""
        return self.effect.sentence(mean, sd)


@dataclass(frozen=True, eq=False)
class FromRest(WrappedEffect[Any]):
    """An effect of the direction of motion that spares a run's first reading, before which the arm may have rested."""

    effect: DescribedEffect

    def apply(self, value: Any, theta: FloatArray, plan: Plan) -> Any:
        """Apply the effect to all readings but the run's first."""
        found = self.effect.apply(value, theta, plan)
        own = paced_time_s(plan)
        if own is None or not (first := own <= 0.0).any():
            return found
        if not isinstance(value, Poses):
            return np.where(first, value, found)
        return replace(
            found,
            x_mm=np.where(first, value.x_mm, found.x_mm),
            y_mm=np.where(first, value.y_mm, found.y_mm),
        )

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Describe the effect, given posterior means and sds of its parameters."""
        return self.effect.sentence(mean, sd)


def theta_in_seconds_of(effect: Any, theta: FloatArray, pace: Pace) -> FloatArray:
    """Return an effect's parameters in seconds: converted if it is an `EffectInPacedTime`, else as they are."""
    return effect.theta_in_seconds(theta, pace) if isinstance(effect, EffectInPacedTime) else theta
