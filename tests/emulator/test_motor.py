"""Motors, their firmware and input ports, on a clock that tests move."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from probewise.emulator import Brick, Motor, VirtualClock, empty_port
from probewise.emulator.motors import IDLE, OutputPort, OutputSetting

RUN, COAST, HOLD = "07 01 00 20", "00 00 00 00", "00 07 01 00 20 00 00 00 00"


def little(value):
    return value.to_bytes(4, "little").hex(" ")


def turn(ask, power, limit, *, how=RUN, port=0):
    ask(f"80 04 {port:02X} {power & 0xFF:02X} {how} {little(limit)}")


def wait(clock, brick, seconds):
    """Let time pass and return port A."""
    clock.sleep(seconds)
    brick.advance()
    return brick.outputs.ports[0]


def coasted(speed_deg_s, motor):
    """Integrate speed' = -speed/T - f to standstill: T v - f T^2 ln(1 + v / (f T))."""
    t, f = motor.coasting_s, motor.friction_deg_s2
    return t * speed_deg_s - f * t * t * math.log1p(speed_deg_s / (f * t))


def test_a_coasting_motor_stops_where_the_integral_says():
    motor = Motor(speed_deg_s=600.0)
    for _ in range(2000):
        motor.step(1e-3, 0, brake=False, battery_mv=7400)
    assert motor.angle_deg == pytest.approx(coasted(600.0, motor), rel=0.01)
    assert motor.speed_deg_s == 0


def test_the_regulator_is_the_firmwares_by_hand():
    """Power is half of 3 e (to 100), the sum of errors (3 s + e) / 4, and the change of e, all in whole numbers."""
    port = OutputPort(Motor(stops_deg=(0.0, 0.0)))
    port.apply_setting(OutputSetting(20, 7, 1, 0, 0x20))
    powers = []
    for _ in range(3):  # e = 20, 40, 60: s = 5, 13, 24
        for _ in range(101):
            port.simulate_millisecond(7400.0)
        powers.append(port.power)
    assert powers == [(60 + 5 + 20) // 2, (100 + 13 + 20) // 2, (100 + 24 + 20) // 2]


def test_a_limited_run_overshoots_as_published_and_shows_idle_before_it_rests(ask, clock, brick):
    """360 asked for, 420 measured (plain limit, coasting)."""
    turn(ask, 75, 360)
    port = brick.outputs.ports[0]
    while port.run_state != IDLE:
        wait(clock, brick, 0.001)
    at_limit = port.tacho_count
    assert 360 <= at_limit <= 362
    assert port.motor.speed_deg_s > 400
    wait(clock, brick, 1.0)
    assert port.motor.speed_deg_s == 0
    assert 400 <= port.tacho_count <= 440


def test_hold_brings_a_pushed_motor_back_and_coasting_does_not(ask, clock, brick):
    ask(f"80 04 00 {HOLD}")
    port = wait(clock, brick, 0.5)
    port.motor.angle_deg += 20
    port.motor.speed_deg_s = 1.0
    assert abs(wait(clock, brick, 2.0).tacho_count) <= 3
    ask(f"80 04 00 00 {COAST} 00 00 00 00")
    port.motor.angle_deg += 20
    assert wait(clock, brick, 2.0).tacho_count >= 17


def test_overshoot_is_taken_off_the_next_run_in_the_same_direction(ask, clock, brick):
    """The goal runs on from where the last run should have ended."""
    for _ in range(2):
        turn(ask, 75, 360)
        port = wait(clock, brick, 2.0)
    assert 720 + 40 <= port.tacho_count <= 720 + 80


def test_a_motor_stands_still_at_its_stop():
    motor = Motor(stops_deg=(-50.0, 100.0))
    for _ in range(1000):
        motor.step(1e-3, 80, brake=False, battery_mv=7400)
    assert (motor.angle_deg, motor.speed_deg_s) == (100.0, 0.0)


def test_the_brick_sleeps_unless_it_is_kept_awake(ask, clock, brick):
    """Only KEEPALIVE counts; asleep, it answers nothing and its motors coast."""
    clock.sleep(599.0)
    assert ask("00 0D") == "02 0D 00 C0 27 09 00"
    clock.sleep(598.0)
    assert ask("00 0B") != ""
    turn(ask, 50, 0)
    clock.sleep(3.0)
    assert ask("00 0B") == ""
    assert brick.is_off
    wait(clock, brick, 2.0)
    assert brick.outputs.ports[0].motor.speed_deg_s == 0


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
