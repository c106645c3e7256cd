"""The steps by which a law is integrated over a table, in all runs together, and the two methods that take them.

The classical Runge-Kutta method of fourth order and, for stiff laws, a linearly implicit (Rosenbrock) one of third
order that is L-stable, RODAS3 (Sandu et al., Atmospheric Environment 31, 1997, 3459), in the variables u that need no
product with the Jacobian (Hairer & Wanner, Solving Ordinary Differential Equations II, 1996, equation 7.25).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.systems.table import RunTable

_GAMMA = 0.5
# Of each stage: weights of the earlier ones in its states and on the right-hand side, share of the step at which it is,
# and weight of the rates' change with time.
_STAGES = (
    ((), (), 0.0, 0.5),
    ((0.0,), (4.0,), 0.0, 1.5),
    ((2.0, 0.0), (1.0, -1.0), 1.0, 0.0),
    ((2.0, 0.0, 1.0), (1.0, -1.0, -8 / 3), 1.0, 0.0),
)
# Of a state's size, for the Jacobian by central differences: it is so smooth that all steps can be solved for at once.
_NUDGE = 1e-5
_LEAST_SIZE = 1e-6  # of the largest state's size, for one that is 0 and at rest
_TINY = 1e-150  # where all are
_LATER = 1e-4  # of a step, for the rates' change with time: inputs between rows are constant or straight lines

Rates = Callable[[FloatArray, Any], FloatArray]
"""Rate of each state, (n_states, n_samples, n_columns), from states of that shape and the inputs at some time."""

Between = Callable[[Any], Any]
"""Inputs at a share of the gap between two rows: a number, or one for each column of the states."""

Method = Callable[[Rates, Between, FloatArray, Any, Any, FloatArray], FloatArray]
"""A method that takes a step, as `runge_kutta_step`."""


def rosenbrock_step(
    rates: Rates, between: Between, s: FloatArray, begin: Any, length: Any, gap: FloatArray
) -> FloatArray:
    """Return the states after a step of RODAS3 from `s`, (n_states, n_samples, n_columns).

    It is one linear system for each sample and column, solved four times. `begin` and `length` are shares of the `gap`,
    the time from row to row, (1 or n_samples, n_columns): numbers, or one for each column.
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
    for a, c, share, gamma in _STAGES:
        at = _with_weighted(s, a, u)
        rate = rates(at, between(begin + share * length)) if share else first
        right = _with_weighted(step * (rate + gamma * by_time), c, u)
        u.append(inverse[0, 0] * right if n == 1 else np.einsum("ij...,j...->i...", inverse, right))
    return np.where(there, at + u[-1], s)


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


def runge_kutta_step(
    rates: Rates, between: Between, s: FloatArray, begin: Any, length: Any, gap: FloatArray
) -> FloatArray:
    """Return the states after a step of the classical method of fourth order, as `rosenbrock_step` does."""
    width, middle = gap * length, between(begin + 0.5 * length)
    first = rates(s, between(begin))
    second = rates(s + 0.5 * width * first, middle)
    third = rates(s + 0.5 * width * second, middle)
    last = rates(s + width * third, between(begin + length))
    return np.asarray(s + width * (1 / 6 * first + 1 / 3 * second + 1 / 3 * third + 1 / 6 * last))


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
    method: Method
    n_before: IntArray
    gap: IntArray
    begin: FloatArray
    length: FloatArray


@lru_cache(maxsize=16)
def steps_for_table(table: RunTable, max_step: float, *, stiff: bool = False) -> Steps:
    """Return the steps over a table, none longer than `max_step`, in the unit of time.

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
    n_before, gap = np.append(0, np.cumsum(n_steps)), np.repeat(np.arange(len(n_steps)), n_steps)
    share = (np.arange(len(gap)) - n_before[gap]) / n_steps[gap]
    of_runs = (np.repeat(each, len(by_run)) for each in (share, 1.0 / n_steps[gap]))
    method = rosenbrock_step if stiff else runge_kutta_step
    return Steps(table, rows, place, gaps, n_steps, method, n_before, gap, *of_runs)
