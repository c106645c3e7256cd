"""A sensor model made by hand, and recordings small enough for a test."""

import signal

import numpy as np
import pytest
from hand_made import TRUTH, sensor_of
from mixtures import fixed_mixture

from probewise._signals import ENDING
from probewise.calibration import write_sensor
from probewise.recordings import Recording, paper_plan, write_recording
from probewise.scene import KnownScene
from probewise.sensor import Chain, FixedLevels


@pytest.fixture(autouse=True)
def signals_are_heard():
    """A test runner in the background ignores Ctrl-C, one under nohup a closed terminal."""
    before = {number: signal.signal(number, signal.default_int_handler) for number in ENDING}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def small_recording():
    """Every fourth reading of the paper's plan, by the chain itself with noise of sd 0.6."""
    plan = paper_plan()
    plan = plan.take(np.arange(0, len(plan), 4))
    chain = Chain(fixed_mixture(TRUTH[:6]), FixedLevels(10.0, 60.0), KnownScene(plan.patterns))
    noise = 0.6 * np.random.default_rng(1).standard_normal(len(plan))
    return Recording(plan, chain.predict(np.empty((1, 0)), plan)[0] + noise)


@pytest.fixture
def sensor_file(tmp_path):
    path, spread = tmp_path / "sensor.json", np.array([0.1, 0.02, 0.02, 0.0005, 0.001, 0.001, 0.03, 0.03])
    write_sensor(sensor_of(TRUTH + spread * np.random.default_rng(0).standard_normal((500, 8))), path)
    return path


@pytest.fixture
def recording_file(tmp_path):
    path = tmp_path / "small.csv"
    write_recording(small_recording(), path)
    return path
