"""What happens at one moment and stays: between which two readings is a discrete choice."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.effects.extent import Extent
from probewise.effects.vocabulary import Gates, NamedEffect, V
from probewise.recordings.plan import Plan

__all__ = ["SinceAMoment", "moments_of"]

_MOST_MOMENTS = 512
_FEW = 48  # moments, enough to see that something happened at one of them


@dataclass(frozen=True)
class SinceAMoment(NamedEffect[V]):
    """Act on the readings taken after `at_s`, the last parameter.

    `moments_s` are the times between which a change is told from the next one: those of the
    readings. Which two it happened between is a discrete choice; within them no reading tells.
    """

    moments_s: tuple[float, ...] = (0.0, 1e5)
    between_s: tuple[float, float] | None = None

    @property
    def open_s(self) -> tuple[float, float]:
        """First and last time left open."""
        return self.between_s or (self.moments_s[0], self.moments_s[-1])

    @staticmethod
    def since(theta: FloatArray, plan: Plan) -> BoolArray:
        """Tell which readings were taken after the moment, (n_samples, n_points)."""
        return np.asarray(plan.time_s > theta[:, -1:])

    def variants(self) -> tuple[Self, ...]:
        """Choose the two readings between which it happened."""
        return tuple(replace(self, between_s=pair) for pair in pairwise(self.moments_s))

    def coarse(self) -> Self:
        """Look between fewer moments."""
        stride = -(-(len(self.moments_s) - 1) // _FEW)
        return replace(self, moments_s=(*self.moments_s[:-1:stride], self.moments_s[-1]))

    def gates(self, plan: Plan) -> Gates:
        """Act everywhere, and after the middle of each interval."""
        always = self.bank()[0]
        always[:, -1] = -np.inf
        middles = [sum(pair) / 2 for pair in pairwise(self.moments_s)]
        return Gates(always, np.array([plan.time_s > at for at in middles]))

    def spread(self, theta: FloatArray, weights: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Draw the time from all intervals by their weight."""
        moments = np.array(self.moments_s)
        chosen = rng.choice(len(weights), len(theta), p=weights)
        at_s = moments[chosen] + np.diff(moments)[chosen] * rng.random(len(theta))
        return np.concatenate([theta[:, :-1], at_s[:, None]], axis=1)


def moments_of(extent: Extent) -> tuple[float, ...] | None:
    """List the times of a recording's readings, at most about 512; None where there is one alone."""
    moments = np.unique(extent.plan.time_s)
    if len(moments) < 2:
        return None
    stride = -(-(len(moments) - 1) // _MOST_MOMENTS)
    return tuple(np.append(moments[:-1:stride], moments[-1]).tolist())
