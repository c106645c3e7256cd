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


@dataclass(frozen=True, eq=False)
class RowsInRuns:
    """The rows of a table by position in its runs, for stepping all runs together; short runs repeat their last row.

    Raises
    ------
    ParameterError
        On first use, if time decreases within a run.
    """

    table: RunTable

    @cached_property
    def row_by_position_and_run(self) -> IntArray:
        """Row of the table at each position of each run, (n_places, n_runs); after its end, a run's last row."""
        self.table.require_rising_time()
        by_run = self.table.rows_by_scan()
        longest = max(len(rows) for rows in by_run)
        return np.stack([np.append(rows, np.full(longest - len(rows), rows[-1])) for rows in by_run], axis=1)

    @cached_property
    def gaps(self) -> FloatArray:
        """Time from each position to the next, (n_places - 1, n_runs), in the unit of time."""
        return np.diff(self.table.time_s[self.row_by_position_and_run], axis=0)

    @property
    def typical_gap(self) -> float:
        """Median time between two rows of a run that are not at the same time; 1 without any."""
        return float(np.median(self.gaps[self.gaps > 0])) if (self.gaps > 0).any() else 1.0

    @cached_property
    def position_and_run_by_row(self) -> tuple[IntArray, IntArray]:
        """Position in its run, and number of its run, of each row, (n_points,) each."""
        place = np.empty(len(self.table), dtype=np.int64)
        for rows in self.table.rows_by_scan():
            place[rows] = np.arange(len(rows))
        return place, self.table.scan


Rates = Callable[[Mapping[str, Any], Any], Mapping[str, Any]]
"""Rate of each state, from states (n_samples, n_runs) and a share of the gap between two rows."""


@dataclass(frozen=True)
class Rosenbrock:
    """The method RODAS; one step is one linear system for each sample and run, solved six times."""

    def n_evaluations(self, n_states: int) -> int:
        """Return about how many evaluations of the rates a step costs, its linear algebra included."""
        return 2 * len(_ALPHA) + 2 * n_states + 1

    def advanced(self, rates: Rates, s: Mapping[str, Any], begin: Any, length: Any, gap: FloatArray) -> dict[str, Any]:
        """Return the states after a step.

        Parameters
        ----------
        rates
            The law's rates.
        s
            States at the beginning by name, (n_samples, n_runs) each.
        begin, length
            Where the step begins and how long it is, as shares of the gap: numbers, or one for each run.
        gap
            Time from row to row, (1 or n_samples, n_runs).
        """
        names, shape = list(s), np.broadcast_shapes(gap.shape, *(np.shape(values) for values in s.values()))
        n = len(names)
        width = np.broadcast_to(gap * length, shape)
        there = width > 0  # runs that ended stand still
        step = np.where(there, width, 1.0)

        def rates_at(states: FloatArray, share: Any) -> FloatArray:
            found = rates(dict(zip(names, states, strict=True)), share)
            out = np.empty_like(states)
            for k, name in enumerate(names):
                out[k] = found[name]
            return out

        start = np.empty((n, *shape))
        for k, name in enumerate(names):
            start[k] = s[name]
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
    """Return a value plus the weighted sum of terms."""
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


@dataclass(frozen=True, eq=False)
class Steps:
    """Integration steps over a table, each taken in all runs together; position k is the k-th row of every run.

    No step is longer than `max_step`, in the unit of time, at fourth order. The method is linearly implicit if `stiff`,
    else explicit.
    """

    places: RowsInRuns
    max_step: float
    stiff: bool = False

    @cached_property
    def schedule(self) -> StepSchedule:
        """Number of steps from each row of a run to the next, the same in all runs, and the method."""
        longest = self.places.gaps.max(axis=1, initial=0.0)
        n_steps = np.asarray(np.maximum(np.ceil(longest / self.max_step - 1e-9), 1), dtype=np.int64)
        return StepSchedule(n_steps, RODAS) if self.stiff else StepSchedule.from_fourth_order_steps(n_steps)

    @cached_property
    def gap_of_step(self) -> IntArray:
        """Number of the gap in which each step lies, (n_steps,); gap k is between rows k and k + 1 of every run."""
        return np.repeat(np.arange(len(self.schedule.n_steps)), self.schedule.n_steps)

    @cached_property
    def n_steps_before_position(self) -> IntArray:
        """Number of steps from the first row of a run to its row at each position, (n_places,)."""
        return np.concatenate([[0], np.cumsum(self.schedule.n_steps)])

    @property
    def n_runs(self) -> int:
        """Number of runs."""
        return int(self.places.row_by_position_and_run.shape[1])

    @cached_property
    def begin_share_of_gap(self) -> FloatArray:
        """Share of its gap between rows at which each step begins, (n_steps * n_runs,), ordered by step, then run."""
        gap = self.gap_of_step
        share = (np.arange(len(gap)) - self.n_steps_before_position[gap]) / self.schedule.n_steps[gap]
        return np.repeat(share, self.n_runs)

    @cached_property
    def length_share_of_gap(self) -> FloatArray:
        """Share of its gap between rows that each step takes, (n_steps * n_runs,), ordered by step, then run."""
        return np.repeat(1.0 / self.schedule.n_steps[self.gap_of_step], self.n_runs)

    def states_at_rows(self, states: FloatArray) -> FloatArray:
        """Select states (n_states, n_samples, n_steps + 1, n_runs) at every row: (n_states, n_samples, n_points)."""
        place, run = self.places.position_and_run_by_row
        return np.asarray(states[:, :, self.n_steps_before_position[place], run])


@lru_cache(maxsize=16)
def steps_for_table(table: RunTable, max_step: float, *, stiff: bool = False) -> Steps:
    """Return the `Steps` of an integration over a table."""
    return Steps(RowsInRuns(table), max_step, stiff)
