"""Telegrams as bytes, both directions, and the link on a line where they come in pieces, late, twice, or not at all."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from probewise.arm.nxt import BrickError, Link, NoAnswerError, Reply, TelegramError, decode, encode, framed
from probewise.arm.nxt import telegram as t
from probewise.arm.nxt.link import LONGEST_S
from probewise.arm.nxt.telegram import MEANINGS
from probewise.errors import LinkError, ParameterError

ASLEEP, AWAKE = "02 00 00 0D", "07 00 02 0D 00 C0 27 09 00"
BATTERY, VOLTS = "02 00 00 0B", "05 00 02 0B 00 F4 1C"
LIGHT = "03 00 00 07 01"
BRIGHT = "10 00 02 07 00 01 01 00 05 80 00 02 35 02 37 00 35 02"
DARK = "10 00 02 07 00 01 01 00 05 80 00 03 10 00 01 00 10 00"
MOVE, MOVED = "0C 00 00 04 00 32 07 01 00 20 5A 00 00 00", "03 00 02 04 00"
STATE = "03 00 00 06 00"
RUNNING = "19 00 02 06 00 00 32 07 01 00 20 5A 00 00 00" + 12 * " 00"
FENCE = (BATTERY, (0.06, VOLTS))

read = t.get_input_values(1)
move = t.set_output_state(0, 50, 7, 1, run_state=0x20, limit_counts=90)


@pytest.fixture
def link(script, clock):
    """A link that has made sure of its line and told the brick to stay awake."""
    script.expect(*FENCE)
    script.expect(ASLEEP, (0.06, AWAKE))
    link = Link(script, clock=clock)
    link.keep_awake()
    yield link
    script.finish()


AGAIN = (LIGHT, (0.06, BRIGHT))
REFUSAL = "03 00 02 07 C0"
TORN = [
    BRIGHT[3:],  # the first byte is lost
    BRIGHT[:30] + BRIGHT[33:],  # one in the middle
    "FF FF" + BRIGHT,
    "00 00" + BRIGHT,
    "04 00 02 07 00 00",
    "05 00 02 0B 00 F4 1C",  # an answer to a question that was not asked
    BRIGHT.replace("07 00 01", "07 00 02", 1),  # one about another port
]
EXCHANGES = {
    "in pieces": [(LIGHT, *((0.05 + 0.02 * k, f"{byte:02X}") for k, byte in enumerate(bytes.fromhex(BRIGHT))))],
    # A program on the brick sends messages, type 80; a type nobody knows is passed over too.
    "among others": [(LIGHT, (0.03, "07 00 80 09 00 03 68 69 00"), (0.04, "02 00 7F 7F"), (0.06, BRIGHT))],
    # A status may be a byte that was changed on its way, or a shortage of the brick's that passes.
    "refused once": [(LIGHT, (0.06, REFUSAL)), AGAIN],
    **{f"torn {k}": [(LIGHT, (0.06, broken)), FENCE, AGAIN] for k, broken in enumerate(TORN)},
    # The old answer says dark. It comes while the line is drained, or before the fence's.
    **{
        f"{late_s} s late": [(LIGHT, (late_s, DARK)), (BATTERY, (max(late_s - 2.2, 0.06) + 0.01, VOLTS)), AGAIN]
        for late_s in (2.05, 2.19, 2.3, 2.9, 3.9)
    },
    # Battery's answer comes 3 s late, when the version has been asked for.
    "behind a late fence": [
        (LIGHT,),
        (BATTERY, (3.0, VOLTS)),
        ("02 00 01 88", (1.0, "07 00 02 88 00 7C 01 1F 01")),
        AGAIN,
    ],
}


@pytest.mark.parametrize("exchanges", EXCHANGES.values(), ids=EXCHANGES)
def test_the_answer_is_found_whatever_comes_before_it(link, script, exchanges):
    for exchange in exchanges:
        script.expect(*exchange)
    assert link.ask(read).normalized == 565


def test_an_answer_that_was_there_before_its_question_is_none(link, script):
    """It came twice: the second is dropped, and a fence makes sure that nothing follows."""
    script.expect(LIGHT, (0.06, DARK + DARK))
    assert link.ask(read).raw == 0x300
    script.expect(*FENCE)
    script.expect(LIGHT, (0.06, BRIGHT))
    assert link.ask(read).raw == 0x200


@pytest.mark.parametrize(
    ("answer", "error", "words"),
    [
        ((), NoAnswerError, r"SETOUTPUTSTATE within 2 s on /dev/rfcomm0; is the brick on"),
        (((2.1, MOVED),), NoAnswerError, "SETOUTPUTSTATE"),
        (((0.06, "04 00 02 04 00 00"),), TelegramError, "SETOUTPUTSTATE has 0 bytes"),
    ],
    ids=["none", "late", "torn"],
)
def test_a_move_is_sent_once_whatever_becomes_of_its_answer(link, script, answer, error, words):
    """Limits add up: sent twice, it would go twice as far. The next question has its own answer."""
    script.expect(MOVE, *answer)
    with pytest.raises(error, match=words):
        link.ask(move)
    script.expect(*FENCE)
    script.expect(STATE, (0.06, RUNNING))
    assert link.ask(t.get_output_state(0)).limit_counts == 90


def test_a_question_is_given_up_after_three_times(link, script, clock):
    before = clock.now_s
    for _ in range(2):
        script.expect(LIGHT)
        script.expect(*FENCE)
    script.expect(LIGHT)
    with pytest.raises(NoAnswerError, match="GETINPUTVALUES"):
        link.ask(read)
    assert clock.now_s - before < LONGEST_S


def test_a_silent_brick_is_told_of_within_the_deadline(link, script, clock):
    script.expect(LIGHT)
    for fence in (BATTERY, "02 00 01 88", ASLEEP):
        script.expect(fence)
    before = clock.now_s
    with pytest.raises(LinkError, match=r"on /dev/rfcomm0 does not answer any more"):
        link.ask(read)
    assert clock.now_s - before < LONGEST_S
    # Nor does it later: what all those questions were answered cannot be told apart any more.
    with pytest.raises(LinkError, match="does not answer any more"):
        link.ask(read)


def test_a_refused_move_is_not_sent_again(link, script):
    script.expect(MOVE, (0.06, "03 00 02 04 DE"))
    with pytest.raises(BrickError, match="DE"):
        link.ask(move)


def test_an_answer_that_cannot_be_true_is_asked_for_again(link, script):
    def is_bright(values):
        if values.raw > 600:
            raise TelegramError(f"{values.raw} counts")

    for _ in range(2):
        script.expect(LIGHT, (0.06, DARK))
        script.expect(*FENCE)
    script.expect(LIGHT, (0.06, BRIGHT))
    assert link.ask(read, check=is_bright).normalized == 565
    for _ in range(2):
        script.expect(LIGHT, (0.06, DARK))
        script.expect(*FENCE)
    script.expect(LIGHT, (0.06, DARK))
    with pytest.raises(TelegramError, match="768 counts"):
        link.ask(read, check=is_bright)


def test_the_radio_is_given_time_to_turn_round(link, script):
    """60 ms a question, at least, and 30 ms after its answer; without an answer 15 ms."""
    for _ in range(3):
        script.expect(LIGHT, (0.001, BRIGHT))
        link.ask(read)
    script.expect(LIGHT, (0.05, BRIGHT))
    link.ask(read)
    stop = "0C 00 80 04 FF" + 9 * " 00"
    script.expect(stop)
    link.tell(t.set_output_state(255))
    script.expect(stop)
    link.tell(t.set_output_state(255))
    np.testing.assert_allclose(np.diff(script.sent_at[2:]), [0.06, 0.06, 0.06, 0.08, 0.015], atol=1e-9)


@pytest.mark.parametrize(("limit", "waits_s"), [("30 75 00 00", (9.0, 1.1)), ("00 00 00 00", (59.0, 1.1))])
def test_a_brick_is_kept_awake_as_often_as_its_limit_needs(script, clock, limit, waits_s):
    """With one of 30 s, which no menu has, every 10 s; one that never sleeps is asked every minute."""
    link = Link(script, clock=clock)
    script.expect(*FENCE)
    for _ in range(2):
        script.expect(ASLEEP, (0.06, f"07 00 02 0D 00 {limit}"))
        link.keep_awake()
        clock.sleep(waits_s[0])
        link.keep_awake()
        clock.sleep(waits_s[1])
    script.finish()


LED_ON, LED_OFF = t.LED_ON, t.LED_OFF

# Command, whether it wants an answer, the frame sent (length first), the frame that comes back, what that says.
LIGHT_OF_TELEGRAM, RUN = t.get_input_values(1), {"run_state": 0x20}
VECTORS = [
    (t.set_input_type(1, LED_ON), True, "05 00 00 05 01 05 00", "03 00 02 05 00", None),
    (t.set_input_type(1, LED_OFF), False, "05 00 80 05 01 06 00", None, None),
    (LIGHT_OF_TELEGRAM, True, "03 00 00 07 01", "10 00 02 07 00 01 01 00 05 80 00 02 35 02 37 00 35 02",
     t.InputValues(1, 1, 0, 5, 0x80, 512, 565, 55, 565)),
    (LIGHT_OF_TELEGRAM, True, "03 00 00 07 01", "10 00 02 07 00 01 00 00 06 00 80 02 78 01 78 01 78 01",
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
