"""Refined nodes of a noise model against dense grids of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from probewise.diagnosis.evidence import laplace_evidence, refined
from probewise.diagnosis.fit import Fit
from probewise.diagnosis.noise_models import NoiseModel
from probewise.diagnosis.prior_odds import PriorOdds
from probewise.diagnosis.search.refits import NoiseModels
from probewise.effects.noise import CorrelatedNoise, DriftingNoise, Outliers, RandomWalk, SignalDependentNoise
from probewise.recordings import Plan, Recording

N = 2000


@dataclass(frozen=True)
class _DenseWalk(RandomWalk):
    n_nodes = 400


@dataclass(frozen=True)
class _DenseCorrelation(CorrelatedNoise):
    n_nodes = 400


@dataclass(frozen=True)
class _DenseDrift(DriftingNoise):
    n_nodes = 400


@dataclass(frozen=True)
class _DenseSignal(SignalDependentNoise):
    n_nodes = 400


@dataclass(frozen=True)
class _DenseOutliers(Outliers):
    nodes_per_parameter = (30, 30)


def _correlated(noise: np.ndarray, rho: float) -> np.ndarray:
    out = noise.copy()
    for k in range(1, len(out)):
        out[k] = rho * out[k - 1] + np.sqrt(1 - rho**2) * noise[k]
    return out


def _found_with(noise: np.ndarray) -> tuple[Fit, Recording]:
    """Make a fit of one parameter, at its prior's centre, to one long scan."""
    x = np.linspace(-1.0, 1.0, len(noise))
    zero = np.zeros(len(noise))
    none = np.zeros(len(noise), dtype=int)
    plan = Plan(x, zero, zero, np.arange(len(noise), dtype=float), none, ("scan",), none, ("edge",))
    model = cast(Any, SimpleNamespace(sensor=SimpleNamespace(has_exchangeable_gaussians=False)))
    slopes = np.random.default_rng(1).normal(size=(len(noise), 1))
    return Fit(model, np.zeros(1), 10 * x, noise, slopes, 1.0, 0.0), Recording(plan, 10 * x + noise)


RNG = np.random.default_rng(2)
WHITE = RNG.normal(size=N)
WIDE = np.where(RNG.random(N) < 0.05, 20.0, 1.0)


@pytest.mark.parametrize(
    ("effect", "dense", "noise"),
    [
        (RandomWalk(), _DenseWalk(), WHITE + np.cumsum(0.9 * RNG.normal(size=N))),
        (CorrelatedNoise(), _DenseCorrelation(), _correlated(WHITE, 0.93)),
        (DriftingNoise(), _DenseDrift(), WHITE * 1.2 ** (np.arange(N) / N)),
        (SignalDependentNoise(), _DenseSignal(), WHITE * np.sqrt(1 + 4 * np.arange(N) / N)),
        (Outliers(), _DenseOutliers(), WHITE * WIDE),
    ],
    ids=lambda value: value.name if hasattr(value, "name") else "",
)
def test_refined_nodes_are_as_good_as_dense_ones(effect, dense, noise):
    """Evidence to a tenth of a nat, mean and sd of each parameter to a fifth of the sd, and a node at the peak."""
    found, recording = _found_with(noise)
    wanted = laplace_evidence(found, NoiseModel((dense,), recording))
    own = refined(found, laplace_evidence(found, NoiseModel((effect,), recording)))
    assert own.log_z == pytest.approx(wanted.log_z, abs=0.1)
    means, sds = zip(*(_mean_and_sd(e) for e in (own, wanted)), strict=True)
    np.testing.assert_allclose(means[0], means[1], atol=0.2 * sds[1].min(), rtol=0.02)
    np.testing.assert_allclose(sds[0], sds[1], rtol=0.2)
    heights = [float((e.log_z_nodes - e.nodes.log_weights).max()) for e in (own, wanted)]
    assert heights[0] > heights[1] - 0.1
    assert len(own.nodes.laws) <= 9


def _mean_and_sd(evidence):
    mean = evidence.weights @ evidence.nodes.settings
    return mean, np.sqrt(evidence.weights @ (evidence.nodes.settings - mean) ** 2)


def test_nodes_that_are_close_enough_stay_as_they_are():
    found, recording = _found_with(WHITE[:100])
    for effect in (RandomWalk(), CorrelatedNoise(), DriftingNoise(), SignalDependentNoise(), Outliers()):
        evidence = laplace_evidence(found, NoiseModel((effect,), recording))
        assert refined(found, evidence) is evidence


def test_a_noise_far_behind_is_not_refined():
    found, recording = _found_with(WHITE + np.cumsum(0.9 * RNG.normal(size=N)))
    evidence = laplace_evidence(found, NoiseModel((RandomWalk(),), recording))
    assert refined(found, evidence, least=evidence.log_z + 100) is evidence
    assert refined(found, evidence, least=evidence.log_z) is not evidence


def test_a_pair_of_noises_has_no_less_evidence_than_all_its_nodes():
    """AR(1) of correlation .75 whose innovations are sometimes wide: every third node of it was 20 nats too low."""
    n = 300
    found, recording = _found_with(_correlated(WHITE[:n] * WIDE[:n], 0.75))
    effects = {"outliers": Outliers(), "correlated_noise": CorrelatedNoise()}
    noises = NoiseModels(recording, effects, PriorOdds())
    assert noises.add_significant_pairs(found, noises.evidence_by_noise(found))
    own = noises.evidence_by_noise(found)["correlated_noise", "outliers"]
    every = laplace_evidence(found, NoiseModel((CorrelatedNoise(), Outliers()), recording))
    assert own.log_z > every.log_z - 1.0
    assert _mean_and_sd(own)[0][0] == pytest.approx(0.75, abs=0.05)


def test_a_fit_at_the_edge_of_its_formula_is_impossible_under_any_noise():
    """A slope there is no number; neither is it a warning."""
    found, recording = _found_with(WHITE[:100])
    slopes = found.slopes.copy()
    slopes[7, 0] = np.nan
    for effects in ((), (RandomWalk(),), (Outliers(),), (Outliers(), RandomWalk())):
        evidence = laplace_evidence(replace(found, slopes=slopes), NoiseModel(effects, recording))
        assert evidence.log_z == -np.inf
        assert refined(found, evidence) is evidence
