"""Telegrams as values and back: byte strings of the LEGO NXT's communication protocol, both directions."""

import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from probewise.arm.nxt import BrickError, Reply, TelegramError, decode, encode, framed
from probewise.arm.nxt import telegram as t
from probewise.arm.nxt.telegram import MEANINGS
from probewise.errors import ParameterError

LED_ON, LED_OFF = t.LED_ON, t.LED_OFF

# Command, whether it wants an answer, the frame sent (length first), the frame that comes back, what that says.
LIGHT, RUN = t.get_input_values(1), {"run_state": 0x20}
VECTORS = [
    (t.set_input_type(1, LED_ON), True, "05 00 00 05 01 05 00", "03 00 02 05 00", None),
    (t.set_input_type(1, LED_OFF), False, "05 00 80 05 01 06 00", None, None),
    (LIGHT, True, "03 00 00 07 01", "10 00 02 07 00 01 01 00 05 80 00 02 35 02 37 00 35 02",
     t.InputValues(1, 1, 0, 5, 0x80, 512, 565, 55, 565)),
    (LIGHT, True, "03 00 00 07 01", "10 00 02 07 00 01 00 00 06 00 80 02 78 01 78 01 78 01",
     t.InputValues(1, 0, 0, 6, 0, 640, 376, 376, 376)),
    (t.set_output_state(2, 75, 7, 1, limit_counts=90, **RUN), False, "0C 00 80 04 02 4B 07 01 00 20 5A 00 00 00",
     None, None),
    (t.set_output_state(2, -40, 5, 1, limit_counts=1000, **RUN), True, "0C 00 00 04 02 D8 05 01 00 20 E8 03 00 00",
     "03 00 02 04 00", None),
    (t.set_output_state(0xFF), False, "0C 00 80 04 FF 00 00 00 00 00 00 00 00 00", None, None),
    (t.set_output_state(1, 0, 7, 1, **RUN), False, "0C 00 80 04 01 00 07 01 00 20 00 00 00 00", None, None),
    (t.get_output_state(2), True, "03 00 00 06 02",
     "19 00 02 06 00 02 D8 05 01 00 20 E8 03 00 00 85 FF FF FF 85 FF FF FF D7 11 00 00",
     t.OutputState(2, -40, 5, 1, 0, 0x20, 1000, -123, -123, 4567)),
    (t.reset_rotation_counter(2), True, "04 00 00 0A 02 00", "03 00 02 0A 00", None),
    (t.GET_BATTERY_LEVEL, True, "02 00 00 0B", "05 00 02 0B 00 F4 1C", 7412),
    (t.KEEP_ALIVE, True, "02 00 00 0D", "07 00 02 0D 00 C0 27 09 00", 600000),
    (t.GET_CURRENT_PROGRAM_NAME, True, "02 00 00 11", "17 00 02 11 00 61 72 6D 2E 72 78 65" + 13 * " 00", "arm.rxe"),
    (t.GET_FIRMWARE_VERSION, True, "02 00 01 88", "07 00 02 88 00 7C 01 1F 01",
     t.FirmwareVersion(protocol_minor=124, protocol_major=1, firmware_minor=31, firmware_major=1)),
    (t.GET_DEVICE_INFO, True, "02 00 01 9B",
     "21 00 02 9B 00 41 52 4D 31" + 11 * " 00" + " 00 16 53 0A 0B 0C 00" + 4 * " 00" + " 00 F0 00 00", "ARM1"),
]  # fmt: skip
NAMES = [f"{vector[0].name} {number}" for number, vector in enumerate(VECTORS, start=1)]


def unframed(text):
    frame = bytes.fromhex(text)
    assert int.from_bytes(frame[:2], "little") == len(frame) - 2
    return frame[2:]


@pytest.mark.parametrize(("command", "wants_reply", "sent", "received", "says"), VECTORS, ids=NAMES)
def test_commands_and_answers_have_the_bytes_that_the_protocol_gives_them(command, wants_reply, sent, received, says):
    assert framed(encode(command, wants_reply=wants_reply)) == bytes.fromhex(sent)
    if received is not None:
        assert command.decode_answer(decode(unframed(received))) == says


def test_every_status_but_zero_is_a_clear_error():
    for status in range(1, 256):
        with pytest.raises(BrickError) as caught:
            t.KEEP_ALIVE.decode_answer(Reply(0x0D, status, b""))
        assert MEANINGS.get(status, "no known meaning") in str(caught.value)
        assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


@pytest.mark.parametrize(("fields", "name"), [((3,), "port"), ((-1,), "port"), ((0, 101), "power")])
def test_a_move_of_a_wrong_port_or_power_cannot_be_made(fields, name):
    with pytest.raises(ParameterError) as caught:
        t.set_output_state(*fields)
    assert caught.value.name == name


@pytest.mark.parametrize(
    ("command", "reply", "message"),
    [
        *((t.GET_BATTERY_LEVEL, Reply(0x0B, 0, bytes(n)), f"has 2 bytes; there are {n}: ") for n in (0, 1, 3)),
        (t.GET_BATTERY_LEVEL, Reply(0x0D, 0, bytes(2)), "a reply to opcode 0D came for GETBATTERYLEVEL"),
        (t.get_output_state(1), Reply(0x06, 0, bytes(22)), "an answer about port 0 came for"),
        (t.get_input_values(3), Reply(0x07, 0, bytes(13)), "an answer about port 0 came for"),
    ],
)  # fmt: skip
def test_what_answers_something_else_is_no_answer(command, reply, message):
    with pytest.raises(TelegramError, match=message):
        command.decode_answer(reply)


def test_only_a_move_may_not_be_sent_twice():
    """Limits add up; all else does no more when it is sent twice."""
    assert t.set_output_state(0, 50, 7, 1, run_state=0x20, limit_counts=0).is_repeatable
    assert {vector[0] for vector in VECTORS if not vector[0].is_repeatable} == {
        t.set_output_state(2, 75, 7, 1, run_state=0x20, limit_counts=90),
        t.set_output_state(2, -40, 5, 1, run_state=0x20, limit_counts=1000),
    }


@given(st.sampled_from([vector[0] for vector in VECTORS]), st.integers(0, 255), st.binary(max_size=70))
def test_any_reply_to_any_command_is_an_answer_or_a_clear_error(command, status, body):
    reply = decode(bytes([2, command.opcode, status]) + body)
    try:
        command.decode_answer(reply)
    except (TelegramError, BrickError):
        return
    assert not status
    assert len(body) in (13, 22, 2, 4, 20, 30, 0)
