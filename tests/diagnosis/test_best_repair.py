"""The gain of a repair, and the correction where it has no name."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from probewise.diagnosis import best_repair
from probewise.diagnosis.apparatus import PriorOdds
from probewise.diagnosis.best_repair import correct_by_best_basis
from probewise.diagnosis.evidence import SCALES, Linearised, partition_into_blocks
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


def _mixed_sds():
    return np.where(np.arange(_N) % 4 == 1, 30.0, 1.0)


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


@pytest.mark.parametrize("kind", ["walk", "sd"])
def test_the_gain_is_that_of_the_conditional_densities(kind):
    """Route two: dense normals, with the scale of the amplitude and of the noise that the first route states."""
    law = _law(walk=np.full(_N, 0.04)) if kind == "walk" else _law(sd=_mixed_sds())
    at = np.arange(_N)
    shape = np.diag(law.sd**2) + (0.04 * (1 + np.minimum.outer(at, at)) if kind == "walk" else 0.0)
    noise = 0.1 * np.linalg.cholesky(shape) @ np.random.default_rng(3).standard_normal(_N)
    found, problem, corrected = _corrected(law, noise)

    def log_density(columns, out):
        design = np.concatenate([found.slopes, columns], axis=1)
        prior = np.diag([1.0, *[(problem.sd * SCALES[5]) ** 2] * columns.shape[1]])
        kept = np.flatnonzero(~out)
        precision = np.linalg.inv(shape[np.ix_(kept, kept)])
        amount = np.linalg.solve(
            design[kept].T @ precision @ design[kept] + problem.sd**2 * np.linalg.inv(prior),
            design[kept].T @ precision @ found.residuals[kept],
        )
        left = found.residuals[kept] - design[kept] @ amount
        sigma_2 = left @ precision @ left / (len(kept) - design.shape[1])
        spread = np.linalg.inv(design[kept].T @ precision @ design[kept] / problem.sd**2 + np.linalg.inv(prior))
        gain = shape[np.ix_(out, kept)] @ precision
        rows = design[out] - gain @ design[kept]
        mean = design[out] @ amount + gain @ left
        covariance = sigma_2 * (shape[np.ix_(out, out)] - gain @ shape[np.ix_(kept, out)]) + rows @ spread @ rows.T
        if kind == "sd":  # independent readings, each by itself
            covariance = np.diag(np.diag(covariance))
        return multivariate_normal(mean, covariance).logpdf(found.residuals[out])

    plain = np.zeros((_N, 0))
    columns = _BUMP[:, None] / np.sqrt(np.mean(_BUMP**2))
    expected = sum(log_density(columns, out) - log_density(plain, out) for out in np.equal.outer(range(5), _PARTS)) / _N
    assert corrected.held_out.per_reading == pytest.approx(expected, rel=2e-3)


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
