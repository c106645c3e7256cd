"""The time and the place from which effects count: 0, or a recording's own where it lies far from 0."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.recordings.plan import Plan

_FAR = 10.0  # of a recording's own lengths from 0


@dataclass(frozen=True)
class Origin:
    """The time, s, and the place in the lab frame, mm, from which effects count.

    Drifts, gradients and the phases of waves are relative to it. A recording far from 0, such as one in seconds since
    1970, would else have drifts of thousands of hours at its first reading, and phases that turn with the last digit of
    a frequency.
    """

    time_s: float = 0.0
    x_mm: float = 0.0
    y_mm: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite([self.time_s, self.x_mm, self.y_mm]).all():
            raise ParameterError("Origin", (self.time_s, self.x_mm, self.y_mm), "finite numbers")

    @classmethod
    def of(cls, plan: Plan) -> Self:
        """Choose the origin for a recording by its plan, for each axis on its own.

        The origin is 0 where the recording comes within ten of its own lengths of 0: its duration, or the diagonal of
        its places. Farther away, the origin is the first time, and the middle of the places.
        """
        length_mm = float(np.hypot(np.ptp(plan.x_mm), np.ptp(plan.y_mm)))

        def middle_mm(places_mm: FloatArray) -> float:
            far = is_far_from_zero(places_mm, length_mm)
            return float(places_mm.min() + places_mm.max()) / 2 if far else 0.0

        time_s = float(plan.time_s.min()) if is_far_from_zero(plan.time_s, float(np.ptp(plan.time_s))) else 0.0
        return cls(time_s, middle_mm(plan.x_mm), middle_mm(plan.y_mm))

    def seconds(self, plan: Plan) -> FloatArray:
        """Return the time of each reading since the origin, s, (n_points,)."""
        return plan.time_s - self.time_s

    def hours(self, plan: Plan) -> FloatArray:
        """Return the time of each reading since the origin, h, (n_points,)."""
        return self.seconds(plan) / 3600


@dataclass(frozen=True)
class CountsFromOrigin:
    """Base of effects whose formula holds the time or the place itself: they count from `origin`.

    The origin belongs to the recording that is diagnosed, so that the effect means the same in any other plan.
    """

    name: ClassVar[str]
    origin: Origin = field(default=Origin(), kw_only=True)

    @property
    def counted_from(self) -> str:
        """Phrase on the origin from which the effect counts; "" for 0."""
        raise NotImplementedError


class CountsTimeFromOrigin(CountsFromOrigin):
    """Base of effects whose formula holds the time."""

    @property
    def counted_from(self) -> str:
        """Phrase on the time from which the effect counts, s; "" for 0."""
        return f"time counts from {self.origin.time_s:.12g} s" if self.origin.time_s else ""


class CountsPlaceFromOrigin(CountsFromOrigin):
    """Base of effects whose formula holds the place."""

    @property
    def counted_from(self) -> str:
        """Phrase on the place from which the effect counts, mm; "" for (0, 0)."""
        x_mm, y_mm = self.origin.x_mm, self.origin.y_mm
        return f"X and Y count from ({x_mm:g}, {y_mm:g}) mm" if x_mm or y_mm else ""


def origins_of(effects: Iterable[object]) -> dict[str, Origin]:
    """Return the origins of those effects that do not count from 0, by the effect's name."""
    counting = (effect for effect in effects if isinstance(effect, CountsFromOrigin))
    return {effect.name: effect.origin for effect in counting if effect.origin != Origin()}


def is_far_from_zero(values: FloatArray, length: float) -> bool:
    """Return whether all values, (n_points,), lie more than ten times `length` from 0; False for length 0."""
    return float(np.nanmin(np.abs(values))) > _FAR * length > 0.0
