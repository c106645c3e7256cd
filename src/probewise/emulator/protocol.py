"""The brick's side of LEGO's Bluetooth protocol: parsing requests and building replies.

Layouts follow LEGO's direct and system commands; all numbers are little-endian. A frame is the length of a telegram in
two bytes, then the telegram.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TypeAlias

FieldValue: TypeAlias = int | bytes
Clock: TypeAlias = Callable[[], float]
"""Seconds since any fixed moment; `time.monotonic` is one."""


class VirtualClock:
    """A clock that advances only by `sleep`, which returns at once: minutes of simulated work take seconds.

    It replaces Python's module `time` in code that uses only `monotonic` and `sleep`.
    """

    def __init__(self) -> None:
        self._now_s = 0.0

    def __call__(self) -> float:
        """Return the time in seconds."""
        return self._now_s

    monotonic = __call__

    def sleep(self, seconds: float) -> None:
        """Advance the clock."""
        self._now_s += seconds


_REPLY, _NO_REPLY = 0x02, 0x80
_DIRECT, _SYSTEM = 0x00, 0x01


class Status(IntEnum):
    """Status bytes of this brick's replies."""

    OK = 0x00
    UNDEFINED_ERROR = 0x8A
    UNKNOWN_COMMAND = 0xBE
    MALFORMED = 0xBF
    OUT_OF_RANGE = 0xC0
    NO_ROOM = 0xDE
    NO_PROGRAM = 0xEC


class RefusedError(Exception):
    """Raised to refuse a command; after the status follow as many zeros as the firmware sends."""

    def __init__(self, status: Status) -> None:
        self.status = status
        super().__init__(status.name)


@dataclass(frozen=True)
class CommandLayout:
    """Layout of a command's telegram after the opcode, and length of its error reply after the status.

    `layout` is in the format of Python's `struct`. After the status of an error follow `error_bytes` zeros, as in the
    firmware.
    """

    name: str
    layout: str = ""
    error_bytes: int = 0

    def parse_fields(self, body: bytes) -> tuple[FieldValue, ...]:
        """Parse the bytes after the opcode; RefusedError if there are too few."""
        size = struct.calcsize("<" + self.layout)
        if len(body) < size:
            raise RefusedError(Status.MALFORMED)
        return struct.unpack("<" + self.layout, body[:size])


COMMANDS: dict[int, CommandLayout] = {
    0x03: CommandLayout("PLAYTONE", "HH"),
    0x04: CommandLayout("SETOUTPUTSTATE", "BbBBbBI"),
    0x05: CommandLayout("SETINPUTMODE", "BBB"),
    0x06: CommandLayout("GETOUTPUTSTATE", "B", 22),
    0x07: CommandLayout("GETINPUTVALUES", "B", 13),
    0x0A: CommandLayout("RESETMOTORPOSITION", "BB"),
    0x0B: CommandLayout("GETBATTERYLEVEL"),
    0x0D: CommandLayout("KEEPALIVE"),
    0x11: CommandLayout("GETCURRENTPROGRAMNAME", "", 20),
    0x88: CommandLayout("GETFIRMWAREVERSION"),
    0x9B: CommandLayout("GETDEVICEINFO"),
}


@dataclass(frozen=True)
class Request:
    """One telegram from the host; `command` is None for an unknown opcode, `body` the bytes after the opcode."""

    opcode: int
    wants_reply: bool
    command: CommandLayout | None
    body: bytes


def parse_request(telegram: bytes) -> Request | None:
    """Parse a telegram; None for one that the firmware ignores: a reply, an unknown type, fewer than two bytes."""
    if len(telegram) < 2:
        return None
    kind, opcode = telegram[0] & ~_NO_REPLY, telegram[1]
    if kind not in (_DIRECT, _SYSTEM):
        return None
    # Direct opcodes are below 0x80, system opcodes above; sent with the wrong type they are unknown.
    command = COMMANDS.get(opcode) if (kind == _SYSTEM) == (opcode >= 0x80) else None
    return Request(opcode, not telegram[0] & _NO_REPLY, command, telegram[2:])


def build_reply(opcode: int, status: int, payload: bytes = b"") -> bytes:
    """Build a reply telegram."""
    return bytes((_REPLY, opcode, status)) + payload


def framed(telegram: bytes) -> bytes:
    """Prepend the length, as Bluetooth requires (USB does not)."""
    return struct.pack("<H", len(telegram)) + telegram


_PATIENCE_S = 0.61  # the firmware discards an incomplete frame after this silence


@dataclass
class FrameAssembler:
    """Assembler of telegrams from bytes in pieces of any size; after 0.61 s of silence it drops an incomplete frame."""

    _held: bytearray = field(default_factory=bytearray)
    _last_s: float = 0.0

    def feed(self, received: bytes, now_s: float) -> Iterator[bytes]:
        """Add bytes and yield every telegram that is complete, without its length."""
        if now_s - self._last_s > _PATIENCE_S:
            self._held.clear()
        if received:  # a call without bytes does not end the silence
            self._last_s = now_s
        self._held += received
        while len(self._held) >= 2:
            end = 2 + int.from_bytes(self._held[:2], "little")
            if len(self._held) < end:
                return
            telegram = bytes(self._held[2:end])
            del self._held[:end]
            yield telegram
