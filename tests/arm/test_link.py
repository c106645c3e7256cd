"""The link to the brick, on a line where bytes come in pieces, late, twice, or not at all."""

import numpy as np
import pytest

from probewise.arm.nxt import BrickError, Link, NoAnswerError, TelegramError
from probewise.arm.nxt import telegram as t
from probewise.arm.nxt.link import LONGEST_S
from probewise.errors import LinkError

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
