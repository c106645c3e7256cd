"""Telegrams as values and back: byte strings of the LEGO NXT's communication protocol, both directions."""

import dataclasses
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from probewise.arm.nxt import BrickError, NotYetError, Reply, Request, Sent, TelegramError, decode, encode, framed
from probewise.arm.nxt import telegram as t
from probewise.arm.nxt.status import MEANINGS
from probewise.errors import ParameterError

LIGHT_RAW, LIGHT_PERCENT = t.Mode.RAW, t.Mode.PERCENT
LED_ON, LED_OFF = t.SensorType.LIGHT_ACTIVE, t.SensorType.LIGHT_INACTIVE

# Command, whether it wants an answer, the frame sent (length first), the frame that comes back, what that says.
VECTORS = [
    (t.SetInputMode(1, LED_ON, LIGHT_PERCENT), False, "05 00 80 05 01 05 80", None, None),
    (t.SetInputMode(1, LED_ON, LIGHT_PERCENT), True, "05 00 00 05 01 05 80", "03 00 02 05 00", t.Done()),
    (t.SetInputMode(1, LED_OFF, LIGHT_RAW), False, "05 00 80 05 01 06 00", None, None),
    (
        t.GetInputValues(1),
        True,
        "03 00 00 07 01",
        "10 00 02 07 00 01 01 00 05 80 00 02 35 02 37 00 35 02",
        t.InputValues(1, 1, 0, 5, 0x80, 512, 565, 55, 565),
    ),
    (
        t.GetInputValues(1),
        True,
        "03 00 00 07 01",
        "10 00 02 07 00 01 00 00 06 00 80 02 78 01 78 01 78 01",
        t.InputValues(1, 0, 0, 6, 0, 640, 376, 376, 376),
    ),
    (t.SetOutputState(2, 75, 7, 1, 0, 0x20, 90), False, "0C 00 80 04 02 4B 07 01 00 20 5A 00 00 00", None, None),
    (
        t.SetOutputState(2, -40, 5, 1, 0, 0x20, 1000),
        True,
        "0C 00 00 04 02 D8 05 01 00 20 E8 03 00 00",
        "03 00 02 04 00",
        t.Done(),
    ),
    (t.SetOutputState(0xFF, 0, 0, 0, 0, 0, 0), False, "0C 00 80 04 FF 00 00 00 00 00 00 00 00 00", None, None),
    (t.SetOutputState(1, 0, 7, 1, 0, 0x20, 0), False, "0C 00 80 04 01 00 07 01 00 20 00 00 00 00", None, None),
    (
        t.GetOutputState(2),
        True,
        "03 00 00 06 02",
        "19 00 02 06 00 02 D8 05 01 00 20 E8 03 00 00 85 FF FF FF 85 FF FF FF D7 11 00 00",
        t.OutputState(2, -40, 5, 1, 0, 0x20, 1000, -123, -123, 4567),
    ),
    (t.ResetMotorPosition(2, 0), True, "04 00 00 0A 02 00", "03 00 02 0A 00", t.Done()),
    (t.GetBatteryLevel(), True, "02 00 00 0B", "05 00 02 0B 00 F4 1C", t.BatteryLevel(7412)),
    (t.KeepAlive(), True, "02 00 00 0D", "07 00 02 0D 00 C0 27 09 00", t.SleepLimit(600000)),
    (t.PlayTone(880, 150), False, "06 00 80 03 70 03 96 00", None, None),
    (t.StopSoundPlayback(), True, "02 00 00 0C", "03 00 02 0C 00", t.Done()),
    (t.LsWrite(3, 1, b"\x02\x42"), True, "07 00 00 0F 03 02 01 02 42", "03 00 02 0F 00", t.Done()),
    (t.LsGetStatus(3), True, "03 00 00 0E 03", "04 00 02 0E 00 01", t.LsStatus(1)),
    (t.LsRead(3), True, "03 00 00 10 03", "14 00 02 10 00 01 2A" + 15 * " 00", t.LsData(b"\x2a")),
    (t.MessageWrite(5, b"go\0"), True, "07 00 00 09 05 03 67 6F 00", "03 00 02 09 00", t.Done()),
    (
        t.MessageRead(12, 2, 1),
        True,
        "05 00 00 13 0C 02 01",
        "40 00 02 13 00 02 03 6F 6B 00" + 56 * " 00",
        t.Message(2, b"ok\0"),
    ),
    (
        t.StartProgram("arm.rxe"),
        True,
        "16 00 00 00 61 72 6D 2E 72 78 65" + 13 * " 00",
        "03 00 02 00 00",
        t.Done(),
    ),
    (t.StopProgram(), True, "02 00 00 01", "03 00 02 01 00", t.Done()),
    (
        t.GetCurrentProgramName(),
        True,
        "02 00 00 11",
        "17 00 02 11 00 61 72 6D 2E 72 78 65" + 13 * " 00",
        t.ProgramName("arm.rxe"),
    ),
    (
        t.GetFirmwareVersion(),
        True,
        "02 00 01 88",
        "07 00 02 88 00 7C 01 1F 01",
        t.FirmwareVersion(protocol_minor=124, protocol_major=1, firmware_minor=31, firmware_major=1),
    ),
    (
        t.GetDeviceInfo(),
        True,
        "02 00 01 9B",
        "21 00 02 9B 00 41 52 4D 31" + 11 * " 00" + " 00 16 53 0A 0B 0C 00" + 4 * " 00" + " 00 F0 00 00",
        t.DeviceInfo("ARM1", bytes.fromhex("0016530A0B0C00"), bytes(4), 61440),
    ),
    (t.SetBrickName("ARM1"), True, "12 00 01 98 41 52 4D 31" + 12 * " 00", "03 00 02 98 00", t.Done()),
    (t.ResetInputScaledValue(0), True, "03 00 00 08 00", "03 00 02 08 00", t.Done()),
]
NAMES = [f"{vector[0].name} {number}" for number, vector in enumerate(VECTORS, start=1)]

# Command, the frame of a refusal or of nothing yet, its status.
REFUSED = [
    (t.GetInputValues(3), "10 00 02 07 C0" + 13 * " 00", 0xC0),
    (t.GetInputValues(3), "03 00 02 07 C0", 0xC0),
    (t.GetOutputState(2), "19 00 02 06 C0" + 22 * " 00", 0xC0),
    (t.SetOutputState(2, 10, 1, 0, 0, 0x20, 0), "03 00 02 04 C0", 0xC0),
    (t.LsGetStatus(3), "04 00 02 0E 20 00", 0x20),
    (t.MessageWrite(5, b"go\0"), "03 00 02 09 EC", 0xEC),
    (t.MessageRead(12, 2, 1), "40 00 02 13 EC 02 00" + 59 * " 00", 0xEC),
    (t.MessageRead(12, 2, 1), "40 00 02 13 40 02 00" + 59 * " 00", 0x40),
    (t.StartProgram("arm.rxe"), "03 00 02 00 C0", 0xC0),
    (t.StartProgram("arm.rxe"), "03 00 02 00 BD", 0xBD),
    (t.GetCurrentProgramName(), "17 00 02 11 EC" + 20 * " 00", 0xEC),
    (t.KeepAlive(), "03 00 02 0D BE", 0xBE),
]


def unframed(text):
    frame = bytes.fromhex(text)
    assert int.from_bytes(frame[:2], "little") == len(frame) - 2
    return frame[2:]


@pytest.mark.parametrize("vector", VECTORS, ids=NAMES)
def test_a_command_has_the_bytes_that_the_protocol_gives_it(vector):
    command, wants_reply, sent, _, _ = vector
    assert framed(encode(command, wants_reply=wants_reply)) == bytes.fromhex(sent)
    assert decode(unframed(sent)) == Sent(command, wants_reply)


@pytest.mark.parametrize("vector", VECTORS, ids=NAMES)
def test_an_answer_says_what_the_protocol_says_it_does(vector):
    command, wants_reply, _, received, says = vector
    if not wants_reply:
        assert received is None
        return
    reply = decode(unframed(received))
    assert isinstance(reply, Reply)
    assert command.answer(reply) == says
    # And back.
    assert framed(Reply(command.OPCODE, 0, says.pack()).pack()) == bytes.fromhex(received)


def test_the_vectors_cover_every_command():
    assert {type(vector[0]) for vector in VECTORS} == set(t.REQUESTS.values())
    assert len(t.REQUESTS) == 21


@pytest.mark.parametrize(
    ("command", "received", "status"), REFUSED, ids=[f"{r[0].name} {k}" for k, r in enumerate(REFUSED)]
)
def test_a_refusal_is_an_error_that_says_why_whatever_its_length(command, received, status):
    reply = decode(unframed(received))
    with pytest.raises(BrickError, match=f"{command.name} with status {status:02X}: ") as caught:
        command.answer(reply)
    assert caught.value.status == status
    assert isinstance(caught.value, NotYetError) == (status in (0x20, 0x40))


def test_every_status_but_zero_is_a_clear_error():
    for status in range(1, 256):
        with pytest.raises(BrickError) as caught:
            t.KeepAlive().answer(Reply(0x0D, status, b""))
        assert MEANINGS.get(status, "no known meaning") in str(caught.value)
        assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_the_version_and_the_address_can_be_read():
    info = t.GetDeviceInfo().answer(decode(unframed(VECTORS[-3][3])))
    assert info.address_text == "00:16:53:0A:0B:0C"


WRONG = [
    (
        t.SetOutputState,
        (
            3,
            0,
            0,
            0,
            0,
            0,
            0,
        ),
        "port",
    ),
    (
        t.SetOutputState,
        (
            0,
            101,
            0,
            0,
            0,
            0,
            0,
        ),
        "power",
    ),
    (
        t.SetOutputState,
        (
            0,
            -128,
            0,
            0,
            0,
            0,
            0,
        ),
        "power",
    ),
    (
        t.SetOutputState,
        (
            0,
            0,
            8,
            0,
            0,
            0,
            0,
        ),
        "mode",
    ),
    (
        t.SetOutputState,
        (
            0,
            0,
            0,
            3,
            0,
            0,
            0,
        ),
        "regulation",
    ),
    (
        t.SetOutputState,
        (
            0,
            0,
            0,
            0,
            101,
            0,
            0,
        ),
        "turn_ratio",
    ),
    (
        t.SetOutputState,
        (
            0,
            0,
            0,
            0,
            0,
            0x30,
            0,
        ),
        "run_state",
    ),
    (
        t.SetOutputState,
        (
            0,
            0,
            0,
            0,
            0,
            0,
            -1,
        ),
        "limit_counts",
    ),
    (
        t.SetOutputState,
        (
            0,
            0,
            0,
            0,
            0,
            0,
            2**32,
        ),
        "limit_counts",
    ),
    (
        t.SetOutputState,
        (
            0,
            1.0,
            0,
            0,
            0,
            0,
            0,
        ),
        "power",
    ),
    (
        t.SetOutputState,
        (
            True,
            0,
            0,
            0,
            0,
            0,
            0,
        ),
        "port",
    ),
    (t.GetOutputState, (255,), "port"),
    (
        t.ResetMotorPosition,
        (
            0,
            2,
        ),
        "relative",
    ),
    (t.GetInputValues, (4,), "port"),
    (
        t.SetInputMode,
        (
            0,
            0x13,
            0,
        ),
        "type",
    ),
    (
        t.SetInputMode,
        (
            0,
            0,
            256,
        ),
        "mode",
    ),
    (
        t.PlayTone,
        (
            199,
            1,
        ),
        "frequency_hz",
    ),
    (
        t.PlayTone,
        (
            14001,
            1,
        ),
        "frequency_hz",
    ),
    (
        t.PlayTone,
        (
            440,
            65536,
        ),
        "duration_ms",
    ),
    (
        t.LsWrite,
        (
            0,
            17,
            b"",
        ),
        "n_answer",
    ),
    (
        t.LsWrite,
        (
            0,
            0,
            bytes(17),
        ),
        "data",
    ),
    (
        t.MessageWrite,
        (
            20,
            b"\0",
        ),
        "mailbox",
    ),
    (
        t.MessageWrite,
        (
            0,
            b"",
        ),
        "data",
    ),
    (
        t.MessageWrite,
        (
            0,
            b"no end",
        ),
        "data",
    ),
    (
        t.MessageWrite,
        (
            0,
            bytes(60),
        ),
        "data",
    ),
    (
        t.MessageRead,
        (
            20,
            0,
            0,
        ),
        "mailbox",
    ),
    (t.StartProgram, ("",), "file"),
    (t.StartProgram, ("x" * 20,), "file"),
    (t.StartProgram, ("ä.rxe",), "file"),
    (t.SetBrickName, ("a\nb",), "brick_name"),
    (t.SetBrickName, ("x" * 16,), "brick_name"),
    (
        t.DeviceInfo,
        (
            "n",
            bytes(6),
            bytes(4),
            0,
        ),
        "address",
    ),
    (t.ProgramName, ("a\0b",), "file"),
]


@pytest.mark.parametrize(
    ("command", "fields", "name"), WRONG, ids=[f"{w[0].__name__} {k}" for k, w in enumerate(WRONG)]
)
def test_a_value_out_of_bounds_cannot_be_made(command, fields, name):
    with pytest.raises(ParameterError) as caught:
        command(*fields)
    assert caught.value.name == name


@pytest.mark.parametrize(
    ("telegram", "says"),
    [
        ("", "type and an opcode"),
        ("00", "type and an opcode"),
        ("02 07", "a reply has a status"),
        ("03 07 00", "type 03 is none"),
        ("82 07 00", "type 82 is none"),
        ("00 55", "opcode 55 is no direct command"),
        ("00 88", "opcode 88 is no direct command"),
        ("01 0D", "opcode 0D is no system command"),
        ("00 07", "1 bytes or more for port; there are 0"),
        ("00 07 04", "port is 4; allowed: a whole number from 0 to 3"),
        ("00 06 07", "port is 7"),
        ("00 04 03 0A 01 00 00 20 00 00 00 00", "port is 3; allowed: a whole number from 0 to 2 or 255"),
        ("00 0D 00", "0 bytes; there are 1"),
        ("00 09 05 04 67 6F 00", "a count and as many bytes"),
        ("00 09 05 02 67 6F", "bytes of which the last is 0"),
        ("00 0F 03 02 01 02", "a count and as many bytes"),
        ("01 98" + 17 * " 41", "bytes that end with 00"),
    ],
)
def test_bytes_that_are_no_telegram_are_refused_with_the_reason(telegram, says):
    with pytest.raises(TelegramError) as caught:
        decode(bytes.fromhex(telegram))
    assert says in str(caught.value)


@pytest.mark.parametrize("body", ["", "F4", "F4 1C 00"])
def test_an_answer_of_another_length_is_refused(body):
    with pytest.raises(TelegramError, match="BatteryLevel cannot be read from"):
        t.GetBatteryLevel().answer(Reply(0x0B, 0, bytes.fromhex(body)))


def test_a_reply_to_another_command_is_no_answer():
    with pytest.raises(TelegramError, match="a reply to opcode 0D came for GETBATTERYLEVEL"):
        t.GetBatteryLevel().answer(Reply(0x0D, 0, bytes(2)))


def test_a_name_that_others_send_in_a_shorter_field_is_the_same_name():
    """Some clients send 15 bytes, or the name and one NUL."""
    for padding in (1, 11, 12):
        assert decode(bytes.fromhex("01 98") + b"ARM1" + bytes(padding)) == Sent(t.SetBrickName("ARM1"), True)


def test_garbage_behind_the_end_of_a_text_is_left_out():
    said = t.ProgramName.unpack(b"arm.rxe\0leftover".ljust(20, b"\xff"))
    assert said == t.ProgramName("arm.rxe")


def test_only_what_does_no_more_when_sent_twice_may_be_repeated():
    assert t.SetOutputState(0, 50, 7, 1, 0, 0x20, 0).repeatable
    assert not t.SetOutputState(0, 50, 7, 1, 0, 0x20, 90).repeatable
    once = {command for command in t.REQUESTS.values() if not _example(command).repeatable}
    assert once == {t.StartProgram, t.SetOutputState, t.MessageWrite, t.LsWrite, t.LsRead, t.MessageRead}


def _example(command):
    return next(vector[0] for vector in VECTORS if type(vector[0]) is command)


@given(st.binary(max_size=70))
def test_any_bytes_are_a_value_or_a_clear_error(telegram):
    try:
        value = decode(telegram)
    except TelegramError:
        return
    if isinstance(value, Sent):
        # What was understood is written again as something that is understood alike.
        assert decode(encode(value.request, wants_reply=value.wants_reply)) == value
    else:
        assert value.pack() == telegram


@given(st.sampled_from(sorted(t.REQUESTS)), st.sampled_from([0x00, 0x80]), st.binary(max_size=66))
def test_any_body_of_any_command_is_a_value_or_a_clear_error(opcode, no_reply, body):
    first = (1 if opcode >= 0x80 else 0) | no_reply
    try:
        value = decode(bytes([first, opcode]) + body)
    except TelegramError:
        return
    assert isinstance(value, Sent)
    assert decode(encode(value.request, wants_reply=value.wants_reply)) == value


@given(st.sampled_from(sorted(t.REQUESTS)), st.integers(0, 255), st.binary(max_size=70))
def test_any_reply_to_any_command_is_an_answer_or_a_clear_error(opcode, status, body):
    request = _example(t.REQUESTS[opcode])
    try:
        answer = request.answer(Reply(opcode, status, body))
    except (TelegramError, BrickError):
        return
    assert not status
    assert type(answer) is request.REPLY
    assert request.REPLY.unpack(answer.pack()) == answer


@given(st.data())
def test_any_allowed_output_state_comes_back_from_its_bytes(data):
    power, limit = data.draw(st.integers(-100, 100)), data.draw(st.integers(0, 2**32 - 1))
    run_state = data.draw(st.sampled_from(list(t.RunState)))
    command = t.SetOutputState(data.draw(st.sampled_from([0, 1, 2, 255])), power, 7, 1, 0, run_state, limit)
    assert decode(encode(command)) == Sent(command, True)
    assert len(encode(command)) == 12


def test_telegrams_are_values():
    command = t.GetInputValues(1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        command.port = 2
    assert isinstance(command, Request)
    assert hash(command) == hash(t.GetInputValues(1))
