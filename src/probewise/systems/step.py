"""The steps by which a law is integrated over a table, in all runs together, and the methods that take them.

Explicit Runge-Kutta methods, the classical one of fourth order and that of Dormand and Prince of eighth order, and for
stiff laws a linearly implicit (Rosenbrock) one, RODAS, of fourth order and L-stable. Source of the latter: Hairer &
Wanner, Solving Ordinary Differential Equations II, 1996, section IV.7 and its program RODAS, in the variables u that
need no product with the Jacobian (equation 7.25).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.systems.table import RunTable

_GAMMA = 0.25
_A = (
    (),
    (1.544,),
    (0.9466785280815826, 0.2557011698983284),
    (3.314825187068521, 2.896124015972201, 0.9986419139977817),
    (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950),
)
_C = (
    (),
    (-5.6688,),
    (-2.430093356833875, -0.2063599157091915),
    (-0.1073529058151375, -9.594562251023355, -20.47028614809616),
    (7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160),
    (8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054),
)
_ALPHA = (0.0, 0.386, 0.21, 0.63, 1.0, 1.0)  # share of the step at which each stage is
_GAMMA_SUMS = (0.25, -0.1043, 0.1035, -0.0362, 0.0, 0.0)  # weights of the rates' change with time
# Of a state's size, for the Jacobian by central differences: it is so smooth that all steps can be solved for at once.
_NUDGE = 1e-5
_LEAST_SIZE = 1e-6  # of the largest state's size, for one that is 0 and at rest
_TINY = 1e-150  # where all are
_LATER = 1e-4  # of a step, for the rates' change with time: inputs between rows are constant or straight lines
# Evaluations of the eighth order, in those of the fourth, up to which its far smaller error is worth them.
_DEARER = 1.5

Rates = Callable[[Mapping[str, Any], Any], Mapping[str, Any]]
"""Rate of each state, from states (n_samples, n_runs) and a share of the gap between two rows."""


@dataclass(frozen=True)
class Rosenbrock:
    """The method RODAS; one step is one linear system for each sample and run, solved six times."""

    def advanced(self, rates: Rates, s: Mapping[str, Any], begin: Any, length: Any, gap: FloatArray) -> dict[str, Any]:
        """Return the states after a step from `s`, (n_samples, n_runs) each, by name.

        `begin` and `length` are shares of the `gap`, the time from row to row, (1 or n_samples, n_runs): numbers, or
        one for each run.
        """
        names, shape = list(s), np.broadcast_shapes(gap.shape, *(np.shape(values) for values in s.values()))
        n = len(names)
        width = np.broadcast_to(gap * length, shape)
        there = width > 0  # runs that ended stand still
        step = np.where(there, width, 1.0)

        def rates_at(states: FloatArray, share: Any) -> FloatArray:
            found = rates(dict(zip(names, states, strict=True)), share)
            return np.stack([np.broadcast_to(found[name], shape) for name in names])

        start = np.stack([np.broadcast_to(s[name], shape) for name in names])
        first = rates_at(start, begin)
        size = np.maximum(np.abs(start), np.abs(step * first))
        nudge = _NUDGE * np.maximum(size, np.maximum(_LEAST_SIZE * size.max(axis=0), _TINY))
        matrix = np.empty((n, n, *shape))
        for k in range(n):
            less, more = start.copy(), start.copy()
            less[k] -= nudge[k]
            more[k] += nudge[k]
            matrix[:, k] = (rates_at(more, begin) - rates_at(less, begin)) * (-step / (more[k] - less[k]))
            matrix[k, k] += 1 / _GAMMA
        inverse = _inverse(matrix)
        by_time = (rates_at(start, begin + _LATER * length) - first) / _LATER  # times the step's length
        u: list[FloatArray] = []
        at = start
        for k, (c, alpha, gamma) in enumerate(zip(_C, _ALPHA, _GAMMA_SUMS, strict=True)):
            if k:
                at = _with_weighted(start, _A[k], u) if k < len(_A) else at + u[-1]
            rate = first if k == 0 else rates_at(at, begin + alpha * length)
            right = _with_weighted(step * (rate + gamma * by_time), c, u)
            u.append(inverse[0, 0] * right if n == 1 else np.einsum("ij...,j...->i...", inverse, right))
        end = np.where(there, at + u[-1], start)
        return dict(zip(names, end, strict=True))


RODAS = Rosenbrock()


def _with_weighted(first: FloatArray, weights: tuple[float, ...], terms: list[FloatArray]) -> FloatArray:
    out = first.copy()
    for weight, term in zip(weights, terms, strict=True):
        out += weight * term
    return out


def _inverse(matrices: FloatArray) -> FloatArray:
    """Return the inverses of matrices, (n, n, ...); NaN where there is none, or an element is not finite."""
    n = len(matrices)
    if n == 1:
        return np.asarray(1.0 / matrices)
    if n == 2:
        (a, b), (c, d) = matrices
        return np.asarray(np.array([[d, -b], [-c, a]]) / (a * d - b * c))
    own = np.moveaxis(matrices, (0, 1), (-2, -1))
    fine = np.isfinite(own).all(axis=(-2, -1), keepdims=True)
    own = np.where(fine, own, np.eye(n))
    try:
        inverse = np.linalg.inv(own)
    except np.linalg.LinAlgError:  # one of them is singular
        inverse = np.linalg.pinv(own)
    return np.moveaxis(np.where(fine, inverse, np.nan), (-2, -1), (0, 1))


Terms = tuple[tuple[int, float], ...]
"""The stages of a sum of rates that have a weight, and their weights."""


@dataclass(frozen=True)
class RungeKutta:
    """Coefficients of a method: stages `a`, weights `b`, and the share `c` of the step at which each stage is."""

    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    c: tuple[float, ...]

    @cached_property
    def terms(self) -> tuple[Terms, ...]:
        """The earlier stages whose rates lead to each stage, then those whose rates lead to the end of the step."""
        return tuple(tuple((k, w) for k, w in enumerate(weights) if w) for weights in (*self.a, self.b))


FOURTH_ORDER = RungeKutta(((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)), (1 / 6, 1 / 3, 1 / 3, 1 / 6), (0.0, 0.5, 0.5, 1.0))

N_LONGER = 3
"""Steps of fourth order that have as many evaluations as one of eighth order."""


@cache
def eighth_order_method() -> RungeKutta:
    """Return the method of Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, 1993, section II.10."""
    from scipy.integrate import DOP853  # takes long, and laws alone need it

    a = tuple(tuple(row[:k].tolist()) for k, row in enumerate(DOP853.A))
    return RungeKutta(a, tuple(DOP853.B.tolist()), tuple(DOP853.C.tolist()))


def cheapest_steps(n_steps: IntArray) -> tuple[IntArray, RungeKutta]:
    """Return these numbers of fourth-order steps in each gap, (n_gaps,), or a third of eighth order, and the method.

    The third is rounded up in each gap. All gaps have the same order: the eighth if it costs at most 1.5 times as many
    evaluations in all, as where most gaps need several steps.
    """
    fewer = np.asarray(-(-n_steps // N_LONGER), dtype=np.int64)
    if N_LONGER * fewer.sum() <= _DEARER * n_steps.sum():
        return fewer, eighth_order_method()
    return n_steps, FOURTH_ORDER


@dataclass(frozen=True, eq=False)
class Steps:
    """Integration steps over the rows of a table, in all its runs together; position k is the k-th row of every run.

    No step is longer than `max_step`, in the unit of time, at fourth order. The method is linearly implicit if `stiff`,
    else explicit.
    """

    table: RunTable
    max_step: float = np.inf
    stiff: bool = False

    @cached_property
    def row_by_position_and_run(self) -> IntArray:
        """Row of the table at each position of each run, (n_places, n_runs); after its end, a run's last row.

        Raises ParameterError if time decreases within a run.
        """
        self.table.require_rising_time()
        by_run = self.table.rows_by_scan()
        longest = max(map(len, by_run))
        return np.stack([np.append(rows, np.full(longest - len(rows), rows[-1])) for rows in by_run], axis=1)

    @cached_property
    def position_by_row(self) -> IntArray:
        """Position of each row in its run, (n_points,)."""
        place = np.empty(len(self.table), dtype=np.int64)
        for rows in self.table.rows_by_scan():
            place[rows] = np.arange(len(rows))
        return place

    @property
    def n_runs(self) -> int:
        """Number of runs."""
        return int(self.row_by_position_and_run.shape[1])

    @cached_property
    def gaps(self) -> FloatArray:
        """Time from each position to the next, (n_places - 1, n_runs), in the unit of time."""
        return np.diff(self.table.time_s[self.row_by_position_and_run], axis=0)

    @cached_property
    def _n_steps_and_method(self) -> tuple[IntArray, RungeKutta | Rosenbrock]:
        longest = self.gaps.max(axis=1, initial=0.0)
        n_steps = np.maximum(np.ceil(longest / self.max_step - 1e-9), 1).astype(np.int64)
        return (n_steps, RODAS) if self.stiff else cheapest_steps(n_steps)

    @property
    def n_steps(self) -> IntArray:
        """Number of steps in each gap, from a position to the next, the same in all runs, (n_places - 1,)."""
        return self._n_steps_and_method[0]

    @property
    def method(self) -> RungeKutta | Rosenbrock:
        """The method that takes the steps."""
        return self._n_steps_and_method[1]

    @cached_property
    def gap_of_step(self) -> IntArray:
        """Number of the gap in which each step lies, (n_steps,); gap k is between rows k and k + 1 of every run."""
        return np.repeat(np.arange(len(self.n_steps)), self.n_steps)

    @cached_property
    def n_steps_before_position(self) -> IntArray:
        """Number of steps from the first row of a run to its row at each position, (n_places,)."""
        return np.concatenate([[0], np.cumsum(self.n_steps)])

    @cached_property
    def begin_and_length(self) -> tuple[FloatArray, FloatArray]:
        """Shares of its gap at which each step begins, and that it takes, (n_steps * n_runs,), by step, then run."""
        gap = self.gap_of_step
        share = (np.arange(len(gap)) - self.n_steps_before_position[gap]) / self.n_steps[gap]
        return np.repeat(share, self.n_runs), np.repeat(1.0 / self.n_steps[gap], self.n_runs)


@lru_cache(maxsize=16)
def steps_for_table(table: RunTable, max_step: float, *, stiff: bool = False) -> Steps:
    """Return the `Steps` of an integration over a table."""
    return Steps(table, max_step, stiff)
