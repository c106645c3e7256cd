"""A brick on a clock that tests move, and one in a process of its own."""

import select
import signal
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import dataclass

import pytest

from probewise.emulator import Brick, LightSensor, VirtualClock, empty_port


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def brick(clock):
    """A light sensor at port 2 over something that reads 57.5 %."""
    sensors = [empty_port, LightSensor(lambda lit: 57.5 if lit else 28.75, clock), empty_port, empty_port]
    return Brick(clock, sensors=sensors)


@pytest.fixture
def ask(brick):
    """Send a telegram as hexadecimal text, return the reply as such; nothing where there is none."""

    def ask(telegram):
        reply = brick.answer(bytes.fromhex(telegram))
        return "" if reply is None else reply.hex(" ").upper()

    return ask


LIMIT_S = 60.0


@dataclass
class Running:
    """An emulator that runs, and its device."""

    process: subprocess.Popen[bytes]
    device: str

    def line(self):
        """Read what it says next."""
        ready, _, _ = select.select([self.process.stdout], [], [], LIMIT_S)
        assert ready, "the emulator says nothing"
        return self.process.stdout.readline().decode().rstrip("\n")


@contextmanager
def _running(*options):
    """Run an emulator, and make sure that it ends."""
    command = [sys.executable, "-m", "probewise", "emulate-nxt", *options]
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        bufsize=0,
        preexec_fn=_mind_interrupts,
    ) as process:
        try:
            running = Running(process, "")
            running.device = running.line()
            running.line()
            yield running
        finally:
            process.kill()


def _mind_interrupts():
    # A test runner in the background ignores Ctrl-C, and its children would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def emulator():
    """Run `probewise emulate-nxt` with some options."""
    return _running
