"""A wave faster than the average spacing of times that come in clusters."""

import numpy as np
import pytest

from probewise.diagnosis.diagnose_simulator import diagnose_system
from probewise.systems import RunTable, Simulator


@pytest.mark.slow
def test_a_wave_of_days_is_named_in_a_recording_of_ten_years_with_a_long_pause():
    """Of 150 readings in 10 years no period below 49 days was tried: the wave was taken for noise with memory."""
    rng = np.random.default_rng(5)
    nights = np.concatenate([np.sort(rng.choice(200, 30, replace=False)), 3650 + np.arange(0, 40, 2)])
    times = np.sort((nights[:, None] + np.sort(rng.uniform(0.0, 0.3, (len(nights), 3)), axis=1)).ravel())
    y = 1.0 + 0.03 * np.sin(2 * np.pi * times / 4.785) + 0.015 * rng.standard_normal(times.size)
    simulator = Simulator(
        "y", "V", {"offset": (-5, 5)}, simulate=lambda p, u: p["offset"] + 0 * u["t_d"], time="t_d", time_unit="d"
    )
    found = diagnose_system(simulator, RunTable({"t_d": times, "y": y}, time="t_d"), rng=np.random.default_rng(0))
    assert found.verdict == "named"
    (wave,) = [effect for effect in found.effects if effect.name == "interference"]
    assert wave.probability > 0.9
    hz = next(each for each in wave.parameters if each.name == "hz")
    # How many waves passed in the pause, nobody has counted: periods apart by one of them fit as well.
    assert 1 / hz.mean == pytest.approx(4.785, rel=5e-3)
