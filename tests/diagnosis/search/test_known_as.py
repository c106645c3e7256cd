"""Under which name a combination counts that holds a formula, which is a proposal and no name."""

from types import SimpleNamespace

import pytest

from probewise.diagnosis.search.searched import Evidences

FORMULA = "formula:reading:temp_c:a while |(t / period + phase) mod 1| < share / 2"


def of(log_z):
    """Evidences of fits by their names, of which nothing has 0."""
    return Evidences({(0, names): SimpleNamespace(log_z=value) for names, value in {(): 0.0, **log_z}.items()})


@pytest.mark.parametrize(
    ("wave", "known"),
    [(91.0, ("interference",)), (89.0, ("unknown",))],
    ids=["nine tenths of its gain", "less than nine tenths"],
)
def test_a_formula_counts_as_the_one_effect_that_explains_nearly_as_much(wave, known):
    evidences = of({("interference",): wave, ("offset_drift",): 3.0, (FORMULA,): 100.0})
    shares = evidences.reported_shares((FORMULA,))
    assert max(shares, key=shares.get) == known
    assert sum(shares.values()) == pytest.approx(1.0)


def test_two_names_together_stand_in_for_a_formula_that_the_readings_cannot_tell_from_them():
    """Exact twins, drag and a square law of a state that keeps its sign, share its probability: neither leads."""
    drag, square, third = (tuple(sorted(("depends", name))) for name in ("drag", "quadratic", "settling"))
    evidences = of({("depends",): 55.0, drag: 98.0, square: 98.0, third: 96.0, (FORMULA,): 100.0})
    shares = evidences.reported_shares((FORMULA,))
    assert shares == {drag: pytest.approx(0.5), square: pytest.approx(0.5)}
    assert of({drag: 96.0, (FORMULA,): 100.0}).reported_shares((FORMULA,)) == {("unknown",): 1.0}


@pytest.mark.parametrize(("named", "known"), [(51.0, ("offset_drift",)), (49.0, ("unknown",))])
def test_a_formula_beside_a_name_counts_as_the_name_if_that_explains_more(named, known):
    evidences = of({("offset_drift",): named, (FORMULA, "offset_drift"): 100.0})
    assert evidences.reported_shares((FORMULA, "offset_drift")) == {known: 1.0}


def test_names_stay_and_the_unknown_stays():
    evidences = of({("interference",): 5.0})
    assert evidences.reported_shares(("interference",)) == {("interference",): 1.0}
    assert evidences.reported_shares(("unknown",)) == {("unknown",): 1.0}
    assert evidences.reported_shares(()) == {(): 1.0}


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
    ("named", "stays"),
    [(16.0, True), (14.0, False)],
    ids=["over half of all that is explained", "less than half"],
)
def test_a_name_stays_if_it_explains_more_than_all_that_has_no_name(named, stays):
    """A gradient of 14 nats, a reflection that adds 10 and an unknown effect that adds 6: 14 of 30 have a name."""
    white: tuple[str, ...] = ()
    of_names = {(): 0.0, ("albedo_gradient",): named, ("albedo_gradient", "reflection"): 24.0}
    fits = {(2, names): SimpleNamespace(evidence={white: SimpleNamespace(log_z=z)}) for names, z in of_names.items()}
    evidences = Evidences(fits, unknown={(2, ("albedo_gradient", "reflection"), white): 30.0})
    assert evidences.named_outweigh_unknown(2, ("albedo_gradient", "reflection"), white) is stays
