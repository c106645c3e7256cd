"""The Bluetooth link as the host meets it: frames in, replies out when their time has come, mishaps on the way.

Nothing here waits: bytes carry the time at which they reach the host, and whoever runs the link, a
pseudo-terminal or a test with a clock of its own, hands them over then.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np

from probewise.emulator.brick import Brick
from probewise.emulator.clock import Clock
from probewise.emulator.faults import Faults
from probewise.emulator.protocol import COMMANDS, Frames, Status, framed, parse, reply

__all__ = ["Event", "Radio", "Trace", "no_trace"]

Event: TypeAlias = Literal[">", "<", "!"]
Trace: TypeAlias = Callable[[float, Event, str], None]
"""Called with the time in s, what happened (a telegram to the brick, one from it, a mishap) and its text."""

_TURNAROUND_S = 0.060  # the radio turns from receiving to sending and back
_PIECE_S = 0.03
_DOUBLED_S = 0.1
_STATUSES = (Status.UNDEFINED_ERROR, Status.MALFORMED, Status.OUT_OF_RANGE, Status.NO_ROOM)
_UNASKED = bytes.fromhex("800900 03 686900")  # a running program writes "hi" to mailbox 0


def no_trace(now_s: float, event: Event, text: str) -> None:
    """Keep no record."""


class Radio:
    """A link to a brick.

    Parameters
    ----------
    brick
        Who answers.
    clock
        The brick's clock.
    rng
        Where mishaps come from.
    faults
        How often.
    turnaround_s
        From the end of a request to its reply.
    trace
        Where a record goes.

    Attributes
    ----------
    faults
        Another value may be put here at any time.
    mishaps
        How often each has befallen the link.
    """

    def __init__(
        self,
        brick: Brick,
        clock: Clock,
        *,
        rng: np.random.Generator,
        faults: Faults | None = None,
        turnaround_s: float = _TURNAROUND_S,
        trace: Trace = no_trace,
    ) -> None:
        self.brick, self._clock, self._rng, self._trace = brick, clock, rng, trace
        self.faults = Faults() if faults is None else faults
        self.mishaps: Counter[str] = Counter()
        self._turnaround_s = turnaround_s
        self.reconnect()

    def reconnect(self) -> None:
        """Begin a new connection: what was under way is lost, the brick is as it was."""
        self._frames = Frames()
        self._coming: deque[tuple[float, bytes]] = deque()
        self._held = b""  # a reply that waits for the next one
        self._last_s = 0.0
        self._ended = False

    @property
    def is_open(self) -> bool:
        """Whether the link stands; a mishap or the brick's sleep ends it."""
        return not self._ended and not self.brick.is_off

    @property
    def next_s(self) -> float | None:
        """When the next bytes reach the host, None where nothing is on its way."""
        return self._coming[0][0] if self._coming else None

    def send(self, data: bytes) -> None:
        """Take bytes from the host, in any pieces; what comes at once may be cut at its end."""
        if len(data) > 1 and self._happens("half", self.faults.half / 2):
            data = data[: int(self._rng.integers(1, len(data)))]
        for telegram in self._frames.feed(data, self._clock()):
            if self.is_open:
                self._arrived(telegram)

    def receive(self) -> bytes:
        """Return the bytes that have reached the host by now."""
        received = bytearray()
        while self._coming and self._coming[0][0] <= self._clock():
            received += self._coming.popleft()[1]
        return bytes(received)

    def _arrived(self, telegram: bytes) -> None:
        self._note(">", telegram)
        if self._happens("deaf", self.faults.deaf):
            return
        answer = self._refusal(telegram) if self._happens("error", self.faults.error) else self.brick.answer(telegram)
        if self._happens("disconnect", self.faults.disconnect):
            self._ended = True
            return
        if answer is None or self._happens("silence", self.faults.silence):
            return
        self._note("<", answer)
        at_s = self._clock() + self._turnaround_s
        if self._happens("unasked", self.faults.unasked):
            self._deliver(at_s, framed(_UNASKED))
        if self._happens("late", self.faults.late):
            at_s += self.faults.late_s
        frame = self._harmed(framed(answer))
        if self._happens("merge", self.faults.merge):
            self._held += frame
            return
        frame, self._held = self._held + frame, b""
        for piece in self._pieces(frame):
            self._deliver(at_s, piece)
            at_s += self._rng.uniform(0.0, _PIECE_S)
        if self._happens("double", self.faults.double):
            self._deliver(at_s + self._rng.uniform(0.0, _DOUBLED_S), frame)

    def _refusal(self, telegram: bytes) -> bytes | None:
        """Return a refusal of a request that the brick never sees."""
        request = parse(telegram)
        if request is None or not request.wants_reply:
            return None
        zeros = 0 if request.command is None else request.command.error_bytes
        return reply(request.opcode, int(self._rng.choice(_STATUSES)), bytes(zeros))

    def _harmed(self, frame: bytes) -> bytes:
        """Return what is left of a frame on its way to the host."""
        if self._happens("corrupt", self.faults.corrupt):
            at, change = int(self._rng.integers(len(frame))), int(self._rng.integers(1, 256))
            frame = frame[:at] + bytes((frame[at] ^ change,)) + frame[at + 1 :]
        if self._happens("half", self.faults.half / 2):
            frame = frame[: int(self._rng.integers(1, len(frame)))]
        return bytes(byte for byte in frame if not self._happens("drop", self.faults.drop))

    def _pieces(self, frame: bytes) -> list[bytes]:
        if len(frame) < 2 or not self._happens("fragment", self.faults.fragment):
            return [frame]
        n_cuts = int(self._rng.integers(1, min(len(frame), 4)))
        cuts = [0, *sorted(self._rng.choice(np.arange(1, len(frame)), n_cuts, replace=False).tolist()), len(frame)]
        return [frame[begin:end] for begin, end in pairwise(cuts)]

    def _deliver(self, at_s: float, data: bytes) -> None:
        """Put bytes on their way; none overtakes another, so a late reply holds up those after it."""
        self._last_s = max(at_s, self._last_s)
        self._coming.append((self._last_s, data))

    def _happens(self, name: str, rate: float) -> bool:
        happens = rate > 0 and self._rng.random() < rate
        if happens:
            self.mishaps[name] += 1
            self._trace(self._clock(), "!", name)
        return happens

    def _note(self, event: Event, telegram: bytes) -> None:
        command = COMMANDS.get(telegram[1]) if len(telegram) > 1 else None
        name = "unknown" if command is None else command.name
        self._trace(self._clock(), event, f"{telegram.hex(' ')}  {name}")
