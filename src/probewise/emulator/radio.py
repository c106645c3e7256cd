"""The Bluetooth link as seen by the host: it takes frames, delivers replies at their time, and injects faults.

A radio does not wait: bytes carry the time at which they reach the host. A virtual line, or a pseudo-terminal that
behaves like /dev/rfcomm0, delivers them at that time.
"""

from __future__ import annotations

import contextlib
import os
import select
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, Self, TypeAlias

import numpy as np

from probewise.emulator import protocol
from probewise.emulator.brick import Brick
from probewise.errors import FileError, LinkError, ParameterError, require


def _usually(rate: float) -> Any:
    return field(default=0.0, metadata={"usual": rate})


@dataclass(frozen=True)
class Faults:
    """Rates of faults, 0 to 1; by default a link without faults; beside each, what its name alone stands for."""

    fragment: float = _usually(1.0)  # a reply comes in pieces, up to 30 ms apart
    merge: float = _usually(0.05)  # a reply is delayed and delivered together with the next one
    double: float = _usually(0.05)  # a reply comes twice, the second time up to 0.1 s later
    corrupt: float = _usually(0.05)  # one byte of a reply, its length included, is changed
    late: float = _usually(0.05)  # a reply is late
    late_s: float = 3.0  # by so many seconds
    drop: float = _usually(0.005)  # a byte of a reply is lost, per byte
    half: float = _usually(0.05)  # the end of a telegram is lost, equally likely of a request or of a reply
    error: float = _usually(0.05)  # a request is refused with an error status and not executed
    silence: float = _usually(0.05)  # a request is executed but never answered
    deaf: float = _usually(0.05)  # a request is lost on the way to the brick
    unasked: float = _usually(0.05)  # the brick sends a message of its own before a reply
    disconnect: float = _usually(0.002)  # the link ends at a request, which is executed; motors run on
    sag: float = _usually(60.0)  # millivolts that the battery loses per minute

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name in ("late_s", "sag"):
                require(0 <= value < float("inf"), item.name, value, "0 or more")
            elif not 0 <= value <= 1:
                raise ParameterError(item.name, value, "a probability, 0 to 1")

    @classmethod
    def parse(cls, texts: Iterable[str]) -> Self:
        """Parse texts NAME, NAME=RATE or late=RATE,SECONDS, one fault each.

        NAME alone means: every reply fragmented, one byte in 200 dropped, disconnection at one request in 500, a
        battery loss of 60 mV per minute, any other fault at one request in 20. ParameterError for any other text.
        """
        faults = cls()
        for text in texts:
            name, equals, value = text.partition("=")
            require(name in _USUAL, "--fault", text, f"one of {', '.join(_USUAL)}, optionally followed by =RATE")
            names = ("late", "late_s") if name == "late" else (name,)
            try:
                numbers = [float(part) for part in value.split(",")] if equals else [_USUAL[name]]
                faults = replace(faults, **dict(zip(names[: len(numbers)], numbers, strict=True)))
            except ParameterError as error:
                raise ParameterError("--fault", text, f"{error.name} {error.allowed}") from error
            except ValueError as error:
                raise ParameterError("--fault", text, f"{name}=RATE, such as {name}={_USUAL[name]:g}") from error
        return faults


_USUAL = {rate.name: rate.metadata["usual"] for rate in fields(Faults) if rate.metadata}

Event: TypeAlias = Literal[">", "<", "!"]
Trace: TypeAlias = Callable[[float, Event, str], None]
"""Called with the time in s, the event (> telegram to the brick, < telegram from it, ! fault) and its text."""

_TURNAROUND_S = 0.060  # time of the radio to switch between receiving and sending
_PIECE_S = 0.03
_DOUBLED_S = 0.1
_STATUSES = (
    protocol.Status.UNDEFINED_ERROR,
    protocol.Status.MALFORMED,
    protocol.Status.OUT_OF_RANGE,
    protocol.Status.NO_ROOM,
)
_UNASKED = bytes.fromhex("800900 03 686900")  # a running program writes "hi" to mailbox 0


def ignore_trace(now_s: float, event: Event, text: str) -> None:
    """Keep no record."""


class Radio:
    """A Bluetooth link to a brick, as its host sees it; `rng` draws the faults, `mishaps` counts each.

    `faults` may be replaced at any time.
    """

    def __init__(
        self,
        brick: Brick,
        clock: protocol.Clock,
        *,
        rng: np.random.Generator,
        faults: Faults | None = None,
        trace: Trace = ignore_trace,
    ) -> None:
        self.brick, self._clock, self._rng, self._trace = brick, clock, rng, trace
        self.faults = Faults() if faults is None else faults
        self.mishaps: Counter[str] = Counter()
        self.reconnect()

    def reconnect(self) -> None:
        """Begin a new connection: bytes under way are lost, the brick's state is kept."""
        self._frames = protocol.FrameAssembler()
        self._coming: deque[tuple[float, bytes]] = deque()
        self._held = b""  # a reply that waits for the next one
        self._last_s = 0.0
        self._ended = False

    @property
    def is_open(self) -> bool:
        """Whether the link is open; a fault or the brick's sleep closes it."""
        return not self._ended and not self.brick.is_off

    @property
    def next_arrival_s(self) -> float | None:
        """Time at which the next bytes reach the host, None if there are none."""
        return self._coming[0][0] if self._coming else None

    def send(self, data: bytes) -> None:
        """Take bytes from the host, in pieces of any size, and execute whole telegrams; a fault may cut a piece."""
        if len(data) > 1 and self._fault_occurs("half", self.faults.half / 2):
            data = data[: int(self._rng.integers(1, len(data)))]
        for telegram in self._frames.feed(data, self._clock()):
            if self.is_open:
                self._handle_request(telegram)

    def receive(self) -> bytes:
        """Return the bytes that have reached the host by now."""
        received = bytearray()
        while self._coming and self._coming[0][0] <= self._clock():
            received += self._coming.popleft()[1]
        return bytes(received)

    def _handle_request(self, telegram: bytes) -> None:
        self._trace_telegram(">", telegram)
        if self._fault_occurs("deaf", self.faults.deaf):
            return
        refused = self._fault_occurs("error", self.faults.error)
        answer = self._random_refusal(telegram) if refused else self.brick.answer(telegram)
        if self._fault_occurs("disconnect", self.faults.disconnect):
            self._ended = True
            return
        if answer is None or self._fault_occurs("silence", self.faults.silence):
            return
        self._trace_telegram("<", answer)
        at_s = self._clock() + _TURNAROUND_S
        if self._fault_occurs("unasked", self.faults.unasked):
            self._schedule_delivery(at_s, protocol.framed(_UNASKED))
        if self._fault_occurs("late", self.faults.late):
            at_s += self.faults.late_s
        frame = self._with_faults(protocol.framed(answer))
        if self._fault_occurs("merge", self.faults.merge):
            self._held += frame
            return
        frame, self._held = self._held + frame, b""
        for piece in self._cut_into_pieces(frame):
            self._schedule_delivery(at_s, piece)
            at_s += self._rng.uniform(0.0, _PIECE_S)
        if self._fault_occurs("double", self.faults.double):
            self._schedule_delivery(at_s + self._rng.uniform(0.0, _DOUBLED_S), frame)

    def _random_refusal(self, telegram: bytes) -> bytes | None:
        """Return a reply with a random error status, in the brick's place; None if the request wants no reply."""
        request = protocol.parse_request(telegram)
        if request is None or not request.wants_reply:
            return None
        zeros = 0 if request.command is None else request.command.error_bytes
        return protocol.build_reply(request.opcode, int(self._rng.choice(_STATUSES)), bytes(zeros))

    def _with_faults(self, frame: bytes) -> bytes:
        """Return a frame to the host with a byte changed, the end cut off or bytes dropped, as the rates have it."""
        if self._fault_occurs("corrupt", self.faults.corrupt):
            at, change = int(self._rng.integers(len(frame))), int(self._rng.integers(1, 256))
            frame = frame[:at] + bytes((frame[at] ^ change,)) + frame[at + 1 :]
        if self._fault_occurs("half", self.faults.half / 2):
            frame = frame[: int(self._rng.integers(1, len(frame)))]
        return bytes(byte for byte in frame if not self._fault_occurs("drop", self.faults.drop))

    def _cut_into_pieces(self, frame: bytes) -> list[bytes]:
        if len(frame) < 2 or not self._fault_occurs("fragment", self.faults.fragment):
            return [frame]
        n_cuts = int(self._rng.integers(1, min(len(frame), 4)))
        cuts = [0, *sorted(self._rng.choice(np.arange(1, len(frame)), n_cuts, replace=False).tolist()), len(frame)]
        return [frame[begin:end] for begin, end in pairwise(cuts)]

    def _schedule_delivery(self, at_s: float, data: bytes) -> None:
        """Schedule bytes for `at_s`, or for the last time scheduled if that is later: no bytes overtake others."""
        self._last_s = max(at_s, self._last_s)
        self._coming.append((self._last_s, data))

    def _fault_occurs(self, name: str, rate: float) -> bool:
        """Draw whether a fault occurs; count and record it if so."""
        happens = rate > 0 and self._rng.random() < rate
        if happens:
            self.mishaps[name] += 1
            self._trace(self._clock(), "!", name)
        return happens

    def _trace_telegram(self, event: Event, telegram: bytes) -> None:
        command = protocol.COMMANDS.get(telegram[1]) if len(telegram) > 1 else None
        name = "unknown" if command is None else command.name
        self._trace(self._clock(), event, f"{telegram.hex(' ')}  {name}")


class VirtualLine:
    """A new connection to the brick within this process, on a virtual clock, which it advances instead of waiting."""

    name = "the emulator"

    def __init__(self, radio: Radio, clock: protocol.VirtualClock) -> None:
        self._radio, self._clock = radio, clock
        self._received = bytearray()
        self._closed = False
        radio.reconnect()

    def read(self, size: int, timeout_s: float) -> bytes:
        """Return up to `size` bytes, fewer if no more arrive within `timeout_s`; LinkError if the line is cut."""
        deadline_s = self._clock() + timeout_s
        while True:
            self._received += self._radio.receive()
            if len(self._received) >= size or self._clock() >= deadline_s:
                break
            self._require_open()
            next_arrival_s = self._radio.next_arrival_s
            until_s = deadline_s if next_arrival_s is None else min(next_arrival_s, deadline_s)
            self._clock.sleep(max(until_s - self._clock(), 0.0))
        data = bytes(self._received[:size])
        del self._received[:size]
        return data

    def write(self, data: bytes) -> None:
        """Send all bytes; LinkError if the line is cut."""
        self._require_open()
        self._radio.send(data)

    def close(self) -> None:
        """Close the line; the state of the brick does not change."""
        self._closed = True

    def _require_open(self) -> None:
        if self._closed or not self._radio.is_open:
            raise LinkError("the line to the emulated brick is cut; open a new one")


_LONGEST_WAIT_S = 0.05


class Terminal:
    """A raw pseudo-terminal; clients may come and go.

    `link` is the path of a symbolic link to it that survives disconnections, as /dev/rfcomm0 does; FileError if
    something else is at that path.
    """

    def __init__(self, link: Path | None = None) -> None:
        if link is not None and link.exists() and not (link.is_symlink() and link.is_char_device()):
            raise FileError(link, "the path exists already", "a new name, or a symbolic link to a device, to replace")
        self._link = link
        self._open_terminal()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close_terminal()
        if self._link is not None:
            self._link.unlink(missing_ok=True)

    @property
    def path(self) -> str:
        """Path at which clients open the terminal: the symbolic link, if any, else the device."""
        return self._slave_path if self._link is None else str(self._link)

    def hang_up_and_reopen(self) -> None:
        """End the connection, so that clients lose the device, and open a new one."""
        self._close_terminal()
        self._open_terminal()

    def read(self, wait_s: float) -> bytes:
        """Return the bytes that a client has written, at most 4096, waiting for them `wait_s` at most."""
        ready, _, _ = select.select([self._master], [], [], wait_s)
        return os.read(self._master, 4096) if ready else b""

    def write(self, data: bytes) -> None:
        """Write bytes in one piece, since a client may take each read for a frame; drop them if its buffer is full."""
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, data)

    def _open_terminal(self) -> None:
        # The slave stays open here too: otherwise the master fails when the last client leaves.
        import tty  # not on Windows

        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._slave_path = os.ttyname(self._slave)
        if self._link is not None:
            fresh = self._link.with_name(f".{self._link.name}.{os.getpid()}")
            fresh.symlink_to(self._slave_path)
            fresh.replace(self._link)

    def _close_terminal(self) -> None:
        os.close(self._slave)
        os.close(self._master)


def serve(
    terminal: Terminal,
    radio: Radio,
    clock: protocol.Clock,
    *,
    on_move: Callable[[str], None],
    meanwhile: Callable[[], None],
) -> None:
    """Pass bytes between client and brick until the brick goes to sleep; its clock must run in real time.

    `on_move` is called with the terminal's new path if a disconnection changed it, `meanwhile` at least every 50 ms.
    """
    while not radio.brick.is_off:
        due_s = radio.next_arrival_s
        wait_s = _LONGEST_WAIT_S if due_s is None else min(max(due_s - clock(), 0.0), _LONGEST_WAIT_S)
        radio.send(terminal.read(wait_s))
        radio.brick.advance()
        meanwhile()
        received = radio.receive()
        if received:
            terminal.write(received)
        if not radio.is_open and not radio.brick.is_off:
            before = terminal.path
            terminal.hang_up_and_reopen()
            radio.reconnect()
            if terminal.path != before:
                on_move(terminal.path)
