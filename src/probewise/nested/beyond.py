"""Look above where a run ended, for a narrow peak that no live point met.

A run ends where its live points can no longer raise log Z, if the likelihood goes on as it did. A narrow peak on a
broad one (a change of phase, Skilling 2006) can hold most of the posterior and begin tens of nats further up, where no
live point has been. Draws from normal distributions at the top of the broad peak (`ascent`) cost no chains: where that
peak is level, a direction towards a narrow one suffices to meet it. A draw that lies higher than the top belongs to
another peak, which ever narrower normal distributions climb; their draws give its mass.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.nested.ascent import Top
from probewise.nested.evaluate import Evaluator, Points
from probewise.nested.result import NestedResult
from probewise.nested.space import is_within

__all__ = ["NOTHING", "Beyond", "look_beyond"]

_FLAT = 0.2  # nats between the best draw and the worst of the best tenth: the top of a peak
_NARROWER = 0.87  # sd of a distribution over that of the one before: with 0.8 a tenth of peaks were a nat too low
_PER_LIVE = 20  # draws of a distribution on the way to the top of another peak
_AT_TOP = (1.25, 1.0, 0.8)  # scales of those at the known top, with as many draws a live point as there are parameters
_SHARE = 1 / 8  # of the run's evaluations, spent where there is no higher peak
_MOST_LEVELS = 60
_MOST_PEAKS = 5


@dataclass(frozen=True)
class Beyond:
    """A higher peak than the run has seen: the log of its evidence, -inf where there is none; evaluations used."""

    log_z: float
    n_calls: int


NOTHING = Beyond(-math.inf, 0)
"""No higher peak, nothing evaluated."""


@dataclass(frozen=True, eq=False)
class _Level:
    """Draws from a normal distribution about `centre` (n_params,), its sds `scale` times those of the live points.

    Of `n_draws` draws those inside the space are `points`.
    """

    centre: FloatArray
    scale: float
    n_draws: int
    points: Points

    @property
    def top(self) -> float:
        """The best log likelihood."""
        return float(self.points.log_likelihood.max(initial=-math.inf))


def look_beyond(
    first: NestedResult, top: Top, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator
) -> Beyond:
    """Look for a peak above the end of a run and estimate its evidence, by order of magnitude.

    Parameters
    ----------
    first
        The run.
    top
        Top of the peak on which it ended.
    evaluate
        Its problem, whose prior has `to_unit_cube` or coordinates of its own.
    max_calls
        Limit of evaluations; without a higher peak at most an eighth of the run's are used.
    rng
        Source of randomness.
    """
    n_before = evaluate.n_calls
    n_draws = int(min(first.n_live * len(evaluate.names), min(max_calls, _SHARE * first.n_calls) / len(_AT_TOP)))
    if n_draws < first.n_live:
        return NOTHING
    levels = [_drawn(evaluate, top.centre, scale, top.root, n_draws, rng) for scale in _AT_TOP]
    # Of several peaks of about one height the climb took one, and the run knows the others.
    log_z, known = -math.inf, max(top.height, float(first.log_likelihood.max())) + _FLAT
    for _ in range(_MOST_PEAKS):
        highest = max(levels, key=lambda level: level.top)
        if not highest.top > known:
            break
        levels = _climbed(
            evaluate,
            highest.points.u[int(highest.points.log_likelihood.argmax())],
            highest.scale,
            top.root,
            known,
            n_draws=first.n_live * _PER_LIVE,
            max_calls=n_before + max_calls,
            rng=rng,
        )
        log_z, known = max(log_z, _evidence(levels, top.root)), max(known, levels[-1].top + _FLAT)
    return Beyond(log_z, evaluate.n_calls - n_before)


def _climbed(
    evaluate: Evaluator,
    centre: FloatArray,
    scale: float,
    root: FloatArray,
    known: float,
    *,
    n_draws: int,
    max_calls: int,
    rng: np.random.Generator,
) -> list[_Level]:
    """Draw from ever narrower distributions, each about the best tenth of the one before, until these are level.

    Only draws above the log likelihood `known`, the top of the other peaks, count among the best: near a narrow peak
    most belong to a broad one.
    """
    levels = list[_Level]()
    while True:
        levels.append(_drawn(evaluate, centre, scale, root, n_draws, rng))
        found = levels[-1].points
        best = found.order()[-n_draws // 10 :]
        height = found.log_likelihood[best]
        above = height > known
        if not len(best) or (above.all() and float(np.ptp(height)) < _FLAT):
            return levels
        if len(levels) == _MOST_LEVELS or evaluate.n_calls + n_draws > max_calls:
            return levels
        centre = found.u[best[above]].mean(axis=0) if above.any() else centre
        scale *= _NARROWER


def _drawn(
    evaluate: Evaluator, centre: FloatArray, scale: float, root: FloatArray, n_draws: int, rng: np.random.Generator
) -> _Level:
    """Draw and evaluate; draws outside the space count without points."""
    tried = centre + scale * rng.standard_normal((n_draws, len(centre))) @ root.T
    return _Level(centre, scale, n_draws, evaluate(tried[is_within(evaluate.space, tried)], rng))


def _evidence(levels: list[_Level], root: FloatArray) -> float:
    """Estimate log Z by importance sampling: all draws together come from a mixture of normal distributions."""
    drawn = Points.join(*(level.points for level in levels))
    inverse, n_params = np.linalg.inv(root), root.shape[0]
    log_q = np.full(len(drawn), -np.inf)
    for level in levels:
        square = (((drawn.u - level.centre) @ inverse.T / level.scale) ** 2).sum(axis=1)
        log_q = np.logaddexp(log_q, math.log(level.n_draws) - 0.5 * square - n_params * math.log(level.scale))
    log_q -= float(np.linalg.slogdet(root)[1]) + 0.5 * n_params * math.log(2 * math.pi)
    return float(logsumexp(drawn.log_density + drawn.log_likelihood - log_q))
