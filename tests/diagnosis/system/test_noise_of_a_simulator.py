"""What is wrong with the noise of a person's readings: named, sized, and carried to predictions."""

import numpy as np
import pytest

from probewise.diagnosis import diagnose_system
from probewise.diagnosis.fit_simulator import repaired_of
from probewise.systems import Noise, Simulator, predict_system

_N = 240


def _line(**more):
    return Simulator("y", "V", {"a": (-5, 5), "b": (-5, 5)}, simulate=lambda p, u: p["a"] + p["b"] * u["x"], **more)


def _table(readings):
    x = np.tile(np.linspace(0.0, 1.0, _N // 6), 6)
    return {"x": x, "run": np.repeat(np.arange(6.0), _N // 6), "y": 1.0 + 2.0 * x + readings}


@pytest.mark.slow
def test_a_walk_is_named_and_predicted_beyond_its_end():
    rng = np.random.default_rng(4)
    walk = 0.3 * np.cumsum(rng.standard_normal(_N))
    table = _table(0.1 * (rng.standard_normal(_N) + walk))
    diagnosis = diagnose_system(_line(run="run"), table, rng=rng)
    assert diagnosis.combination == ("random_walk",)
    (found,) = [e for e in diagnosis.effects if e.name == "random_walk"]
    low, high = found.parameters[0].interval95
    assert low < 0.3 < high
    predicted = predict_system(repaired_of(diagnosis), table, rng=rng)
    assert predicted.sd[-1] > 1.2 * predicted.sd[0]


@pytest.mark.slow
def test_runs_of_another_noise_are_named_and_a_run_that_was_not_seen_gets_one_like_theirs():
    rng = np.random.default_rng(5)
    loud = np.repeat([0.5, 1.0, 3.0, 0.5, 1.0, 3.0], _N // 6)
    table = _table(0.1 * loud * rng.standard_normal(_N))
    diagnosis = diagnose_system(_line(run="run"), table, rng=rng)
    assert diagnosis.combination == ("noise_per_run",)
    later = {name: np.append(values, 9.0 if name == "run" else values[-1]) for name, values in table.items()}
    predicted = predict_system(repaired_of(diagnosis), later, rng=rng)
    assert predicted.sd[100] == pytest.approx(0.3, rel=0.3)
    assert predicted.sd[0] == pytest.approx(0.05, rel=0.3)
    assert 0.05 < predicted.sd[-1] < 2.0


@pytest.mark.slow
def test_known_sds_are_noise_of_the_rows_and_no_outliers():
    """Without the column the loud readings are outliers; with it nothing is wrong."""
    rng = np.random.default_rng(6)
    sigma = np.where(rng.random(_N) < 0.15, 0.8, 0.1)
    table = _table(sigma * rng.standard_normal(_N))
    assert diagnose_system(_line(), table, rng=rng).combination == ("outliers",)
    known = diagnose_system(_line(noise=Noise(sd="sigma_v")), {**table, "sigma_v": sigma}, rng=rng)
    assert known.verdict == "clean"
    predicted = predict_system(repaired_of(known), {**table, "sigma_v": sigma}, rng=rng)
    np.testing.assert_allclose(predicted.sd, sigma, rtol=0.2)


@pytest.mark.single_case
@pytest.mark.slow
def test_three_faults_of_the_noise_are_each_given_a_size():
    rng = np.random.default_rng(7)
    memory = np.zeros(_N)
    for k in range(_N):
        fresh = rng.standard_normal() * (8.0 if rng.random() < 0.06 else 1.0)
        memory[k] = fresh + (0.6 * memory[k - 1] if k % (_N // 6) else 0.0)
    table = _table(0.05 * memory * np.sqrt(1 + 20 * np.tile(np.linspace(0.0, 1.0, _N // 6), 6)))
    diagnosis = diagnose_system(_line(run="run"), table, rng=rng)
    assert set(diagnosis.combination) <= {"correlated_noise", "outliers", "signal_dependent_noise"}
    assert all(np.isfinite(effect.size_lambda) for effect in diagnosis.effects)
