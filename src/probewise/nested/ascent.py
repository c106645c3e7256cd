"""Climb from the end of a run to the top of the peak on which its last live points are.

Every generation is drawn from a normal distribution. The best quarter of it gives the mean of the next one, and its
scatter about the old mean the covariance (as in CMA-ES, Hansen & Ostermeier 2001): the distribution stretches along a
direction in which the likelihood keeps rising and narrows along the others. So it follows the arm of a heavy tail, a
hundred times as long as wide, to the middle in some thousand evaluations and without chains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.nested.evaluate import Evaluator, Points
from probewise.nested.repartition import root_of_covariance
from probewise.nested.result import NestedResult
from probewise.nested.space import is_within

_PER_PARAM, _LEAST_DRAWS = 10, 60  # draws of a generation
_BEST = 0.25  # of them
_LEARNT = 0.5  # share of the covariance that a generation replaces
_MOST_GENERATIONS = 80
_LEVEL = 0.02  # nats between the best draws at the top: a gentle slope is followed, too
_AS_DRAWN = 0.2  # nats between the best draws of the distribution that is returned


@dataclass(frozen=True, eq=False)
class Top:
    """The top of a peak: its highest point, and a normal distribution about it of `centre` (n_params,) and `root`.

    `root` is a root of the covariance, (n_params, n_params); where the top is rounded, the best quarter of draws lies
    within 0.2 nats. All in the sampling coordinates.
    """

    highest: Points
    centre: FloatArray
    root: FloatArray

    @property
    def height(self) -> float:
        """Log likelihood of the highest point."""
        return float(self.highest.log_likelihood[0])


def climb_from_end(run: NestedResult, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator) -> Top:
    """Climb from the last live points of a run for `max_calls` evaluations at most, counted by `evaluate`."""
    last = slice(-run.n_live, None)
    start = evaluate.known(run.theta[last], run.log_likelihood[last], run.label[last])
    n_params, highest = start.u.shape[1], start.take(start.order()[-1:])
    centre, covariance = start.u.mean(axis=0), np.atleast_2d(np.cov(start.u, rowvar=False))
    n_draws, spread = max(_PER_PARAM * n_params, _LEAST_DRAWS), math.inf
    n_best, most = int(_BEST * n_draws), evaluate.n_calls + max_calls
    for _ in range(_MOST_GENERATIONS):
        if spread < _LEVEL or evaluate.n_calls + n_draws > most:
            break
        tried = centre + rng.standard_normal((n_draws, n_params)) @ root_of_covariance(covariance).T
        drawn = evaluate(tried[is_within(evaluate.space, tried)], rng)
        best = drawn.take(drawn.order()[::-1][:n_best])
        if not len(best) or best.log_likelihood[-1] == -math.inf:
            covariance = _BEST * covariance
            continue
        off = best.u - centre
        covariance = (1 - _LEARNT) * covariance + _LEARNT * off.T @ off / len(best)
        centre = best.u.mean(axis=0)
        spread = float(np.ptp(best.log_likelihood))
        if best.log_likelihood[0] > highest.log_likelihood[0]:
            highest = best.take(slice(1))
    # About a rounded top heights spread as the covariance.
    wider = _AS_DRAWN / spread if 0 < spread < _AS_DRAWN else 1.0
    return Top(highest, centre, root_of_covariance(wider * covariance))
