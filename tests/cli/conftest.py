"""A sensor model made by hand, and recordings small enough for a test."""

import signal

import pytest
from hand_made import small_recording, spread_sensor

from probewise._signals import ENDING
from probewise.calibration import write_sensor
from probewise.recordings import write_recording


@pytest.fixture(autouse=True)
def signals_are_heard():
    """A test runner in the background ignores Ctrl-C, one under nohup a closed terminal."""
    before = {number: signal.signal(number, signal.default_int_handler) for number in ENDING}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def sensor_file(tmp_path):
    write_sensor(spread_sensor(), tmp_path / "sensor.json")
    return tmp_path / "sensor.json"


@pytest.fixture
def recording_file(tmp_path):
    path = tmp_path / "small.csv"
    write_recording(small_recording(), path)
    return path
