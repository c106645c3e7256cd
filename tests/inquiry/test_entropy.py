"""The entropy of predicted readings, against counting by hand and the paper's partition."""

from collections import Counter
from dataclasses import dataclass
from math import log2

import numpy as np
import pytest

from probewise.errors import ParameterError, ReachError
from probewise.inquiry import Grid, ReadingEntropy, choose, entropy_map


@dataclass(frozen=True)
class PointSensor:
    """Reads 10 outside and 60 inside a circle: the naive model."""

    names: tuple[str, ...] = ("x_mm", "y_mm", "radius_mm")

    def predict(self, theta, plan):
        away = np.hypot(plan.x_mm - theta[:, 0:1], plan.y_mm - theta[:, 1:2])
        return np.where(away <= theta[:, 2:3], 60.0, 10.0)


def circles(n, seed=0):
    rng = np.random.default_rng(seed)
    return np.stack([rng.uniform(200, 800, n), rng.uniform(100, 400, n), rng.uniform(20, 150, n)], axis=1)


def counted_entropy(column):
    """Count with a Counter, sum p log2 p."""
    shares = [count / len(column) for count in Counter(column).values()]
    return -sum(p * log2(p) for p in shares)


def test_the_entropy_is_that_of_counting_each_place_by_itself(made):
    predicted = np.random.default_rng(1).normal(30.0, 4.0, (50, 40))
    expected = [counted_entropy(np.rint(column).tolist()) for column in predicted.T]
    np.testing.assert_allclose(ReadingEntropy()(made.listed(predicted)), expected, atol=1e-12)


def test_the_next_place_is_drawn_evenly_among_those_that_tie():
    """Four places within the tie of 1e-9, 4000 draws: chi-square below its 1e-6 quantile."""
    utility = np.array([0.3, 1.0, 1.0 - 5e-10, 0.9, 1.0, 1.0, 1.0 - 1e-6])
    reachable = np.ones(7, bool)
    rng = np.random.default_rng(3)
    counts = np.bincount([choose(utility, reachable, rng=rng) for _ in range(4000)], minlength=7)
    assert set(np.flatnonzero(counts)) == {1, 2, 4, 5}
    assert ((counts[[1, 2, 4, 5]] - 1000) ** 2 / 1000).sum() < 30.7


def test_only_places_within_reach_are_chosen_or_asked():
    grid = Grid()
    reachable = grid.places_mm[:, 0] > 900.0
    seen = []

    @dataclass(frozen=True)
    class Watched(PointSensor):
        def predict(self, theta, plan):
            seen.append(plan.x_mm.min())
            return super().predict(theta, plan)

    result = entropy_map(Watched(), circles(50), grid, grid.plan("field"), reachable=reachable)
    assert min(seen) > 900.0
    assert grid.places_mm[choose(result.values, result.reachable, rng=np.random.default_rng(4)), 0] > 900.0
    assert (result.values[~reachable] == 0).all()
    assert np.isnan(result.image).sum() == (~reachable).sum()


def test_a_field_out_of_reach_is_an_error_that_says_so():
    grid = Grid(n_x=5, n_y=4)
    with pytest.raises(ReachError, match=r"reachable places is 0; allowed: at least one of the 20 places"):
        entropy_map(PointSensor(), circles(5), grid, grid.plan("f"), reachable=np.zeros(20, bool))


def test_predictions_that_are_not_finite_are_refused(made):
    with pytest.raises(ParameterError, match="finite"):
        ReadingEntropy()(made.listed([[1.0, np.nan]]))
