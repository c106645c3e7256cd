"""The link and its mishaps: do they happen as often as they are asked to, and nothing else with them?

Accepted counts come from the binomial distribution, so that a right program fails less than once in 10 000.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from probewise.emulator import Brick, Faults, Radio, VirtualClock, VirtualLine
from probewise.emulator.protocol import framed
from probewise.errors import LinkError, ParameterError

BATTERY = framed(bytes.fromhex("000B"))
ANSWER = framed(bytes.fromhex("020B00F41C"))
N = 2000


def link(clock, faults, *, seed=5):
    radio = Radio(Brick(clock, sleep_min=0), clock, rng=np.random.default_rng(seed), faults=faults)
    return VirtualLine(radio, clock), radio


def likely(count, n, rate):
    low, high = binom.interval(1 - 1e-4, n, rate)
    return bool(low <= count <= high)


def answers(clock, faults, n=N):
    """Ask n times, wait for all that comes, return the bytes and the time from asking to the last of them."""
    line, _ = link(clock, faults)
    got = []
    for _ in range(n):
        asked_s = last_s = clock()
        line.write(BATTERY)
        answer = b""
        while piece := line.read(1, 0.2 + faults.late_s):
            answer, last_s = answer + piece, clock()
        got.append((answer, last_s - asked_s))
    return got


@pytest.mark.parametrize(
    ("faults", "answered", "befallen", "rate"),
    [
        (Faults(silence=0.1), {b"", ANSWER}, lambda answer, seconds: answer == b"", 0.1),
        (Faults(fragment=0.5), {ANSWER}, lambda answer, seconds: seconds > 0.0601, 0.5),
        (Faults(double=0.1), {ANSWER, ANSWER * 2}, lambda answer, seconds: answer == ANSWER * 2, 0.1),
    ],
    ids=["silence", "fragment", "double"],
)
def test_a_fault_befalls_its_share_of_replies_and_changes_nothing_else(clock, faults, answered, befallen, rate):
    got = answers(clock, replace(faults, late_s=0.0))
    assert {answer for answer, _ in got} == answered
    assert likely(sum(befallen(answer, seconds) for answer, seconds in got), N, rate)


def test_a_corrupted_reply_has_one_other_byte(clock):
    """Anywhere in the frame, its length included."""
    got = answers(clock, Faults(corrupt=0.2, late_s=0.0))
    other = [[k for k, (a, b) in enumerate(zip(answer, ANSWER, strict=True)) if a != b] for answer, _ in got]
    assert {len(places) for places in other} == {0, 1}
    assert likely(sum(map(len, other)), N, 0.2)
    assert {places[0] for places in other if places} == set(range(len(ANSWER)))


def test_half_a_telegram_is_the_beginning_of_a_request_or_of_a_reply(clock):
    """A brick that got half a request waits 0.61 s for the rest: who asks later than that is heard."""
    faults = Faults(half=0.2, late_s=1.0)
    line, radio = link(clock, faults)
    got = []
    for _ in range(N):
        line.write(BATTERY)
        got.append(line.read(99, 0.7))
    assert radio.mishaps["half"] == sum(answer != ANSWER for answer in got)
    assert all(ANSWER.startswith(answer) for answer in got)
    # A share 0.1 of requests; and 0.1 of the replies to those that arrived.
    assert likely(sum(answer == b"" for answer in got), N, 0.1)
    assert likely(sum(b"" < answer < ANSWER for answer in got), N, 0.9 * 0.1)


def test_a_request_that_an_error_befalls_is_not_carried_out(clock):
    """The refusal is as long as the firmware makes it; without a reply wanted there is none."""
    line, radio = link(clock, Faults(error=1.0))
    line.write(framed(bytes.fromhex("00 04 00 32 01 00 00 20 00 00 00 00")))
    assert line.read(99, 1.0)[:4] == bytes.fromhex("03 00 02 04")
    line.write(framed(bytes.fromhex("80 04 00 32 01 00 00 20 00 00 00 00")))
    line.write(framed(bytes.fromhex("00 06 00")))
    refusal = line.read(99, 1.0)
    assert refusal[:4] == bytes.fromhex("19 00 02 06")
    assert refusal[4] >= 0x80
    assert refusal[5:] == bytes(22)
    clock.sleep(1.0)
    radio.brick.advance()
    assert radio.brick.outputs.ports[0].tacho_count == 0
    assert radio.mishaps == {"error": 3}


def test_a_lost_request_is_not_carried_out_and_a_silent_one_is(clock):
    start = framed(bytes.fromhex("00 04 00 32 01 00 00 20 00 00 00 00"))
    for faults, moves in ((Faults(deaf=1.0), False), (Faults(silence=1.0), True)):
        line, radio = link(clock, faults)
        line.write(start)
        assert line.read(1, 1.0) == b""
        radio.brick.advance()
        assert (radio.brick.outputs.ports[0].tacho_count > 0) is moves


def test_a_disconnection_ends_the_line_and_not_the_motors(clock):
    line, radio = link(clock, Faults(disconnect=1.0))
    line.write(framed(bytes.fromhex("80 04 00 32 01 00 00 20 00 00 00 00")))
    with pytest.raises(LinkError, match="cut"):
        line.read(1, 1.0)
    with pytest.raises(LinkError, match="cut"):
        line.write(BATTERY)
    clock.sleep(1.0)
    radio.brick.advance()
    assert radio.brick.outputs.ports[0].motor.speed_deg_s > 200
    assert VirtualLine(radio, clock).read(1, 0.1) == b""


def test_no_byte_overtakes_another(clock):
    """As on a real link: whatever waits behind a late reply is late too."""
    line, _ = link(clock, Faults(late=0.3, fragment=0.5, unasked=0.2))
    for _ in range(200):
        line.write(BATTERY + framed(bytes.fromhex("000D")))
    received = line.read(10**6, 60.0)
    for unasked in (framed(bytes.fromhex("8009000368 6900")),):
        received = received.replace(unasked, b"")
    assert received == (ANSWER + framed(bytes.fromhex("020D0000000000"))) * 200


def test_the_same_seed_brings_the_same_mishaps():
    faults = Faults(fragment=0.3, late=0.1, drop=0.01, silence=0.1, unasked=0.1, late_s=0.5)
    assert answers(VirtualClock(), faults, 300) == answers(VirtualClock(), faults, 300)


def test_faults_are_read_from_texts():
    faults = Faults.parse(["fragment", "late=0.1,1.5", "drop=0.25", "sag=30"])
    assert faults == Faults(fragment=1.0, late=0.1, late_s=1.5, drop=0.25, sag=30.0)
    assert Faults.parse(["late=0.1"]).late_s == Faults().late_s


@pytest.mark.parametrize("text", ["gremlins", "drop=2", "drop=x", "drop=", "drop=0.1,0.2", "late=0.1,-1", "late=1,2,3"])
def test_an_impossible_fault_is_refused(text):
    with pytest.raises(ParameterError, match="--fault"):
        Faults.parse([text])
