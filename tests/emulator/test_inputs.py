"""Input ports: what the firmware makes of a voltage, and when it says that it is valid."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from probewise.emulator import Brick, VirtualClock, empty_port


class Fixed:
    def __init__(self, value):
        self.value = value

    def __call__(self, lit):
        return self.value


def values(ask):
    """Read port 2: valid, raw, normalized, scaled."""
    valid, _, _, _, raw, normalized, scaled, _ = struct.unpack("<BBBBHHhh", bytes.fromhex(ask("00 07 01"))[4:])
    return valid, raw, normalized, scaled


def light_brick(clock, sensor):
    return Brick(clock, sensors=[empty_port, sensor, empty_port, empty_port])


def asking(brick):
    return lambda telegram: (brick.answer(bytes.fromhex(telegram)) or b"").hex(" ").upper()


@pytest.mark.parametrize(
    ("raw", "normalized", "percent"),
    [(0, 1023, 100), (200, 1023, 100), (300, 876, 85), (500, 582, 56), (700, 288, 28), (842, 79, 7), (1023, 0, 0)],
)
def test_light_is_scaled_as_the_firmware_does(clock, raw, normalized, percent):
    ask = asking(light_brick(clock, Fixed(raw)))
    for mode, scaled in (("00", normalized), ("80", percent)):
        ask(f"80 05 01 05 {mode}")
        clock.sleep(0.1)
        assert values(ask) == (1, raw, normalized, scaled)


def test_readings_are_invalid_for_20_ms_after_a_change_of_type_and_show_the_old_values(ask, clock):
    ask("80 05 01 05 80")
    clock.sleep(0.1)
    lit = values(ask)
    assert lit[0] == 1
    ask("80 05 01 06 80")
    for _ in range(20):
        assert values(ask) == (0, *lit[1:])
        clock.sleep(0.001)
    clock.sleep(0.001)
    dark = values(ask)
    assert dark[0] == 1
    assert dark[3] == 28
    assert lit[3] == 57


@given(telegrams=st.lists(st.binary(max_size=70), max_size=6))
def test_the_brick_answers_any_bytes_with_a_reply_or_not_at_all(telegrams):
    clock = VirtualClock()
    brick = Brick(clock)
    for telegram in telegrams:
        reply = brick.answer(telegram)
        clock.sleep(0.01)
        if reply is not None:
            assert telegram[0] in (0, 1)
            assert reply[:2] == bytes((2, telegram[1]))
            assert 3 <= len(reply) <= 64
