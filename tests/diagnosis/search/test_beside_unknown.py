"""What has a name and stands beside something unknown: how probable, if something is unknown at all."""

import math
from types import SimpleNamespace

import pytest

from probewise.diagnosis.prior_odds import PriorOdds
from probewise.diagnosis.search.searched import Evidences, Searched


def test_a_name_stands_beside_what_is_unknown_in_its_share_of_the_evidence():
    """Two hypotheses, nothing named and `lag`, whose evidence and prior odds make them as one to three."""
    prior = PriorOdds()
    more = math.log(3.0) + prior.log_prior_with_unknown(()) - prior.log_prior_with_unknown(("lag",))
    unknown = {(0, (), ()): 10.0, (0, ("lag",), ()): 10.0 + more}
    searched = SimpleNamespace(evidences=Evidences({}, unknown=unknown), prior=prior, certain=())
    assert Searched.effect_probabilities_given_unknown(searched) == pytest.approx({"lag": 0.75})


def test_each_order_of_the_ssf_counts_with_its_own_evidence():
    """A second order 20 nats behind, in which `lag` alone is likely, changes nothing."""
    prior = PriorOdds()
    more = math.log(3.0) + prior.log_prior_with_unknown(()) - prior.log_prior_with_unknown(("lag",))
    unknown = {(1, (), ()): 10.0, (1, ("lag",), ()): 10.0 + more, (2, (), ()): -40.0, (2, ("lag",), ()): -10.0}
    searched = SimpleNamespace(evidences=Evidences({}, unknown=unknown), prior=prior, certain=())
    assert Searched.effect_probabilities_given_unknown(searched) == pytest.approx({"lag": 0.75})


def test_nothing_stands_beside_what_was_not_weighed():
    searched = SimpleNamespace(evidences=Evidences({}), prior=PriorOdds(), certain=())
    assert Searched.effect_probabilities_given_unknown(searched) == {}


def test_what_is_unknown_has_a_noise_too():
    """Of the unknown half, four parts in five have outliers; those of the named half do not count."""
    probabilities = {
        (("unknown",), ("outliers",)): 0.3,
        (("unknown",), ()): 0.1,
        (("arm_knock",), ("correlated_noise", "outliers")): 0.1,
        (("lag",), ("correlated_noise",)): 0.5,
    }
    fits = {(0, ()): SimpleNamespace(log_z=0.0), (0, ("arm_knock",)): SimpleNamespace(log_z=9.0)}
    searched = SimpleNamespace(evidences=Evidences(fits), posterior=SimpleNamespace(probabilities=probabilities))
    beside = Searched.noise_probabilities_given_unknown(searched)
    assert beside == pytest.approx({"outliers": 0.8, "correlated_noise": 0.2})
