"""Noise with memory given other readings, and outlying readings beside a random walk."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from probewise.diagnosis.evidence import predictive_log_densities
from probewise.diagnosis.noise import NoiseLaw, innovations_given_rest, walk_given_readings, with_known_wide_readings

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


N = 9
OWN_SD = np.array([1.0, 0.7, 1.3, 1.0, 1.0, 0.8, 1.0, 1.2, 1.0])


def _law(share, times, step, sd=OWN_SD):
    n = len(sd)
    return NoiseLaw(sd, np.zeros(n), np.zeros(n, dtype=bool), share, times, walk=np.full(n, step**2))


def _covariance(law, sigma, wide):
    walked = np.cumsum(law.walk)
    return sigma**2 * (np.minimum.outer(walked, walked) + np.diag((law.sd * np.where(wide, law.times, 1.0)) ** 2))


def _by_enumeration(law, residuals, sigma):
    """Return the log density of residuals and each reading's probability to be wide, from all 2^n sets of those."""
    kept = ~law.lost
    sets = np.array(list(itertools.product((False, True), repeat=int(kept.sum()))))
    log_p = []
    for some in sets:
        wide = np.zeros(len(kept), dtype=bool)
        wide[kept] = some
        own = _covariance(law, sigma, wide)[np.ix_(kept, kept)]
        log_prior = some.sum() * math.log(law.share) + (~some).sum() * math.log1p(-law.share)
        log_p.append(log_prior + multivariate_normal.logpdf(residuals[kept], cov=own))
    total = float(logsumexp(log_p))
    out = np.zeros(len(kept))
    out[kept] = np.exp(np.array(log_p) - total) @ sets
    return total, out


def _draw(law, rng):
    wide = rng.random(N) < 0.2
    return np.cumsum(np.sqrt(law.walk) * rng.normal(size=N)) + law.sd * rng.normal(size=N) * np.where(
        wide, law.times, 1.0
    )


@pytest.mark.parametrize(
    ("share", "times", "step"), [(0.05, 20.0, 0.6), (0.1, 3.0, 1.0), (0.05, 20.0, 2.0), (0.2, 10.0, 0.2)]
)
def test_the_evidence_is_the_sum_over_all_sets_of_wide_readings(share, times, step):
    rng = np.random.default_rng(0)
    lost = np.arange(N) == 4
    for case in range(8):
        law = replace(_law(share, times, step), lost=lost if case % 2 else np.zeros(N, dtype=bool))
        residuals = 0.3 * _draw(law, rng)
        known = with_known_wide_readings([law], residuals)[0]
        whitened = known(residuals)[:, None]
        sigma = known.likeliest_sigma(whitened)
        log_density = -float(known.minus_log_likelihood(whitened, sigma)[0]) - 0.5 * known.n_kept * math.log(
            2 * math.pi
        )
        wanted, wide = _by_enumeration(law, residuals, float(sigma[0]))
        assert log_density - known.half_log_det() + known.log_extra == pytest.approx(wanted, abs=0.06)
        np.testing.assert_allclose(known.wide, wide, atol=0.05)


@pytest.mark.parametrize("far", [1e200, np.inf, np.nan])
def test_predictions_that_ran_away_are_no_error(far):
    law = with_known_wide_readings([_law(0.05, 10.0, 0.5)], np.full(N, far))[0]
    assert law.whitened_density.is_normal


def test_a_held_out_reading_is_wide_or_narrow_by_prior_not_by_what_it_reads():
    """Its density given the rest is a mixture of both, so that an outlier costs the logarithm of its share."""
    rng = np.random.default_rng(3)
    law = _law(0.05, 20.0, 0.6)
    residuals = np.cumsum(0.6 * rng.normal(size=N)) + law.sd * rng.normal(size=N)
    residuals[5] += 30.0
    known = with_known_wide_readings([law], residuals)[0]
    out = np.arange(N) == 5
    slopes = np.zeros((N, 1))
    own = predictive_log_densities(known, out, residuals, slopes, np.zeros(1), np.eye(1), 1.0)
    # The other readings are plainly narrow: the density from dense covariances, with reading 5 narrow and wide.
    rest = ~out
    parts = []
    for wide, share in ((out, law.share), (out & False, 1 - law.share)):
        covariance = _covariance(law, 1.0, wide)
        gain = np.linalg.solve(covariance[np.ix_(rest, rest)], covariance[rest][:, out])
        mean, variance = residuals[rest] @ gain[:, 0], covariance[5, 5] - covariance[out][:, rest][0] @ gain[:, 0]
        parts.append(
            math.log(share) - 0.5 * math.log(2 * math.pi * variance) - 0.5 * (residuals[5] - mean) ** 2 / variance
        )
    assert float(own[0]) == pytest.approx(float(logsumexp(parts)), abs=0.1)
