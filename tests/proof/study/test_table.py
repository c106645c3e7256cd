"""What is said of many runs: numbers with errors that hold."""

import math

import numpy as np
import pytest
from scipy.stats import chi2, poisson

from probewise.errors import ParameterError
from probewise.proof.campaign import estimated_share
from probewise.proof.study import SearchConfiguration, summarise

from ..conftest import search


def trial(readings, **others):
    return search(
        readings, **{"first_white": 3, "bits": 20.0, "chance_wrong": 1e-3, "held": [True, True, False], **others}
    )


@pytest.mark.parametrize(("k", "n"), [(0, 50), (1, 7), (89, 100), (200, 200)])
def test_a_share_has_wilsons_interval(k, n):
    """Its ends are as many standard errors of theirs from the share as 95 % of a normal distribution (Wilson 1927)."""
    found, z2 = estimated_share([True] * k + [False] * (n - k)), chi2.ppf(0.95, 1)
    ends = np.roots([1 + z2 / n, -2 * k / n - z2 / n, (k / n) ** 2])
    assert (found.value, found.low, found.high) == pytest.approx((k / n, min(ends), max(ends)), abs=1e-12)


def test_a_miss_counts_as_the_limit_and_says_nothing_of_what_comes_after_white():
    found = summarise([trial(8), trial(14), trial(100, reached=False, first_white=None)], max_readings=100)
    assert found.mean.value == pytest.approx((8 + 14 + 100) / 3)
    assert found.median.value == 14
    assert found.after_white.value == pytest.approx((5 + 11) / 2)
    assert found.to_white.value == pytest.approx((3 + 3 + 100) / 3)
    assert found.reached.value == pytest.approx(2 / 3)
    assert found.held.value == pytest.approx(2 / 3)
    assert found.bits_each.value == pytest.approx(np.mean([20 / 8, 20 / 14, 0.2]))


def test_runs_that_are_sure_and_wrong_are_held_against_what_their_posteriors_expect():
    runs = [trial(9) for _ in range(997)] + [trial(9, error_mm=13.0) for _ in range(3)]
    found = summarise(runs, max_readings=100)
    assert found.wrong == 3
    assert found.wrong_expected == pytest.approx(1.0)
    assert poisson.sf(found.wrong_limit, 1.0) <= 0.01 < poisson.sf(found.wrong_limit - 1, 1.0)


def test_the_medians_interval_holds_it_as_often_as_it_says():
    """Distribution-free, so any skewed one will do: at least 95 of 100, over 400 tables of 41 runs."""
    rng = np.random.default_rng(4)
    draws = np.ceil(rng.lognormal(2.5, 0.8, (400, 41)))
    true = math.ceil(math.exp(2.5))
    tables = [summarise([trial(int(n)) for n in np.clip(row, 4, 1e6)], max_readings=10**6).median for row in draws]
    held = np.mean([t.low <= true <= t.high for t in tables])
    assert held > 0.95 - 4 * math.sqrt(0.95 * 0.05 / 400)


def test_one_run_has_no_error():
    with pytest.raises(ParameterError, match="2 or more"):
        summarise([trial(8)], max_readings=100)


@pytest.mark.parametrize(
    "wrong", [{"population": "outside"}, {"model": "best"}, {"utility": "luck"}, {"noise_sd": 0.0}, {"width": -1.0}]
)
def test_rows_that_mean_nothing_are_refused(wrong):
    with pytest.raises(ParameterError, match=next(iter(wrong))):
        SearchConfiguration(**wrong)
