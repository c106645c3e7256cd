"""Look above where a run ended, for a narrow peak that no live point met.

A run ends where its live points can no longer raise log Z, if the likelihood goes on as it did. A narrow peak on a
broad one (a change of phase, Skilling 2006) can hold most of the posterior and begin tens of nats further up, where no
live point has been. Draws from ever narrower normal distributions about the last live points cost no chains and reach
the top of the broad peak. A draw that lies higher than this top belongs to another peak, whose mass is estimated in
the same way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.nested.evaluate import Evaluator, Points, Samplable
from probewise.nested.repartition import principal_root
from probewise.nested.result import NestedResult

__all__ = ["NOTHING", "Beyond", "look_beyond"]

_FLAT = 0.2  # nats between the best draw and the worst of the best tenth: the top of a peak
_NARROWER = 0.8  # sd of a distribution over that of the one before
_DRAWS_PER_LIVE = 20
_SHARE = 1 / 5  # of the run's evaluations, spent where there is no higher peak
_MOST_LEVELS = 60
_MOST_PEAKS = 5
_LEVELS_TO_MEET = 3  # after which the draws must lie where the live points do: they do not about a curved ridge


@dataclass(frozen=True)
class Beyond:
    """A higher peak than the run has seen: the log of its evidence, -inf where there is none; evaluations used."""

    log_z: float
    n_calls: int


NOTHING = Beyond(-math.inf, 0)
"""No higher peak, nothing evaluated."""


@dataclass(frozen=True, eq=False)
class _Level:
    """Draws from a normal distribution about `centre` (n_params,), its sds `scale` times those of the live points."""

    centre: FloatArray
    scale: float
    points: Points

    @property
    def top(self) -> float:
        """The best log likelihood."""
        return float(self.points.log_likelihood.max(initial=-math.inf))


def look_beyond(first: NestedResult, problem: Samplable, *, max_calls: int, rng: np.random.Generator) -> Beyond:
    """Look for a peak above the end of a run and estimate its evidence, by order of magnitude.

    Parameters
    ----------
    first
        The run.
    problem
        Its problem, whose prior has `to_unit_cube` or coordinates of its own.
    max_calls
        Limit of evaluations; without a higher peak at most a fifth of the run's are used.
    rng
        Source of randomness.
    """
    evaluate = Evaluator(problem)
    n_draws = _DRAWS_PER_LIVE * first.n_live
    most = min(max_calls, int(_SHARE * first.n_calls))
    if most < n_draws:
        return NOTHING
    u = evaluate.space.enter(first.theta[-first.n_live :])
    root, centre, scale, log_z = principal_root(u), u.mean(axis=0), 1.0, -math.inf
    lowest = float(first.log_likelihood[-first.n_live])
    for peak in range(_MOST_PEAKS):
        levels = _climb(
            evaluate, centre, scale, root, lowest, n_draws=n_draws, max_calls=max_calls if peak else most, rng=rng
        )
        if peak:
            log_z = max(log_z, _evidence(levels, root, n_draws))
        highest = max(levels, key=lambda level: level.top)
        if not highest.top > levels[-1].top + _FLAT:
            break
        centre, scale = highest.points.u[int(highest.points.log_likelihood.argmax())], highest.scale
    return Beyond(log_z, evaluate.n_calls)


def _climb(
    evaluate: Evaluator,
    centre: FloatArray,
    scale: float,
    root: FloatArray,
    lowest: float,
    *,
    n_draws: int,
    max_calls: int,
    rng: np.random.Generator,
) -> list[_Level]:
    """Draw from ever narrower distributions, each about the best tenth of the one before, until these are level.

    `lowest` is the log likelihood of the worst live point.
    """
    space, levels = evaluate.space, list[_Level]()
    while True:
        tried = centre + scale * rng.standard_normal((n_draws, len(centre))) @ root.T
        found = evaluate(tried[((tried > space.low) & (tried < space.high)).all(axis=1)], rng)
        levels.append(_Level(centre, scale, found))
        best = found.order()[-n_draws // 10 :]
        height = found.log_likelihood[best]
        if not len(best) or float(np.ptp(height)) < _FLAT:
            return levels
        if len(levels) >= _LEVELS_TO_MEET and float(np.median(height)) < lowest:
            return levels
        if len(levels) == _MOST_LEVELS or evaluate.n_calls + n_draws > max_calls:
            return levels
        centre, scale = found.u[best].mean(axis=0), scale * _NARROWER


def _evidence(levels: list[_Level], root: FloatArray, n_draws: int) -> float:
    """Estimate log Z by importance sampling: all draws together come from a mixture of normal distributions."""
    drawn = Points.join(*(level.points for level in levels))
    inverse, n_params = np.linalg.inv(root), root.shape[0]
    log_q = np.full(len(drawn), -np.inf)
    for level in levels:
        square = (((drawn.u - level.centre) @ inverse.T / level.scale) ** 2).sum(axis=1)
        log_q = np.logaddexp(log_q, -0.5 * square - n_params * math.log(level.scale))
    log_q -= float(np.linalg.slogdet(root)[1]) + 0.5 * n_params * math.log(2 * math.pi)
    return float(logsumexp(drawn.log_density + drawn.log_likelihood - log_q)) - math.log(n_draws)
