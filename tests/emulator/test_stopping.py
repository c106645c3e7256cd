"""A command that moves the arm is stopped by a signal, as a process with a line of its own: nothing stays on."""

import os
import random
import signal
import subprocess
import sys
import time

import pytest
from arm_faults import SENSOR

from probewise.arm.nxt import Brick
from probewise.arm.nxt.telegram import IDLE, NO_SENSOR, get_input_values, get_output_state
from probewise.calibration import write_sensor

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "openpty"), reason="this system has no pseudo-terminals"),
]

LIMIT_S = 60.0
PROMPT_S = 1.0  # until all motors are released
RELEASE = "> 80 04 ff 00 00"
TASKS = {
    "explore": ("explore", "--sensor", "sensor.json", "--out", "found"),
    "jog": ("arm", "jog", "base", "-90"),
    "scan": ("arm", "scan", "300,200", "500,300"),
    "home": ("arm", "home"),
    "record": ("arm", "record", "paper", "--out", "mine.csv"),
}
STOPS = ["SIGINT", "SIGTERM", "SIGHUP", "closed terminal", "SIGHUP twice"]


@pytest.fixture
def chance():
    return random.Random(int(os.environ.get("PROBEWISE_STOP_SEED", "1")))


@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize("task", TASKS)
def test_nothing_stays_on_whatever_stops_which_command_when(task, stop, emulator, tmp_path, chance):
    """At a random moment of the first seconds in which motors turn; the emulator says how it is left, and when."""
    pytest.importorskip("serial", reason="pyserial is not installed")
    write_sensor(SENSOR, tmp_path / "sensor.json")
    log = tmp_path / "log"
    with emulator("--log", str(log)) as running:
        terminal, own = os.openpty()
        process = subprocess.Popen(
            [sys.executable, "-m", "probewise", *TASKS[task], "--arm", f"nxt:{running.device}"],
            cwd=tmp_path,
            stdin=own,
            stdout=own,
            stderr=own,
            preexec_fn=lambda: _lead(own),
            env={name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"},  # as a person's
        )
        os.close(own)
        os.write(terminal, b"\n" * 3)  # a person who has done what is asked
        await_telegram(log, "SETOUTPUTSTATE")
        time.sleep(chance.uniform(0.0, 1.5))
        n_before = log.stat().st_size
        began_s = time.monotonic()
        if stop == "closed terminal":
            os.close(terminal)
        else:
            for _ in range(1 + stop.endswith("twice")):
                process.send_signal(signal.Signals[stop.split()[0]])
        await_telegram(log, RELEASE, n_before)
        took_s = time.monotonic() - began_s
        status = process.wait(timeout=LIMIT_S)
        name = "SIGHUP" if stop == "closed terminal" else stop.split()[0]
        assert status == 128 + signal.Signals[name]
        if stop != "closed terminal":
            said = os.read(terminal, 65536).decode()
            assert "stopped; " in said
            assert "Traceback" not in said
            os.close(terminal)
        brick = Brick.open(running.device)
        motors = [brick.link.ask(get_output_state(port)) for port in range(3)]
        lights = [brick.link.ask(get_input_values(port)) for port in range(4)]
        brick.link.close()
        assert [(motor.power, motor.run_state) for motor in motors] == [(0, IDLE)] * 3
        assert not any(motor.mode for motor in motors)  # neither braked nor held
        assert [light.type for light in lights] == [NO_SENSOR] * 4
        assert took_s < PROMPT_S


def await_telegram(log, text, n_before=0):
    """Wait until the emulator has heard a telegram, behind so many bytes of its log."""
    deadline_s = time.monotonic() + LIMIT_S
    while text not in (log.read_text(encoding="utf-8")[n_before:] if log.exists() else ""):
        assert time.monotonic() < deadline_s, f"{text} never comes"
        time.sleep(0.02)


def _lead(terminal):
    """Become the leader of a session with this terminal, which hears Ctrl-C."""
    import fcntl
    import termios

    os.setsid()
    fcntl.ioctl(terminal, termios.TIOCSCTTY, 0)
    signal.signal(signal.SIGINT, signal.default_int_handler)
