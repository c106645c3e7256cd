"""Where the fit of a simulator begins: a system that swings has a valley for every period."""

import numpy as np
import pytest

from probewise.diagnosis.left_out import recording_from_table
from probewise.diagnosis.simulator_fit import fit_system
from probewise.systems import Law, RunTable, Simulator, System


def _rates(s, p, u):
    caught = p["eat"] * s["prey"] * s["hunters"]
    return {"prey": p["grow"] * s["prey"] - caught, "hunters": 0.3 * caught - p["die"] * s["hunters"]}


def test_a_fit_of_prey_and_hunters_finds_the_period_of_their_swings():
    """From points of the prior over whole runs alone the fit ends in the valley of another period."""
    priors = {"grow": ("log", 0.05, 5), "eat": ("log", 0.005, 0.5), "die": ("log", 0.05, 5)}
    simulator = Simulator(
        "n", "1/ml", priors, law=Law({"prey": 20.0, "hunters": 5.0}, _rates), time="t_d", noise={"sd": 0.3}
    )
    empty = RunTable({"t_d": np.linspace(0, 30, 80), "n": np.zeros(80)}, time="t_d")
    truth = {"grow": 0.74, "eat": 0.074, "die": 0.65}
    system = System.of(simulator, empty)
    theta = np.array([[truth[name] for name in system.marginals]])
    noise_free = system.chain(empty, ()).predict(theta, empty)[0]
    readings = noise_free + 0.3 * np.random.default_rng(0).normal(size=80)
    recording = recording_from_table(simulator, empty.with_columns({"n": readings}))
    _, found, _ = fit_system(System.of(simulator, recording.plan), recording)
    fitted = dict(zip(system.marginals, system.theta(found.z[None, :])[0], strict=True))
    assert fitted == pytest.approx(truth, rel=0.03)
