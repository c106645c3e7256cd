"""Runs that were not seen: what is their own comes from its prior."""

import numpy as np
import pytest
from scipy.stats import norm

from probewise.challenge.systems.held_out import predicted_runs
from probewise.diagnosis import ModelSamples
from probewise.priors import Normal, Uniform
from probewise.systems import RunTable, Simulator, System

X = np.array([0.0, 1.0, 2.0])


def _samples(per_run):
    table = RunTable({"x": np.tile(X, 2), "run": np.repeat([1.0, 2.0], 3), "y": np.zeros(6)}, run="run")
    simulator = Simulator(
        "y", "V", {"slope": Uniform(0, 4), "start": Normal(5.0, 2.0)}, run="run", per_run=per_run,
        simulate=lambda p, data: p["start"] + p["slope"] * data["x"],
    )  # fmt: skip
    system = System.of(simulator, table)
    theta = np.tile([2.0, 1.0, 1.5][: system.n_params], (50, 1))
    return ModelSamples(system.chain(table, ()), theta, np.full(50, 0.1), (), 0)


def _later():
    return RunTable({"x": X, "run": np.full(3, 3.0), "y": np.zeros(3)}, run="run")


def test_shared_parameters_are_the_posteriors():
    predicted, sd = predicted_runs(_samples(()), _later(), rng=np.random.default_rng(0))
    np.testing.assert_allclose(predicted, np.tile(1.0 + 2.0 * X, (len(predicted), 1)))
    np.testing.assert_allclose(sd, 0.1)


def test_what_is_a_runs_own_is_drawn_from_its_prior():
    predicted, _ = predicted_runs(_samples(("start",)), _later(), rng=np.random.default_rng(0))
    start = predicted[:, 0]
    np.testing.assert_allclose(predicted - start[:, None], np.tile(2.0 * X, (len(start), 1)), atol=1e-12)
    assert start.mean() == pytest.approx(5.0, abs=0.01)
    np.testing.assert_allclose(np.quantile(start, [0.1, 0.9]), norm.ppf([0.1, 0.9], 5.0, 2.0), atol=0.02)
