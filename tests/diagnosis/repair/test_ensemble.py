"""The weights by which hypotheses are mixed in the repaired model."""

from types import SimpleNamespace

import numpy as np
import pytest

from probewise.diagnosis.averaging import HypothesisSamples
from probewise.diagnosis.search.searched import Posterior


def candidate(names, log_z):
    sensor = SimpleNamespace(has_exchangeable_gaussians=True)
    found = SimpleNamespace(model=SimpleNamespace(sensor=sensor))
    return SimpleNamespace(names=names, found=found, evidence={(): SimpleNamespace(log_z=log_z)})


def samples(probabilities, own=frozenset()):
    """Hypotheses whose evidence under white noise alone says the opposite of the verdict, which weighs all noises."""
    fits = {(0, names): candidate(names, log_z) for names, log_z in [((), 0.0), (("lag",), 1.0), (("drift",), 9.0)]}
    searched = SimpleNamespace(
        evidences=SimpleNamespace(fits=fits),
        posterior=Posterior(probabilities, {0: 1.0}),
        prior=SimpleNamespace(log_prior_on_mean=lambda names: 0.0),
        prepared=SimpleNamespace(effects={}, apparatus=SimpleNamespace(user_effect_names=lambda effects: own)),
    )
    return HypothesisSamples(searched, (), np.random.default_rng(0)), fits


def test_the_repaired_model_is_mixed_by_the_probabilities_of_the_verdict():
    said = {
        (("lag",), ()): 0.1,
        (("lag",), ("outliers",)): 0.5,
        (("drift",), ()): 0.15,
        ((), ("outliers",)): 0.05,
        (("unknown",), ()): 0.1,
        (("seen by screening alone",), ()): 0.1,
    }
    cached, fits = samples(said)
    by_mean = cached.compatible_probabilities(fits[0, ("lag",)])
    assert by_mean == pytest.approx({("lag",): 0.75, ("drift",): 0.1875, (): 0.0625})


def test_a_users_own_effect_is_mixed_in_only_where_the_best_has_it():
    said = {(("lag",), ()): 0.6, (("drift",), ()): 0.4}
    cached, fits = samples(said, own=frozenset({"drift"}))
    assert ("drift",) not in cached.compatible_probabilities(fits[0, ("lag",)])
    assert cached.compatible_probabilities(fits[0, ("drift",)])["drift",] == pytest.approx(0.4)


def test_the_best_stands_alone_where_the_verdict_has_no_probability_for_any():
    cached, fits = samples({(("unknown",), ()): 1.0})
    assert cached.compatible_probabilities(fits[0, ("lag",)]) == {("lag",): 1.0}
