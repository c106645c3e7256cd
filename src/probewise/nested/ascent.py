"""Climb to the top of a likelihood peak, for instance from the last live points of a run.

As in CMA-ES (Hansen & Ostermeier 2001), every generation is drawn from a normal distribution. The mean of its best
quarter becomes the next mean, and their scatter about the old mean updates the covariance. The distribution so
stretches along a direction in which the likelihood keeps rising: the arm of a heavy tail, a hundred times as long as
wide, is climbed in some thousand evaluations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.nested.evaluate import Evaluator, Points
from probewise.nested.repartition import covariance_root_of_points, root_of_covariance
from probewise.nested.result import NestedResult
from probewise.nested.space import within_bounds_mask

_PER_PARAM, _LEAST_DRAWS = 10, 60  # draws of a generation
_BEST, _FEWEST_BEST = 0.25, 2  # of them
_LEARNT = 0.3  # share of the covariance that a generation replaces
_MOST_GENERATIONS = 80
_LEVEL = 0.02  # nats between the best draws at the top: a gentle slope is followed, too
_AS_DRAWN = 0.2  # nats between the best draws of the distribution that is returned


@dataclass(frozen=True, eq=False)
class GaussianAtPeak:
    """A normal distribution at a peak of the likelihood: start or end of a climb.

    `centre` is its mean, (n_params,), and `root` @ `root`.T its covariance, (n_params, n_params), in the sampling
    coordinates; `climb_to_top` widens it until the best quarter of draws spans 0.2 nats. `highest`: best point of the
    last generation, or live point; `met`: best point of the whole climb, maybe on another peak; None before a climb.
    """

    highest: Points
    centre: FloatArray
    root: FloatArray
    met: Points | None = None

    @property
    def highest_log_likelihood(self) -> float:
        """Log likelihood of the highest point."""
        return float(self.highest.log_likelihood[0])


def climb_to_top(
    start: GaussianAtPeak, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator, known: float = -math.inf
) -> GaussianAtPeak:
    """Climb from a normal distribution to the top of a peak; return the distribution about the top.

    The climb ends when the best draws differ by less than 0.02 nats, after 80 generations, or before `max_calls`
    evaluations would be exceeded. Draws below the log likelihood `known` are ignored: they may belong to another peak.
    """
    highest, centre, covariance = start.highest, start.centre, start.root @ start.root.T
    met = highest
    n_params = len(centre)
    n_draws, spread = max(_PER_PARAM * n_params, _LEAST_DRAWS), math.inf
    n_best, most = int(_BEST * n_draws), evaluate.n_calls + max_calls
    for _ in range(_MOST_GENERATIONS):
        if spread < _LEVEL or evaluate.n_calls + n_draws > most:
            break
        tried = centre + rng.standard_normal((n_draws, n_params)) @ root_of_covariance(covariance).T
        drawn = evaluate(tried[within_bounds_mask(evaluate.space, tried)], rng)
        best = drawn.take_rows(drawn.rows_by_rising_likelihood()[::-1][:n_best])
        best = best.take_rows(best.log_likelihood > known)
        if len(best) < _FEWEST_BEST:
            covariance = _BEST * covariance
            continue
        off = best.u - centre
        covariance = (1 - _LEARNT) * covariance + _LEARNT * off.T @ off / len(best)
        centre = best.u.mean(axis=0)
        spread = float(np.ptp(best.log_likelihood))
        highest = best.take_rows(slice(1))
        met = max(met, highest, key=lambda one: float(one.log_likelihood[0]))
    # About a rounded top heights spread as the covariance.
    wider = _AS_DRAWN / spread if 0 < spread < _AS_DRAWN else 1.0
    return GaussianAtPeak(highest, centre, root_of_covariance(wider * covariance), met)


def gaussian_of_last_live_points(run: NestedResult, evaluate: Evaluator) -> GaussianAtPeak:
    """Return the mean and covariance of a run's last live points, with the highest of them, to start a climb."""
    last = slice(-run.n_live, None)
    live = evaluate.points_from_known_values(run.theta[last], run.log_likelihood[last], run.label[last])
    return GaussianAtPeak(
        live.take_rows(live.rows_by_rising_likelihood()[-1:]), live.u.mean(axis=0), covariance_root_of_points(live.u)
    )
