"""Explicit Runge-Kutta methods: the classical one of fourth order, and that of Dormand and Prince of eighth order."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from probewise._arrays import IntArray

_DEARER = (
    1.5  # evaluations of the eighth order, in those of the fourth, up to which its far smaller error is worth them
)

Terms = tuple[tuple[int, float], ...]
"""The stages of a sum of rates that have a weight, and their weights."""


@dataclass(frozen=True)
class RungeKutta:
    """Coefficients of a method: stages `a`, weights `b`, and the share `c` of the step at which each stage is."""

    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    c: tuple[float, ...]

    @property
    def n_stages(self) -> int:
        """Evaluations of the rates per step."""
        return len(self.b)

    @cached_property
    def stages(self) -> tuple[Terms, ...]:
        """The sums of earlier rates that lead to each stage."""
        return tuple(map(_terms, self.a))

    @cached_property
    def weights(self) -> Terms:
        """The sum of rates that leads to the end of the step."""
        return _terms(self.b)


def _terms(weights: tuple[float, ...]) -> Terms:
    return tuple((k, weight) for k, weight in enumerate(weights) if weight)


FOURTH_ORDER = RungeKutta(((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)), (1 / 6, 1 / 3, 1 / 3, 1 / 6), (0.0, 0.5, 0.5, 1.0))

N_LONGER = 3
"""Steps of fourth order that have as many evaluations as one of eighth order."""


@cache
def eighth_order() -> RungeKutta:
    """Return the method (Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, 1993, section II.10)."""
    from scipy.integrate import DOP853  # takes long, and laws alone need it

    a = tuple(tuple(row[:k].tolist()) for k, row in enumerate(DOP853.A))
    return RungeKutta(a, tuple(DOP853.B.tolist()), tuple(DOP853.C.tolist()))


@dataclass(frozen=True, eq=False)
class Stepping:
    """The number of steps in each gap between rows, (n_gaps,), and the method that takes them."""

    in_gap: IntArray
    method: RungeKutta

    @classmethod
    def of(cls, in_gap: IntArray) -> Stepping:
        """Take these numbers of fourth-order steps, or a third as many of eighth order where that costs as much.

        In gaps that need a single step, fourth order suffices.
        """
        fewer = np.asarray(-(-in_gap // N_LONGER), dtype=np.int64)
        if N_LONGER * fewer.sum() <= _DEARER * in_gap.sum():
            return cls(fewer, eighth_order())
        return cls(in_gap, FOURTH_ORDER)
