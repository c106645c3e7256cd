"""The gain of a repair, and the correction where it has no name."""

from types import SimpleNamespace

import numpy as np
import pytest

from probewise.diagnosis import best_repair
from probewise.diagnosis.apparatus import PriorOdds
from probewise.diagnosis.best_repair import correct_by_best_basis
from probewise.diagnosis.evidence import Linearised, partition_into_blocks
from probewise.diagnosis.noise import NoiseLaw
from probewise.diagnosis.templates import TemplateBank
from probewise.diagnosis.verdict import Hypothesis, Judged
from probewise.recordings import Recording, two_way_plan

PLAN = two_way_plan()


def test_blocks_are_kept_back_whole_and_every_reading_once():
    readings = np.ones(len(PLAN))
    readings[:3] = np.nan
    part, names = partition_into_blocks(Recording(PLAN, readings))
    assert len(part) == len(PLAN) - 3
    assert sorted(np.unique(part)) == list(range(len(names)))
    ends = np.flatnonzero(np.diff(part)) + 1
    assert (np.diff(ends) == 8).all()


_N = 120
_BUMP = np.exp(-0.5 * ((np.arange(_N) - 60) / 15) ** 2)
_PARTS = (np.arange(_N) // 8) % 5


def _corrected(law, noise):
    """Return the correction of a fitted constant by the bump, which the readings contain once."""
    residuals = _BUMP + noise
    found = SimpleNamespace(slopes=10 * np.ones((_N, 1)), residuals=residuals, z=np.zeros(1), sd=0.1)
    problem = Linearised.of(found, law)
    bank = TemplateBank.of([_BUMP[:, None]], ["time"])
    return found, problem, correct_by_best_basis(found, problem, bank, _PARTS)


def _law(**more):
    given = {"sd": np.ones(_N), "carry": np.zeros(_N), "lost": np.zeros(_N, dtype=bool), **more}
    return NoiseLaw(**given)


def test_lost_readings_do_not_count():
    rng, lost = np.random.default_rng(2), np.zeros(_N, dtype=bool)
    lost[[5, 40, 62, 90]] = True
    noise = 0.1 * rng.standard_normal(_N)
    _, _, found = _corrected(_law(lost=lost), np.where(lost, -50.0, noise))
    _, _, elsewhere = _corrected(_law(lost=lost), np.where(lost, 70.0, noise))
    assert np.abs(found.change - _BUMP).max() < 0.1
    np.testing.assert_allclose(found.change, elsewhere.change)
    assert found.held_out == elsewhere.held_out
    assert found.held_out.per_reading > 4 * found.held_out.sd


@pytest.mark.parametrize(("clean", "predicts", "weight"), [(0.3, False, 0.05), (0.3, True, None), (0.01, False, None)])
def test_what_is_unknown_and_predicts_nothing_has_its_prior_odds_beside_a_law_that_may_be_complete(
    monkeypatch, clean, predicts, weight
):
    """.06 to .6 against nothing on the mean, .3 of the probability: .05 times the .6 that it has."""
    asked = []
    fixed = SimpleNamespace(held_out=SimpleNamespace(per_reading=0.1 if predicts else -0.1))
    monkeypatch.setattr(best_repair, "best_correction", lambda *more: (fixed, ()))
    monkeypatch.setattr(best_repair.BestRepair, "of", lambda *more, **options: "repair")
    monkeypatch.setattr(best_repair, "judge", lambda *more, unknown_weight: asked.append(unknown_weight) or judged)
    hypotheses = (
        Hypothesis(("unknown",), 0.6),
        Hypothesis((), clean / 2),
        Hypothesis(("outliers",), clean / 2),
        Hypothesis(("lag",), 0.4 - clean),
    )
    judged = Judged("unknown", ("unknown",), 0.004, hypotheses)
    searched = SimpleNamespace(
        leading_combination_out_of_vocabulary=lambda: (),
        likeliest_fit_beside_unknown=lambda noise: None,
        prior=PriorOdds(),
        prepared=SimpleNamespace(noise_effect_names=frozenset({"outliers"})),
    )
    test = SimpleNamespace(null=None, noise=())
    found = best_repair.judged_and_best_repair(searched, test, judged, rng=np.random.default_rng(0))
    assert found == (judged, "repair")
    assert asked == ([] if weight is None else [pytest.approx(weight)])
