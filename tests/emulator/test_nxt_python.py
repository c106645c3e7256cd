"""Somebody else's client drives the brick: nxt-python, through its backend for serial devices.

It waits for ever for an answer that does not come, so each of its programs runs in a process with a limit.
"""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "openpty"), reason="this system has no pseudo-terminals"),
    pytest.mark.skipif(
        importlib.util.find_spec("nxt") is None, reason="nxt-python is not installed: pip install nxt-python"
    ),
]

LIMIT_S = 60.0
HEAD = """
import sys, nxt.error, nxt.locator, nxt.motor, nxt.sensor, nxt.sensor.generic
with nxt.locator.find(backends=["devfile"], config=None, filename=sys.argv[1]) as brick:
"""


@pytest.fixture(scope="module")
def device(emulator):
    with emulator("--scene", "524,300,100") as running:
        yield running.device


@pytest.fixture
def client(device):
    """Run statements with `brick` in hand and return the lines they print."""

    def client(statements):
        body = "".join(f"    {line}\n" for line in statements.strip().splitlines())
        done = subprocess.run(
            [sys.executable, "-c", HEAD + body, device], capture_output=True, text=True, timeout=LIMIT_S, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    return client


def test_its_own_test_program_is_content(device):
    program = Path(sys.executable).parent / "nxt-test"
    done = subprocess.run(
        [program, "--backend", "devfile", "--filename", device],
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Firmware version 1.31" in done.stdout
    assert "Battery level 7412 mV" in done.stdout


def test_it_reads_the_light_sensor(client):
    """High above black with room light only: half of 10 %, 51 of 1023 or so."""
    (lit, dark) = client("""
light = brick.get_sensor(nxt.sensor.Port.S1, nxt.sensor.generic.Light)
print(light.get_sample())
light.set_illuminated(False)
print(light.get_sample())
""")
    assert 30 < int(lit) < 80
    assert 30 < int(dark) < 80


@pytest.mark.slow  # on the wall clock: a busy machine polls too late
def test_it_turns_a_motor(client):
    """Its own tolerance for turns over Bluetooth is 70 degrees."""
    there, back = client("""
motor = brick.get_motor(nxt.motor.Port.A)
motor.reset_position(False)
motor.turn(40, 180)
print(motor.get_tacho().rotation_count)
motor.turn(-40, 180)
print(motor.get_tacho().rotation_count)
motor.idle()
""")
    assert abs(int(there) - 180) <= 70
    assert abs(int(back)) <= 70


def test_it_finds_the_error_that_it_knows(client):
    assert client("""
try:
    brick.get_current_program_name()
except Exception as error:
    print(type(error).__name__)
""") == ["NoActiveProgramError"]
