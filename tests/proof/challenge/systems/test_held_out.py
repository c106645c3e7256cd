"""Runs that were not seen: what is their own comes from its prior."""

import numpy as np
import pytest
from scipy.stats import norm, t

from probewise.diagnosis import ModelSamples
from probewise.priors import Normal, Uniform
from probewise.proof.challenge import predict_runs
from probewise.systems import RunTable, Simulator, System
from probewise.systems.forms import ReferenceFit, bind_forms

X = np.array([0.0, 1.0, 2.0])


def _samples(per_run, effect=""):
    table = RunTable({"x": np.tile(X, 2), "run": np.repeat([1.0, 2.0], 3), "y": np.zeros(6)}, run="run")
    simulator = Simulator(
        "y", "V", {"slope": Uniform(0, 4), "start": Normal(5.0, 2.0)}, run="run", per_run=per_run,
        simulate=lambda p, data: p["start"] + p["slope"] * data["x"],
    )  # fmt: skip
    system = System.of(simulator, table)
    about = ReferenceFit(system, table, np.zeros(system.n_params), 0.1)
    effects = [bind_forms(about)[effect]] if effect else []
    theta = np.tile([2.0, 1.0, 1.5][: system.n_params] + [0.5, -0.5] * len(effects), (50, 1))
    return ModelSamples(system.chain(table, effects), theta, np.full(50, 0.1), 0), about


def _later():
    return RunTable({"x": X, "run": np.full(3, 3.0), "y": np.zeros(3)}, run="run")


def test_shared_parameters_are_the_posteriors():
    predicted, sd = predict_runs(*_samples(()), _later(), rng=np.random.default_rng(0))
    np.testing.assert_allclose(predicted, np.tile(1.0 + 2.0 * X, (len(predicted), 1)))
    np.testing.assert_allclose(sd, 0.1)


def test_what_is_a_runs_own_is_drawn_from_its_prior():
    predicted, _ = predict_runs(*_samples(("start",)), _later(), rng=np.random.default_rng(0))
    start = predicted[:, 0]
    np.testing.assert_allclose(predicted - start[:, None], np.tile(2.0 * X, (len(start), 1)), atol=1e-12)
    assert start.mean() == pytest.approx(5.0, abs=0.01)
    np.testing.assert_allclose(np.quantile(start, [0.1, 0.9]), norm.ppf([0.1, 0.9], 5.0, 2.0), atol=0.02)


def test_the_value_that_an_effect_gives_to_a_run_is_drawn_for_a_run_not_seen():
    """As `predict_system` draws it: offsets 0.5 and -0.5 in two runs, so 3 degrees of freedom, width sqrt(.5 * 1.5)."""
    predicted, _ = predict_runs(*_samples((), "offset_per_run"), _later(), rng=np.random.default_rng(0))
    offset = predicted[:, 0] - 1.0
    np.testing.assert_allclose(predicted - offset[:, None], np.tile(1.0 + 2.0 * X, (len(offset), 1)), atol=1e-12)
    np.testing.assert_allclose(np.quantile(offset, [0.1, 0.5, 0.9]), t.ppf([0.1, 0.5, 0.9], 3) * 0.75**0.5, atol=0.1)
