"""Explicit Runge-Kutta methods: the classical one of fourth order, and that of Dormand and Prince of eighth order."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from probewise._arrays import IntArray
from probewise.systems.rosenbrock import Rosenbrock

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

    @cached_property
    def stages(self) -> tuple[Terms, ...]:
        """For each stage, (index, weight) of the earlier stages whose rates lead to it."""
        return tuple(map(_nonzero_terms, self.a))

    @cached_property
    def weights(self) -> Terms:
        """(Index, weight) of the stages whose rates lead to the end of the step."""
        return _nonzero_terms(self.b)


def _nonzero_terms(weights: tuple[float, ...]) -> Terms:
    return tuple((k, weight) for k, weight in enumerate(weights) if weight)


FOURTH_ORDER = RungeKutta(((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)), (1 / 6, 1 / 3, 1 / 3, 1 / 6), (0.0, 0.5, 0.5, 1.0))

N_LONGER = 3
"""Steps of fourth order that have as many evaluations as one of eighth order."""


@cache
def eighth_order_method() -> RungeKutta:
    """Return the method of eighth order.

    Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, 1993, section II.10.
    """
    from scipy.integrate import DOP853  # takes long, and laws alone need it

    a = tuple(tuple(row[:k].tolist()) for k, row in enumerate(DOP853.A))
    return RungeKutta(a, tuple(DOP853.B.tolist()), tuple(DOP853.C.tolist()))


@dataclass(frozen=True, eq=False)
class StepSchedule:
    """The number of steps in each gap between rows, (n_gaps,), and the method that takes the steps."""

    n_steps: IntArray
    method: RungeKutta | Rosenbrock

    @classmethod
    def from_fourth_order_steps(cls, n_steps: IntArray) -> StepSchedule:
        """Return a schedule of these numbers of fourth-order steps, (n_gaps,), or a third as many of eighth order.

        The third is rounded up in each gap. All gaps have the same order: the eighth if it costs at most 1.5 times as
        many evaluations in all, as where most gaps need several steps.
        """
        fewer = np.asarray(-(-n_steps // N_LONGER), dtype=np.int64)
        if N_LONGER * fewer.sum() <= _DEARER * n_steps.sum():
            return cls(fewer, eighth_order_method())
        return cls(n_steps, FOURTH_ORDER)
