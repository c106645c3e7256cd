"""Light sensor, battery, and a brick that leaves nothing running."""

import math
import sys

import pytest

from probewise.arm.nxt import Brick, Light, LightReading, Link, SensorError, SerialPort, normalized_of
from probewise.errors import LinkError, ParameterError

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
    reading = LightReading(raw)
    assert (reading.normalized, reading.percent) == (normalized, percent)
    assert reading.fine_percent == pytest.approx(100 * normalized / 1023)


def test_whole_percent_are_the_fine_ones_without_their_fraction():
    readings = [LightReading(raw) for raw in range(1024)]
    assert [math.floor(reading.fine_percent) for reading in readings] == [reading.percent for reading in readings]


def test_only_697_values_occur():
    assert len({normalized_of(raw) for raw in range(1024)}) == 697


@pytest.mark.parametrize("raw", [-1, 1024])
def test_counts_that_no_converter_gives_are_refused(raw):
    with pytest.raises(ParameterError, match="0 to 1023"):
        normalized_of(raw)


def test_a_reading_that_is_not_valid_yet_is_left_out(brick, paper_brick):
    """For a while after a change of type the brick shows the old value; here it is 1000 counts."""
    light = brick.light(1)
    light.light_up()
    assert light.read().raw_counts == 500
    assert paper_brick.input[:2] == [5, 0]
    light.light_up(False)
    assert light.read().raw_counts == 500
    assert paper_brick.input[:2] == [6, 0]


def test_the_led_is_on_unless_it_was_switched_off(brick, paper_brick):
    assert brick.light(1).read().percent == 56
    assert paper_brick.input[:2] == [5, 0]


def test_a_sensor_that_a_program_has_reset_is_set_up_again(brick, paper_brick, clock):
    light = brick.light(1)
    light.light_up(False)
    paper_brick.input = [0, 0, 0.0]
    assert light.read().raw_counts == 500
    assert paper_brick.input[:2] == [6, 0]


def test_a_sensor_that_never_becomes_valid_is_told_of(paper_brick, clock):
    light = Light(Link(paper_brick, clock=clock), 1, clock=clock)
    light.light_up()
    paper_brick.input[2] = 1e9
    with pytest.raises(SensorError, match=r"input 2 gave no valid reading for 1 s; is the light sensor plugged in\?"):
        light.read()


def test_the_battery_is_read_in_millivolt(brick):
    assert brick.battery_mv() == 7412


def test_leaving_the_block_stops_and_releases_the_motors(brick, paper_brick):
    with brick:
        brick.motor(0).move_to(500, 1)
        brick.light(2).light_up()
    stops = [body for body in paper_brick.commands if body[1:] == ALL_COAST]
    # Once without an answer, which needs nothing to be heard, and once to be sure.
    assert [body[0] for body in stops] == [0x80, 0x00]
    assert paper_brick.input[0] == 0  # and the LED is off
    assert not paper_brick.is_open
    assert paper_brick.at_rest


@pytest.mark.parametrize("error", [KeyError, KeyboardInterrupt, LinkError])
def test_leaving_it_by_an_exception_does_too(brick, paper_brick, error):
    def fail():
        with brick:
            paper_brick.motors[1].command(100.0, 50, 0x20, 0)
            raise error("x")

    with pytest.raises(error):
        fail()
    assert paper_brick.at_rest
    assert not paper_brick.is_open


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


def test_a_dead_line_does_not_hide_what_went_wrong_before(brick, paper_brick):
    def run():
        with brick:
            paper_brick.is_cut = True
            raise KeyError("this")

    with pytest.raises(KeyError, match="this"):
        run()
    assert not paper_brick.is_open


def test_a_line_that_dies_before_the_end_is_told_of(brick, paper_brick):
    def run():
        with brick:
            paper_brick.is_cut = True

    with pytest.raises(LinkError, match="cut"):
        run()
    assert not paper_brick.is_open


def test_a_port_that_is_not_there_is_an_error_in_words(tmp_path):
    pytest.importorskip("serial", reason="pyserial is not installed")
    with pytest.raises(LinkError, match=r"cannot be opened .*is the brick on, paired and bound") as caught:
        SerialPort.open(str(tmp_path / "rfcomm0"))
    assert "rfcomm0" in str(caught.value)


def test_without_pyserial_the_rest_works_and_opening_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(LinkError, match=r"pip install 'probewise\[nxt\]'"):
        Brick.open("/dev/rfcomm0")
