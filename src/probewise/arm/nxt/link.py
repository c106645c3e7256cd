"""Exchange of telegrams with the brick over a byte stream whose data may come in pieces, late, or not at all.

The stream keeps the order of bytes, so one rule assigns answers reliably. An answer that did not come in time stays
*owed*; before the next question, the stream is drained and a fence is sent: a harmless question with another opcode.
Once the fence is answered, any owed answer has been dropped or will never come, so no late answer is taken for another.
The same is done if data are waiting before a question is sent, such as a duplicated answer.
"""

from __future__ import annotations

import os
import shlex
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeVar

from probewise.arm.instrument import Clock
from probewise.arm.nxt import telegram as nxt
from probewise.errors import LinkError

if TYPE_CHECKING:
    import serial


A = TypeVar("A")

FENCES: tuple[nxt.Request[Any], ...] = (nxt.GET_BATTERY_LEVEL, nxt.GET_FIRMWARE_VERSION, nxt.KEEP_ALIVE)
UNKNOWN = -1  # a question sent by another program before this one began


class ByteStream(Protocol):
    """An open connection to the brick: a serial port or a substitute."""

    @property
    def name(self) -> str:
        """Name of the connection, for messages."""

    def read(self, size: int, timeout_s: float) -> bytes:
        """Return up to `size` bytes, fewer if no more come in `timeout_s`; LinkError if the connection is lost."""

    def write(self, data: bytes) -> None:
        """Send all bytes; LinkError if the connection is lost."""

    def close(self) -> None:
        """Close the connection."""


ANSWER_S = 2.0  # timeout of an answer
TURN_S = 0.03  # the radio changes between sending and receiving; a question with its answer takes two
GAP_S = 0.015  # pause after a telegram without an answer
SILENCE_S = 0.2  # after which the stream counts as drained
KEEP_AWAKE_S = 60.0  # between keep-alive commands; a third of the brick's sleep limit if that is shorter
N_REPEATS = 2  # of a question without a valid answer, if repeating it is harmless
LONGEST_S = (1 + N_REPEATS) * (1 + len(FENCES)) * (2 * (TURN_S + ANSWER_S) + SILENCE_S)
"""Longest duration of a question, with its repeats and fences, on a stream that is never silent."""


class NoAnswerError(LinkError):
    """Raised if the brick did not answer a command in time; the command may or may not have been executed."""


class Link:
    """A connection to a brick over an open stream; `n_sent` counts telegrams."""

    def __init__(self, stream: ByteStream, *, clock: Clock = time) -> None:
        self._stream, self._clock, self.name = stream, clock, stream.name
        self.n_sent = 0
        self._owed = {UNKNOWN}
        self._free_at = clock.monotonic()
        self._awake_until = clock.monotonic()

    def ask(self, request: nxt.Request[A], *, check: Callable[[A], None] | None = None) -> A:
        """Send a command and return the answer; repeat one that does no harm if that is missing or corrupted.

        `check` raises TelegramError for an impossible answer. Raises BrickError if the brick refuses the command, again
        if it was repeated; NoAnswerError if it did not answer in time, although the connection may still work;
        TelegramError if the received bytes are not an answer; LinkError if the connection is dead.
        """
        self.keep_awake()
        for n_left in reversed(range(1 + N_REPEATS if request.is_repeatable else 1)):
            try:
                self._await_turn()
                if self._owed or self._stream.read(nxt.LONGEST, 0.0):
                    self._discard_late_answers()
                answer = request.decode_answer(self._exchange(request))
                if check is not None:
                    check(answer)
            except (NoAnswerError, nxt.TelegramError):
                self._owed.add(request.opcode)
                if not n_left:
                    raise
            except nxt.BrickError:
                if not n_left:
                    raise
            else:
                return answer
        raise AssertionError("a question is asked at least once")  # pragma: no cover

    def tell(self, request: nxt.Request[A]) -> None:
        """Send a command without requesting an answer; whether the brick executed it is unknown."""
        self._send(nxt.encode(request, wants_reply=False))
        self._free_at = self._clock.monotonic() + GAP_S

    def keep_awake(self) -> None:
        """Reset the brick's sleep timer if that was not done for `KEEP_AWAKE_S`; `ask` does so too."""
        if self._clock.monotonic() < self._awake_until:
            return
        # Set first: `ask` calls this method.
        self._awake_until = self._clock.monotonic() + KEEP_AWAKE_S
        limit_s = self.ask(nxt.KEEP_ALIVE) / 1000
        if limit_s > 0:
            self._awake_until = self._clock.monotonic() + min(KEEP_AWAKE_S, limit_s / 3)

    def close(self) -> None:
        """Close the connection."""
        self._stream.close()

    def _exchange(self, request: nxt.Request[A]) -> nxt.Reply:
        """Send a command and return its reply, which counts as owed until received."""
        self._owed.add(request.opcode)
        self._send(nxt.encode(request))
        sent_at = self._clock.monotonic()
        self._free_at = sent_at + 2 * TURN_S
        reply = self._await_reply(request, sent_at + ANSWER_S)
        self._owed.discard(request.opcode)
        self._free_at = max(self._free_at, self._clock.monotonic() + TURN_S)
        return reply

    def _discard_late_answers(self) -> None:
        """Ensure that no answer to an earlier command can still arrive; LinkError if the brick answers no fence."""
        self._drain()
        for fence in FENCES:
            if fence.opcode in self._owed:
                continue
            try:
                self._exchange(fence)
            except (NoAnswerError, nxt.TelegramError):
                self._drain()
            else:
                self._owed.clear()
                return
        raise LinkError(f"the NXT on {self.name} does not answer any more; is it on, charged and near?")

    def _drain(self) -> None:
        """Read and drop bytes (late or incomplete answers) until the stream is silent, for `ANSWER_S` at most."""
        deadline = self._clock.monotonic() + ANSWER_S
        while self._clock.monotonic() < deadline and self._stream.read(nxt.LONGEST, SILENCE_S):
            pass

    def _send(self, telegram: bytes) -> None:
        self._await_turn()
        self._stream.write(nxt.framed(telegram))
        self.n_sent += 1

    def _await_turn(self) -> None:
        wait_s = self._free_at - self._clock.monotonic()
        if wait_s > 0:
            self._clock.sleep(wait_s)

    def _await_reply(self, request: nxt.Request[A], deadline: float) -> nxt.Reply:
        while True:
            length = int.from_bytes(self._read_exactly(2, request, deadline), "little")
            if not 2 <= length <= nxt.LONGEST:
                raise nxt.TelegramError(f"a telegram of {length} bytes was announced; allowed: 2 to {nxt.LONGEST}")
            telegram = self._read_exactly(length, request, deadline)
            try:
                reply = nxt.decode(telegram)
            except nxt.TelegramError:
                continue  # a program on the brick may send telegrams too
            if reply.opcode == request.opcode:
                return reply
            if reply.opcode not in self._owed:
                raise nxt.TelegramError(f"a reply to opcode {reply.opcode:02X} came, which was not asked for")

    def _read_exactly(self, size: int, request: nxt.Request[A], deadline: float) -> bytes:
        """Read exactly `size` bytes, in any number of pieces; NoAnswerError at the deadline."""
        got = b""
        while len(got) < size:
            left_s = deadline - self._clock.monotonic()
            if left_s <= 0:
                raise NoAnswerError(
                    f"the NXT did not answer {request.name} within {ANSWER_S:g} s on {self.name}; "
                    "is the brick on and paired?"
                )
            got += self._stream.read(size - len(got), left_s)
        return got


WRITE_S = 2.0


class SerialPort:
    """A serial port in raw mode: /dev/rfcomm0, COM5, /dev/tty.NXT-DevB, a pseudo-terminal."""

    def __init__(self, port: serial.Serial) -> None:
        self._port, self.name = port, str(port.name)

    @classmethod
    def open(cls, path: str) -> Self:
        """Open a port exclusively; LinkError if that fails, or pyserial is not installed."""
        try:
            import serial
        except ImportError as error:
            raise LinkError(
                "the NXT needs pyserial, which is not installed; install it with: "
                f"{shlex.quote(sys.executable or 'python')} -m pip install pyserial"
            ) from error
        # A radio serial port has no baud rate; a pseudo-terminal on some systems refuses exclusive locks.
        try:
            return cls(serial.Serial(path, timeout=0, write_timeout=WRITE_S, exclusive=True))
        except (OSError, ValueError) as error:
            raise LinkError(
                f"{path} cannot be opened ({_system_message(error)}); is the brick on, paired and bound to that port, "
                "and does no other program use it?"
            ) from error

    def read(self, size: int, timeout_s: float) -> bytes:
        """Return up to `size` bytes, fewer if no more arrive within `timeout_s`; LinkError if the line is cut."""
        try:
            self._port.timeout = timeout_s
            return bytes(self._port.read(size))
        except OSError as error:
            raise self._link_cut_error(error) from error

    def write(self, data: bytes) -> None:
        """Send all bytes; LinkError if the line is cut."""
        try:
            self._port.write(data)
        except OSError as error:
            raise self._link_cut_error(error) from error

    def close(self) -> None:
        """Close the port."""
        self._port.close()

    def _link_cut_error(self, error: OSError) -> LinkError:
        return LinkError(
            f"the line to the NXT on {self.name} is cut ({_system_message(error)}); is the brick on and near?"
        )


def _system_message(error: Exception) -> str:
    number = getattr(error, "errno", None)
    return os.strerror(number) if number else str(error)
