"""Ask the brick and hear it: telegrams over a stream of bytes that may come in pieces, late, or not at all.

Order on the line is kept, so one rule makes answers certain. A command whose answer did not
come stays *owed*; before anything else is asked, the line is drained and a fence is put up: a
harmless question with another opcode. When its answer comes, whatever was owed has either been
read and dropped or will never come. So a late answer is never taken for the next one's. The same
is done where something lies on the line before a question is sent: an answer that came twice, say.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

from probewise.arm.basics import Clock
from probewise.arm.nxt.status import BrickError
from probewise.arm.nxt.telegram import (
    LONGEST,
    GetBatteryLevel,
    GetFirmwareVersion,
    KeepAlive,
    Reply,
    Request,
    decode,
    encode,
    framed,
)
from probewise.arm.nxt.wire import Answer, TelegramError
from probewise.errors import LinkError, ParameterError

__all__ = ["ByteStream", "Link", "NoAnswerError", "Timing"]

A = TypeVar("A", bound=Answer)

FENCES: tuple[Request[Answer], ...] = (GetBatteryLevel(), GetFirmwareVersion(), KeepAlive())
UNKNOWN = -1  # whatever another program asked before this one began


class ByteStream(Protocol):
    """A line to the brick, open: a serial port, or whatever stands in for one."""

    @property
    def name(self) -> str:
        """What the line is called, for messages."""
        ...

    def read(self, size: int, timeout_s: float) -> bytes:
        """Return up to `size` bytes, fewer where no more come within `timeout_s`.

        Raises
        ------
        LinkError
            If the line is cut.
        """
        ...

    def write(self, data: bytes) -> None:
        """Send all bytes.

        Raises
        ------
        LinkError
            If the line is cut.
        """
        ...

    def close(self) -> None:
        """Let go of the line."""
        ...


@dataclass(frozen=True)
class Timing:
    """How long things take on the line, in seconds.

    Parameters
    ----------
    answer_s
        A command whose answer takes longer has none: stalls beyond 2 s are known, and better cut.
    turn_s
        The radio's time to turn round; a question and its answer turn it twice.
    gap_s
        From a telegram without an answer to the next.
    silence_s
        A line on which nothing came for so long is drained.
    keep_awake_s
        The brick is told to stay awake at least as often as this, or a third of its limit.
    n_repeats
        How often a question without a good answer is asked again, where asking twice does no harm.
    """

    answer_s: float = 2.0
    turn_s: float = 0.03
    gap_s: float = 0.015
    silence_s: float = 0.2
    keep_awake_s: float = 60.0
    n_repeats: int = 2

    def __post_init__(self) -> None:
        for name in ("answer_s", "silence_s", "keep_awake_s"):
            if not getattr(self, name) > 0:
                raise ParameterError(name, getattr(self, name), "greater than 0")
        for name in ("turn_s", "gap_s", "n_repeats"):
            if not getattr(self, name) >= 0:
                raise ParameterError(name, getattr(self, name), "0 or more")

    @property
    def longest_s(self) -> float:
        """The longest that a question can take, its repeats and fences included, on a line that never falls silent."""
        draining_s = self.answer_s + self.silence_s
        waiting_s = 2 * self.turn_s + self.answer_s
        return (1 + self.n_repeats) * (waiting_s + draining_s + len(FENCES) * (waiting_s + draining_s))


class NoAnswerError(LinkError):
    """Report that the brick did not answer a command in time: it may have carried it out or not."""


class Link:
    """A line to a brick, one question at a time.

    Parameters
    ----------
    stream
        The open line.
    clock
        What is waited with; a test's own never waits.
    timing
        Deadlines and pauses.

    Attributes
    ----------
    n_asked, n_told
        How many questions were sent, and how many commands without an answer.
    """

    def __init__(self, stream: ByteStream, *, clock: Clock = time, timing: Timing = Timing()) -> None:
        self._stream, self._clock, self._timing = stream, clock, timing
        self.n_asked = self.n_told = 0
        self._owed = {UNKNOWN}
        self._free_at = clock.monotonic()
        self._awake_until = clock.monotonic()

    @property
    def name(self) -> str:
        """What the line is called."""
        return self._stream.name

    def ask(self, request: Request[A], *, check: Callable[[A], None] | None = None) -> A:
        """Send a command and return the answer.

        A command that may be repeated is, where no answer comes, a garbled one, or a refusal; any other is
        sent once.

        Parameters
        ----------
        request
            The command.
        check
            Raises TelegramError where the answer cannot be true; None: any is taken.

        Raises
        ------
        BrickError
            If the brick refuses it.
        NoAnswerError
            If the brick did not answer, though it may yet answer other questions.
        TelegramError
            If what came is no answer.
        LinkError
            If the line is dead.
        """
        self.keep_awake()
        for n_left in reversed(range(1 + self._timing.n_repeats if request.repeatable else 1)):
            try:
                self._await_turn()
                if self._owed or self._stream.read(LONGEST, 0.0):
                    self._clear()
                answer = request.answer(self._exchange(request))
                if check is not None:
                    check(answer)
            except (NoAnswerError, TelegramError):
                self._owed.add(request.OPCODE)
                if not n_left:
                    raise
            except BrickError:
                if not n_left:
                    raise
            else:
                return answer
        raise AssertionError("a question is asked at least once")  # pragma: no cover

    def tell(self, request: Request[A]) -> None:
        """Send a command without wanting an answer; whether the brick took it is not known."""
        self._send(encode(request, wants_reply=False))
        self.n_told += 1
        self._free_at = self._clock.monotonic() + self._timing.gap_s

    def keep_awake(self) -> None:
        """Start the brick's sleep timer anew where it is time to; `ask` does it too.

        To be called now and then by whoever lets the line rest for minutes.
        """
        if self._clock.monotonic() < self._awake_until:
            return
        # Set first: asking comes back here.
        self._awake_until = self._clock.monotonic() + self._timing.keep_awake_s
        limit_s = self.ask(KeepAlive()).limit_ms / 1000
        if limit_s > 0:
            self._awake_until = self._clock.monotonic() + min(self._timing.keep_awake_s, limit_s / 3)

    def close(self) -> None:
        """Let go of the line."""
        self._stream.close()

    def _exchange(self, request: Request[A]) -> Reply:
        """Send a command and wait for its reply; until that is here it is owed, whatever happens."""
        self._owed.add(request.OPCODE)
        self._send(encode(request))
        self.n_asked += 1
        sent_at = self._clock.monotonic()
        self._free_at = sent_at + 2 * self._timing.turn_s
        reply = self._reply_to(request, sent_at + self._timing.answer_s)
        self._owed.discard(request.OPCODE)
        self._free_at = max(self._free_at, self._clock.monotonic() + self._timing.turn_s)
        return reply

    def _clear(self) -> None:
        """Make sure that no answer to an earlier command can come any more."""
        self._drain()
        for fence in FENCES:
            if fence.OPCODE in self._owed:
                continue
            try:
                self._exchange(fence)
            except (NoAnswerError, TelegramError):
                self._drain()
            else:
                self._owed.clear()
                return
        raise LinkError(f"the NXT on {self.name} does not answer any more; is it on, charged and near?")

    def _drain(self) -> None:
        """Read on until nothing comes for a while: late answers, torn ones."""
        deadline = self._clock.monotonic() + self._timing.answer_s
        while self._clock.monotonic() < deadline and self._stream.read(LONGEST, self._timing.silence_s):
            pass

    def _send(self, telegram: bytes) -> None:
        self._await_turn()
        self._stream.write(framed(telegram))

    def _await_turn(self) -> None:
        wait_s = self._free_at - self._clock.monotonic()
        if wait_s > 0:
            self._clock.sleep(wait_s)

    def _reply_to(self, request: Request[A], deadline: float) -> Reply:
        while True:
            telegram = self._frame(request, deadline)
            try:
                reply = decode(telegram)
            except TelegramError:
                continue  # a program on the brick may send something of its own
            if reply.opcode == request.OPCODE:
                return reply
            if reply.opcode not in self._owed:
                raise TelegramError(f"a reply to opcode {reply.opcode:02X} came, which was not asked for")

    def _frame(self, request: Request[A], deadline: float) -> bytes:
        length = int.from_bytes(self._exactly(2, request, deadline), "little")
        if not 2 <= length <= LONGEST:
            raise TelegramError(f"a telegram of {length} bytes was announced; allowed: 2 to {LONGEST}")
        return self._exactly(length, request, deadline)

    def _exactly(self, size: int, request: Request[A], deadline: float) -> bytes:
        """Read so many bytes, in whatever pieces they come."""
        got = b""
        while len(got) < size:
            left_s = deadline - self._clock.monotonic()
            if left_s <= 0:
                raise NoAnswerError(
                    f"the NXT did not answer {request.name} within {self._timing.answer_s:g} s on {self.name}; "
                    "is the brick on and paired?"
                )
            got += self._stream.read(size - len(got), left_s)
        return got
