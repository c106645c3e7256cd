"""The result of a search: what counts under which name."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest

from probewise.diagnosis.apparatus import PriorOdds
from probewise.diagnosis.search.hypotheses import Evidences, Searched, hypothesis_probabilities

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
    return hypothesis_probabilities(evidences, PRIOR, certain=())


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


FORMULA = "formula:reading:temp_c:a while |(t / period + phase) mod 1| < share / 2"


def of(log_z):
    """Evidences of fits by their names, of which nothing has 0."""
    return Evidences({(0, names): SimpleNamespace(log_z=value) for names, value in {(): 0.0, **log_z}.items()})


@pytest.mark.parametrize(("named", "known"), [(51.0, ("offset_drift",)), (49.0, ("unknown",))])
def test_a_formula_beside_a_name_counts_as_the_name_if_that_explains_more(named, known):
    evidences = of({("offset_drift",): named, (FORMULA, "offset_drift"): 100.0})
    assert evidences.reported_as((FORMULA, "offset_drift")) == known


def test_the_formula_beside_names_is_that_of_largest_evidence_which_adds_formulas_alone():
    def fit(log_z, *names):
        evidence = {("outliers",): SimpleNamespace(log_z=log_z)}
        return SimpleNamespace(names=names, n_gaussians=0, evidence=evidence)

    square = "formula:reading:temp_c:t^2"
    alone, more, best = fit(5.0, "lag"), fit(7.0, square, "lag"), fit(8.0, FORMULA, "lag")
    others = fit(20.0, "lag", "settling"), fit(30.0, FORMULA), fit(40.0, FORMULA, "lag", "settling")
    evidences = Evidences({(0, tuple(sorted(each.names))): each for each in (alone, more, best, *others)})
    assert evidences.best_formula_beside(alone, ("outliers",)) is best
    assert evidences.best_formula_beside(others[2], ("outliers",)) is None


@pytest.mark.parametrize(
    ("named", "stays"), [(16.0, True), (14.0, False)], ids=["over half of all that is explained", "less than half"]
)
def test_a_name_stays_if_it_explains_more_than_all_that_has_no_name(named, stays):
    """A gradient of 14 nats, a reflection that adds 10 and an unknown effect that adds 6: 14 of 30 have a name."""
    white: tuple[str, ...] = ()
    of_names = {(): 0.0, ("albedo_gradient",): named, ("albedo_gradient", "reflection"): 24.0}
    fits = {(2, names): SimpleNamespace(evidence={white: SimpleNamespace(log_z=z)}) for names, z in of_names.items()}
    evidences = Evidences(fits, unknown={(2, ("albedo_gradient", "reflection"), white): 30.0})
    assert evidences.named_outweigh_unknown(2, ("albedo_gradient", "reflection"), white) is stays


def test_a_name_stands_beside_what_is_unknown_in_its_share_of_the_evidence():
    """Two hypotheses, nothing named and `lag`, whose evidence and prior odds make them as one to three."""
    prior = PriorOdds()
    more = math.log(3.0) + prior.log_prior_with_unknown(()) - prior.log_prior_with_unknown(("lag",))
    unknown = {(0, (), ()): 10.0, (0, ("lag",), ()): 10.0 + more}
    searched = SimpleNamespace(evidences=Evidences({}, unknown=unknown), prior=prior, certain=())
    assert Searched.effect_probabilities_given_unknown(searched) == pytest.approx({"lag": 0.75})


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
