"""Noise with memory: what readings tell of the noise of others, against dense covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probewise.diagnosis.noise_law import NoiseLaw
from probewise.diagnosis.noise_memory import innovations_given_rest, walk_given_readings, with_known_wide_readings

_N = 40


def _laws():
    rng = np.random.default_rng(1)
    sd, lost = rng.uniform(0.5, 2.0, _N), np.zeros(_N, dtype=bool)
    lost[[3, 17, 29]] = True
    walk = rng.uniform(0.05, 2.0, _N)
    of_walk = np.minimum.outer(np.cumsum(walk), np.cumsum(walk)) + np.diag(sd**2)
    # Two runs whose rows alternate, the second from row 2 on.
    run = np.arange(_N) % 2
    apart = np.abs(np.subtract.outer(np.arange(_N) // 2, np.arange(_N) // 2))
    of_runs = np.where(np.equal.outer(run, run), (-0.6) ** apart, 0.0) * np.outer(sd, sd)
    of_one = 0.8 ** np.abs(np.subtract.outer(np.arange(_N), np.arange(_N))) * np.outer(sd, sd)
    nothing = np.zeros(_N)
    carry = np.where(np.arange(_N) > 1, -0.6, 0.0)
    return {
        "walk": (NoiseLaw(sd, nothing, lost, walk=walk), of_walk),
        "ar": (NoiseLaw(sd, np.where(np.arange(_N) > 0, 0.8, 0.0), np.zeros(_N, dtype=bool)), of_one),
        "ar in two runs": (
            NoiseLaw(sd, carry, np.zeros(_N, dtype=bool), before=np.maximum(np.arange(_N) - 2, 0)),
            of_runs,
        ),
        "white": (NoiseLaw(sd, nothing, lost), np.diag(sd**2)),
    }


_MASKS = {
    "block": (np.arange(_N) >= 12) & (np.arange(_N) < 25),
    "end": np.arange(_N) >= 30,
    "start": np.arange(_N) < 9,
    "scattered": np.arange(_N) % 3 == 1,
    "all": np.ones(_N, dtype=bool),
}


@pytest.mark.parametrize("name", ["walk", "ar", "ar in two runs", "white"])
@pytest.mark.parametrize("mask", list(_MASKS))
def test_the_innovations_given_the_rest_have_the_conditional_density(name, mask):
    law, covariance = _laws()[name]
    asked, seen = _MASKS[mask], ~law.lost
    columns = np.random.default_rng(2).normal(size=(_N, 3))
    whitened, sd = innovations_given_rest(law, columns, asked)
    own, given = asked & seen, ~asked & seen
    gain = np.linalg.solve(covariance[np.ix_(given, given)], covariance[np.ix_(given, own)]).T
    left = columns[own] - gain @ columns[given]
    spread = covariance[np.ix_(own, own)] - gain @ covariance[np.ix_(given, own)]
    np.testing.assert_allclose(whitened.T @ whitened, left.T @ np.linalg.solve(spread, left), rtol=1e-9)
    assert np.log(sd).sum() == pytest.approx(0.5 * np.linalg.slogdet(spread)[1])
    assert (whitened[law.lost[asked]] == 0).all()


def test_each_reading_is_told_by_the_rest_and_by_those_before_it():
    law, covariance = _laws()["walk"]
    asked = _MASKS["block"]
    columns = np.random.default_rng(3).normal(size=(_N, 1))
    whitened, sd = innovations_given_rest(law, columns, asked)
    for place, k in enumerate(np.flatnonzero(asked)):
        known = ~law.lost & (~asked | (np.arange(_N) < k))
        if law.lost[k]:
            continue
        gain = np.linalg.solve(covariance[np.ix_(known, known)], covariance[known, k])
        assert sd[place] ** 2 == pytest.approx(covariance[k, k] - gain @ covariance[known, k])
        assert whitened[place, 0] * sd[place] == pytest.approx(columns[k, 0] - gain @ columns[known, 0])


def test_readings_left_out_of_a_chain_hand_their_correlation_on():
    """0.8 over one reading, 0.64 over two: `take_readings` keeps the covariance of those that it takes."""
    for name in ("ar", "ar in two runs", "walk"):
        law, covariance = _laws()[name]
        kept = ~_MASKS["block"] & (np.arange(_N) % 7 != 0) & ~law.lost
        taken, own = law.take_readings(kept), covariance[np.ix_(kept, kept)]
        r = np.random.default_rng(4).normal(size=kept.sum())
        assert np.sum(taken(r) ** 2) == pytest.approx(r @ np.linalg.solve(own, r))
        assert taken.half_log_det() == pytest.approx(0.5 * np.linalg.slogdet(own)[1])


def test_the_smoothed_walk_is_its_conditional_mean():
    law, covariance = _laws()["walk"]
    seen = ~law.lost
    residuals = np.random.default_rng(5).normal(size=_N)
    of_walk = covariance - np.diag(law.sd**2)
    expected = of_walk[:, seen] @ np.linalg.solve(covariance[np.ix_(seen, seen)], residuals[seen])
    np.testing.assert_allclose(walk_given_readings(law, residuals), expected)
    assert not walk_given_readings(_laws()["ar"][0], residuals).any()


def test_an_outlying_reading_does_not_pull_the_smoothed_walk():
    walk = 0.05 * np.cumsum(np.random.default_rng(6).normal(size=200))
    residuals = walk + np.random.default_rng(7).normal(size=200)
    residuals[100] += 30.0
    nothing = np.zeros(200)
    plain = NoiseLaw(nothing + 1, nothing, nothing > 0, walk=np.full(200, 0.05**2))
    tailed = with_known_wide_readings(replace(plain, share=0.05, times=10.0), residuals)
    assert abs(walk_given_readings(tailed, residuals)[100] - walk[100]) < 0.5
    assert walk_given_readings(plain, residuals)[100] - walk[100] > 0.5
