"""Probabilities from hand-made evidences."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest

from probewise.diagnosis.prior_odds import PriorOdds
from probewise.diagnosis.search.searched import Evidences, Searched, posterior_of

PRIOR = PriorOdds(n_named=2, n_unnamed=0, n_noises=1)


class Fit(SimpleNamespace):
    """As much of a weighed fit as its evidence."""

    def with_log_evidence_shifted(self, by):
        return Fit(evidence={k: SimpleNamespace(log_z=e.log_z + by) for k, e in self.evidence.items()})


def fit(log_z):
    return Fit(evidence={(): SimpleNamespace(log_z=log_z)})


EVIDENCES = Evidences(
    fits={(1, ()): fit(0.0), (2, ()): fit(math.log(3.0)), (1, ("lag",)): fit(5.0)},
    screened={(("backlash",), ()): 2.0},
    unknown={(1, (), ()): 1.0},
)


def posterior(evidences=EVIDENCES):
    return posterior_of(evidences, PRIOR, certain=(), n_forms=2)


def test_probabilities_are_prior_times_evidence_summed_over_orders():
    by_mean = posterior().marginal_over_noise
    assert sum(by_mean.values()) == pytest.approx(1.0)
    share = PRIOR.by_size[0] / 2
    assert by_mean["lag",] / by_mean[()] == pytest.approx(share * math.exp(5.0) / (PRIOR.clean_mean * 4.0))
    assert by_mean["lag",] / by_mean["backlash",] == pytest.approx(math.exp(3.0))
    assert by_mean["unknown",] / by_mean[()] == pytest.approx(PRIOR.unknown * math.e / (PRIOR.clean_mean * 4.0))


def test_an_evidence_that_is_no_number_leaves_all_others_as_they_are():
    spoilt = replace(EVIDENCES, fits={**EVIDENCES.fits, (1, ("drag",)): fit(math.nan)})
    by_mean = posterior(spoilt).marginal_over_noise
    assert by_mean.pop(("drag",)) == 0.0
    assert by_mean == posterior().marginal_over_noise


def test_orders_are_those_of_the_clean_mean_alone():
    assert posterior().order_probabilities == {1: pytest.approx(0.25), 2: pytest.approx(0.75)}


def test_orders_are_averaged_over_noises_by_the_prior_of_the_noise():
    """Order 2 leads only under outliers; by prior times evidence, not by evidence alone, order 1 is more probable."""
    by_noise = {1: {(): 0.0, ("outliers",): 0.0}, 2: {(): -1.0, ("outliers",): 0.5}}
    fits = {
        (n, ()): Fit(evidence={noise: SimpleNamespace(log_z=log_z) for noise, log_z in own.items()})
        for n, own in by_noise.items()
    }
    weight = {noise: math.exp(PRIOR.log_prior_on_noise(noise, alone=True)) for noise in ((), ("outliers",))}
    first, second = (sum(weight[noise] * math.exp(z) for noise, z in by_noise[n].items()) for n in (1, 2))
    found = posterior_of(Evidences(fits), PRIOR, certain=(), n_forms=2).order_probabilities
    assert found[1] == pytest.approx(first / (first + second))
    assert found[1] > 0.5


def test_evidence_that_is_moved_moves_what_is_unknown_beside_it():
    moved = EVIDENCES.with_log_evidence_shifted({(1, ()): 2.0})
    assert moved.unknown[1, (), ()] == 3.0
    assert [moved.fits[key].evidence[()].log_z for key in ((1, ()), (1, ("lag",)))] == [2.0, 5.0]
    assert EVIDENCES.unknown[1, (), ()] == 1.0


def test_the_most_probable_noise_is_that_under_any_mean_or_of_those_that_are_stated():
    found = replace(
        posterior(),
        probabilities={
            ((), ()): 0.4,
            ((), ("outliers",)): 0.3,
            (("lag",), ("outliers",)): 0.25,
            ((), ("drifting_noise",)): 0.05,
        },
    )
    assert found.likeliest_noise() == ("outliers",)
    assert found.likeliest_noise(()) == ()  # a noise that has no name counts as none
    assert found.likeliest_noise(("outliers",)) == ("outliers",)


def test_too_few_readings_leave_no_second_copy_of_an_effect_alone():
    prepared = SimpleNamespace(effects=dict.fromkeys(("lag", "wave", "wave~again")), noise_effect_names=frozenset())
    searched = Searched(prepared, PRIOR, {}, (), {}, None, None, EVIDENCES, posterior()).with_prior_probabilities()
    by_mean = searched.posterior.marginal_over_noise
    assert set(by_mean) == {(), ("unknown",), ("lag",), ("wave",)}
    assert sum(by_mean.values()) == pytest.approx(1.0)
