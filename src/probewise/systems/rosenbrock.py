"""A linearly implicit Runge-Kutta (Rosenbrock) method for stiff laws: RODAS, of fourth order and L-stable.

Source: Hairer & Wanner, Solving Ordinary Differential Equations II, 1996, section IV.7 and its program RODAS, in the
variables u that need no product with the Jacobian (equation 7.25).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from probewise._arrays import FloatArray

Rates = Callable[[Mapping[str, Any], Any], Mapping[str, Any]]
"""Rate of each state, from states (n_samples, n_runs) and a share of the gap between two rows."""

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
