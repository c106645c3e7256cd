"""Draw above a bound from balls about the live points: few parameters, many points at once (Buchner 2016)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.nested.evaluate import Bound, Evaluator, Points
from probewise.nested.moves import SliceMove, Tally

__all__ = ["FriendsMove"]

_N_ROUNDS = 25  # of leaving points out, to learn how far apart friends may be


@dataclass(frozen=True)
class FriendsMove:
    """Draw evenly from the union of balls about the live points, keep what lies above the bound.

    The balls are round in the metric of the live points, and so large that live points left
    out at random (bootstrap) always had a friend within the radius: the union then covers what
    is above the bound, whatever its form, in one piece or several. New points do not depend on
    where a chain began, and all are evaluated together, which for two or three parameters takes
    a tenth of the time of chains; with many parameters balls become wasteful. Where fewer than
    one candidate in `patience` lies above the bound, chains of `otherwise` draw what is missing.
    """

    patience: float = 30.0
    otherwise: SliceMove = SliceMove()

    def __post_init__(self) -> None:
        if not self.patience >= 1:
            raise ParameterError("patience", self.patience, "1 or more")

    def draw(
        self, start: Points, bound: Bound, live: FloatArray, evaluate: Evaluator, rng: np.random.Generator
    ) -> tuple[Points, Tally]:
        """Return as many points as `start` has; see `Move`."""
        wanted, n_params = start.u.shape
        centre, root = live.mean(axis=0), _root(live)
        friends = np.linalg.solve(root, (live - centre).T).T
        radius = _radius(friends, rng)
        parts: list[Points] = []
        found = n_evaluated = 0
        share = 0.3
        while found < wanted and n_evaluated < self.patience * wanted:
            aim = int(1.2 * (wanted - found) / share) + 8
            u = centre + _in_balls(friends, radius, aim, rng) @ root.T
            u = u[((u >= 0.0) & (u <= 1.0)).all(axis=1)]
            if len(u) == 0:
                n_evaluated += 1  # balls that stick out of the cube altogether must not keep us here
                continue
            tried = evaluate(u, rng)
            kept = tried.take(bound.admits(tried.log_likelihood, tried.label))
            parts.append(kept)
            found += len(kept)
            n_evaluated += len(u)
            share = max(found, 0.5) / n_evaluated
        if found < wanted:
            rest, tally = self.otherwise.draw(start.take(slice(found, wanted)), bound, live, evaluate, rng)
            return Points.join(*parts, rest), Tally(n_evaluated + tally.n_evaluated, wanted, tally.n_stuck)
        return Points.join(*parts).take(slice(wanted)), Tally(n_evaluated, wanted)

    def adapted(self, tally: Tally) -> FriendsMove:
        """Return itself: the radius is learnt anew in every draw."""
        return self


def _root(live: FloatArray) -> FloatArray:
    """Cholesky root of the live points' covariance, (n_params, n_params)."""
    covariance = np.atleast_2d(np.cov(live, rowvar=False))
    return np.asarray(np.linalg.cholesky(covariance + np.diag(1e-10 * np.diag(covariance) + 1e-30)))


def _radius(friends: FloatArray, rng: np.random.Generator) -> float:
    """Greatest distance of a point left out to its nearest friend, over `_N_ROUNDS` bootstraps, (n, n_params)."""
    n = len(friends)
    square = _square_distances(friends, friends)
    kept = np.zeros((_N_ROUNDS, n), dtype=bool)
    kept[np.arange(_N_ROUNDS)[:, None], rng.integers(n, size=(_N_ROUNDS, n))] = True
    nearest = np.array([square[:, rows].min(axis=1) for rows in kept])
    return float(np.sqrt(max(float(nearest[~kept].max(initial=0.0)), 1e-12)))


def _in_balls(friends: FloatArray, radius: float, aim: int, rng: np.random.Generator) -> FloatArray:
    """Draw about `aim` points evenly from the union of balls: (about aim, n_params)."""
    n, n_params = friends.shape
    overlap = float((_square_distances(friends, friends) <= radius**2).sum(axis=1).mean())
    n_tried = int(aim * overlap) + 1
    direction = rng.standard_normal((n_tried, n_params))
    direction /= np.sqrt((direction**2).sum(axis=1, keepdims=True))
    point = friends[rng.integers(n, size=n_tried)]
    point = point + radius * rng.random((n_tried, 1)) ** (1.0 / n_params) * direction
    # A place that k balls share is drawn k times too often.
    n_balls = (_square_distances(point, friends) <= radius**2 * (1 + 1e-9)).sum(axis=1)
    return np.asarray(point[rng.random(n_tried) * n_balls < 1.0])


def _square_distances(a: FloatArray, b: FloatArray) -> FloatArray:
    """Squared distances, (n_a, n_params), (n_b, n_params) -> (n_a, n_b)."""
    square = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1) - 2.0 * a @ b.T
    return np.asarray(np.maximum(square, 0.0))
