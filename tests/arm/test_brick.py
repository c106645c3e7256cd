"""Light sensor, battery, and a brick that leaves nothing running."""

import math
import sys

import pytest

from probewise.arm.nxt import (
    Brick,
    BrickError,
    LightSensor,
    Link,
    SensorError,
    SerialPort,
    TelegramError,
    normalized_from_counts,
    percent_from_counts,
)
from probewise.errors import LinkError, LowBatteryWarning, ParameterError

ALL_COAST = bytes.fromhex("04 FF" + 9 * " 00")


@pytest.fixture
def brick(paper_brick, clock):
    return Brick(Link(paper_brick, clock=clock), clock=clock)


@pytest.mark.parametrize(
    ("raw", "normalized", "percent"),
    [(0, 1023, 100), (200, 1023, 100), (300, 876, 85), (500, 582, 56), (512, 565, 55), (640, 376, 36), (700, 288, 28),
     (842, 79, 7), (896, 0, 0), (1023, 0, 0)],
)  # fmt: skip
def test_counts_are_converted_as_the_firmware_does(raw, normalized, percent):
    """LEGO's firmware, types 05 and 06, in whole numbers."""
    assert (normalized_from_counts(raw), math.floor(percent_from_counts(raw))) == (normalized, percent)
    assert percent_from_counts(raw) == pytest.approx(100 * normalized / 1023)


@pytest.mark.parametrize("raw", [-1, 1024])
def test_counts_that_no_converter_gives_are_refused(raw):
    with pytest.raises(ParameterError, match="0 to 1023"):
        normalized_from_counts(raw)


def test_a_flash_gives_a_reading_and_leaves_the_led_off_even_where_the_reading_fails(brick, paper_brick, clock):
    light = brick.light_sensor(1)
    assert [light.flash() for _ in range(2)] == [500, 500]
    set_types = [body[3] for body in paper_brick.commands if body[1] == 0x05]
    assert set_types == [5, 0, 5, 0]
    paper_brick.raw_counts = 1024
    with pytest.raises(TelegramError, match=r"input 2 says .*raw=1024,.* contradict each other"):
        light.flash()
    assert paper_brick.input[0] == 0


def test_a_sensor_that_never_becomes_valid_is_told_of(paper_brick, clock):
    light = LightSensor(Link(paper_brick, clock=clock), 1, clock=clock)
    light.set_led()
    paper_brick.input[2] = 1e9
    with pytest.raises(SensorError, match=r"input 2 gave no valid reading for 1 s; is the light sensor plugged in\?"):
        light.read()


def changed(at, byte):
    """Put another byte into an answer."""
    return lambda answer: answer[:at] + bytes([byte]) + answer[at + 1 :]


# Bytes 0 to 2 are type, opcode and status; 3 port, 4 valid, 5 calibrated, 6 type, 7 mode, then four words.
@pytest.mark.parametrize("at", range(3, 16))
@pytest.mark.parametrize("byte", [0x03, 0xFF])
def test_a_byte_of_a_reading_that_was_changed_on_its_way_changes_no_reading(brick, paper_brick, at, byte):
    light = brick.light_sensor(1)
    assert light.read() == 500
    paper_brick.alter[len(paper_brick.commands)] = changed(at, byte)
    assert normalized_from_counts(light.read()) == normalized_from_counts(500)


def test_a_voltage_that_is_another_every_time_is_told_of(brick, paper_brick):
    carry_out = paper_brick.carry_out

    def wild(opcode, body):
        paper_brick.millivolt += 100
        return carry_out(opcode, body)

    paper_brick.carry_out = wild
    with pytest.raises(LinkError, match="another battery voltage each of 6 times"):
        brick.battery_mv()


def test_a_battery_below_6_volts_is_warned_of_once(brick, paper_brick):
    paper_brick.millivolt = 6000
    assert brick.battery_mv() == 6000
    paper_brick.millivolt = 5990
    with pytest.warns(LowBatteryWarning, match=r"the NXT's battery is at 5\.99 V, below 6 V: motors slow down"):
        assert brick.battery_mv() == 5990
    paper_brick.millivolt = 5980
    assert brick.battery_mv() == 5980


def test_the_brick_says_who_it_is_and_what_runs_on_it(brick, paper_brick):
    assert brick.name() == "ARM1"
    assert (brick.version().firmware_major, brick.version().firmware_minor) == (1, 31)
    assert brick.running_program() is None
    paper_brick.statuses = {}
    assert brick.running_program() == "dance.rxe"
    paper_brick.statuses = {0x11: 0xFB}
    with pytest.raises(BrickError, match="out of memory"):
        brick.running_program()


def test_leaving_the_block_stops_and_releases_the_motors_and_switches_the_led_off(brick, paper_brick):
    """Each once without an answer, which needs nothing to be heard, and once to be sure."""
    with brick:
        brick.motor(0).move_to(500, 1)
        brick.light_sensor(2).set_led()
    dark = bytes.fromhex("05 02 00 00")
    ends = [(body[0], body[1:]) for body in paper_brick.commands[-4:]]
    assert ends == [(0x80, ALL_COAST), (0x80, dark), (0x00, ALL_COAST), (0x00, dark)]
    assert paper_brick.input[0] == 0
    assert not paper_brick.is_open
    assert paper_brick.at_rest


@pytest.mark.parametrize("refused", [0x04, 0x05])
def test_a_refusal_of_one_end_keeps_nothing_from_the_other(brick, paper_brick, refused):
    def run():
        with brick:
            brick.light_sensor(2).set_led()
            paper_brick.motors[1].command(100.0, 50, 0x20, 0)
            paper_brick.statuses = {refused: 0xDE}

    with pytest.raises(BrickError, match="DE"):
        run()
    assert paper_brick.at_rest == (refused != 0x04)
    assert (paper_brick.input[0] == 0) == (refused != 0x05)
    assert not paper_brick.is_open


def test_motors_and_led_are_off_also_where_no_answer_comes(brick, paper_brick):
    """What is told arrives, though nothing that is asked is answered."""

    def run():
        with brick:
            brick.light_sensor(2).set_led()
            paper_brick.motors[1].command(100.0, 50, 0x20, 0)
            paper_brick.lose = dict.fromkeys(range(len(paper_brick.commands), 10**3), "answer")

    with pytest.raises(LinkError, match="does not answer any more"):
        run()
    assert paper_brick.at_rest
    assert paper_brick.input[0] == 0


def test_ctrl_c_in_the_middle_of_a_question_stops_the_motors(brick, paper_brick):
    """The answer that was not waited for is not taken for that of the stop."""
    answer = paper_brick.read

    def interrupted(size, timeout_s):
        if not timeout_s:  # a look before the question is sent
            return b""
        paper_brick.read = answer
        raise KeyboardInterrupt

    def run():
        with brick:
            paper_brick.motors[1].command(100.0, 50, 0x20, 0)
            paper_brick.read = interrupted
            brick.battery_mv()

    with pytest.raises(KeyboardInterrupt):
        run()
    assert paper_brick.at_rest
    assert not paper_brick.is_open


@pytest.mark.parametrize(("error", "told"), [(KeyError("this"), KeyError), (None, LinkError)])
def test_a_line_that_dies_is_told_of_but_hides_no_error_before(brick, paper_brick, error, told):
    def run():
        with brick:
            paper_brick.is_cut = True
            if error:
                raise error

    with pytest.raises(told, match=r"this|cut"):
        run()
    assert not paper_brick.is_open


def test_a_port_that_is_not_there_is_an_error_in_words(tmp_path):
    pytest.importorskip("serial", reason="pyserial is not installed")
    with pytest.raises(LinkError, match=r"cannot be opened .*is the brick on, paired and bound") as caught:
        SerialPort.open(str(tmp_path / "rfcomm0"))
    assert "rfcomm0" in str(caught.value)


def test_without_pyserial_the_rest_works_and_opening_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(LinkError, match=r"pip install pyserial$"):
        Brick.open("/dev/rfcomm0")
