"""The steps by which a law is integrated over a table, in all runs together, and the methods that take them.

Explicit Runge-Kutta methods, the classical one of fourth order and that of Dormand and Prince of eighth order, and for
stiff laws a linearly implicit (Rosenbrock) one, RODAS, of fourth order and L-stable. Source of the latter: Hairer &
Wanner, Solving Ordinary Differential Equations II, 1996, section IV.7 and its program RODAS, in the variables u that
need no product with the Jacobian (equation 7.25).
"""

from __future__ import annotations

from collections.abc import Callable
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

Rates = Callable[[FloatArray, Any], FloatArray]
"""Rate of each state, (n_states, n_samples, n_columns), from states of that shape and the inputs at some time."""

Between = Callable[[Any], Any]
"""Inputs at a share of the gap between two rows: a number, or one for each column of the states."""


@dataclass(frozen=True)
class Rosenbrock:
    """The method RODAS; one step is one linear system for each sample and column, solved six times."""

    def advance(
        self, rates: Rates, between: Between, s: FloatArray, begin: Any, length: Any, gap: FloatArray
    ) -> FloatArray:
        """Return the states after a step from `s`, (n_states, n_samples, n_columns).

        `begin` and `length` are shares of the `gap`, the time from row to row, (1 or n_samples, n_columns): numbers, or
        one for each column.
        """
        n, *shape = s.shape
        width = np.broadcast_to(gap * length, shape)
        there = width > 0  # runs that ended stand still
        step = np.where(there, width, 1.0)
        given = between(begin)
        first = rates(s, given)
        size = np.maximum(np.abs(s), np.abs(step * first))
        nudge = _NUDGE * np.maximum(size, np.maximum(_LEAST_SIZE * size.max(axis=0), _TINY))
        matrix = np.empty((n, *s.shape))
        for k in range(n):
            less, more = s.copy(), s.copy()
            less[k] -= nudge[k]
            more[k] += nudge[k]
            matrix[:, k] = (rates(more, given) - rates(less, given)) * (-step / (more[k] - less[k]))
            matrix[k, k] += 1 / _GAMMA
        inverse = _inverse(matrix)
        by_time = (rates(s, between(begin + _LATER * length)) - first) / _LATER  # times the step's length
        u: list[FloatArray] = []
        at = s
        for k, (c, alpha, gamma) in enumerate(zip(_C, _ALPHA, _GAMMA_SUMS, strict=True)):
            if k:
                at = _with_weighted(s, _A[k], u) if k < len(_A) else at + u[-1]
            rate = first if k == 0 else rates(at, between(begin + alpha * length))
            right = _with_weighted(step * (rate + gamma * by_time), c, u)
            u.append(inverse[0, 0] * right if n == 1 else np.einsum("ij...,j...->i...", inverse, right))
        return np.where(there, at + u[-1], s)


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


@dataclass(frozen=True)
class RungeKutta:
    """Coefficients of a method: stages `a`, weights `b`, and the share `c` of the step at which each stage is."""

    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    c: tuple[float, ...]

    @cached_property
    def terms(self) -> list[list[tuple[int, float]]]:
        """The earlier stages with a weight, and it, of each stage but the first, then of the end of the step."""
        return [[(k, w) for k, w in enumerate(weights) if w] for weights in (*self.a[1:], self.b)]

    def advance(
        self, rates: Rates, between: Between, s: FloatArray, begin: Any, length: Any, gap: FloatArray
    ) -> FloatArray:
        """Return the states after a step, as `Rosenbrock.advance` does."""
        width, given, at = gap * length, between(begin), s
        known = [rates(s, given)]
        for k, ((first, weight), *others) in enumerate(self.terms, 1):
            if not others:  # of one stage, as all of fourth order are: one product less
                at = s + weight * width * known[first]
            else:
                rate = weight * known[first]
                for stage, w in others:
                    rate += w * known[stage]
                at = s + width * rate
            if k < len(self.c):
                given = given if self.c[k] == self.c[k - 1] else between(begin + self.c[k] * length)
                known.append(rates(at, given))
        return at


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

    `rows` are the table's rows at each position of each run, (n_places, n_runs), after its end the run's last; `place`
    is the position of each row, (n_points,). From a position to the next is a gap, of time `gaps`, (n_places - 1,
    n_runs), with the same number of steps in all runs, `n_steps`, (n_places - 1,), which the `method` takes.
    `n_before` are the steps from the first row of a run to its row at each position, (n_places,); `gap` is that in
    which each step lies, (n_steps,), and `begin` and `length` are the shares of it at which it begins and that it
    takes, (n_steps * n_runs,), by step, then run.
    """

    table: RunTable
    rows: IntArray
    place: IntArray
    gaps: FloatArray
    n_steps: IntArray
    method: RungeKutta | Rosenbrock
    n_before: IntArray
    gap: IntArray
    begin: FloatArray
    length: FloatArray


@lru_cache(maxsize=16)
def steps_for_table(table: RunTable, max_step: float, *, stiff: bool = False) -> Steps:
    """Return the steps over a table, none longer than `max_step`, in the unit of time, at fourth order.

    The method is linearly implicit if `stiff`, else explicit. Raises ParameterError if time decreases within a run.
    """
    table.require_rising_time()
    by_run, place = table.rows_by_scan(), np.empty(len(table), dtype=np.int64)
    longest = max(map(len, by_run))
    rows = np.stack([np.append(own, np.full(longest - len(own), own[-1])) for own in by_run], axis=1)
    for own in by_run:
        place[own] = np.arange(len(own))
    gaps = np.diff(table.time_s[rows], axis=0)
    n_steps = np.maximum(np.ceil(gaps.max(axis=1, initial=0.0) / max_step - 1e-9), 1).astype(np.int64)
    n_steps, method = (n_steps, RODAS) if stiff else cheapest_steps(n_steps)
    n_before, gap = np.append(0, np.cumsum(n_steps)), np.repeat(np.arange(len(n_steps)), n_steps)
    share = (np.arange(len(gap)) - n_before[gap]) / n_steps[gap]
    of_runs = (np.repeat(each, len(by_run)) for each in (share, 1.0 / n_steps[gap]))
    return Steps(table, rows, place, gaps, n_steps, method, n_before, gap, *of_runs)
