"""A program running on the brick, as a host sees it: its name and its mailboxes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping

from probewise.emulator.protocol import RefusedError, Status

_N_BOXES = 20
_ANSWERS = 10  # a program's outbox n is the host's box n + 10
_DEPTH = 5
_SIZE = 59


class Programs:
    """The brick's running program and its mailboxes; every emulated program echoes each message.

    Parameters
    ----------
    exists
        Function that returns whether a program of a name exists.
    on_change
        Function called when a program starts or stops, to reset motors and sensors.
    """

    def __init__(self, exists: Callable[[str], bool], on_change: Callable[[], None]) -> None:
        self._exists, self._on_change = exists, on_change
        self.running: bytes | None = None
        self._boxes: tuple[deque[bytes], ...] = ()
        self.commands: Mapping[int, Callable[..., bytes]] = {
            0x00: self._start_program,
            0x01: self._stop_program,
            0x09: self._write_message,
            0x11: self._checked_running_name,
            0x13: self._read_message,
        }

    def _start_program(self, name: bytes) -> bytes:
        if not self._exists(name.split(b"\0")[0].decode("latin-1")):
            raise RefusedError(Status.OUT_OF_RANGE)
        self._switch_program(name)
        return b""

    def _stop_program(self) -> bytes:
        self._checked_running_name()
        self._switch_program(None)
        return b""

    def _switch_program(self, name: bytes | None) -> None:
        self.running = name
        self._boxes = tuple(deque(maxlen=_DEPTH) for _ in range(_N_BOXES))
        self._on_change()

    def _write_message(self, box: int, size: int, rest: bytes) -> bytes:
        message = rest[:size]
        if not 1 <= size <= _SIZE or len(message) < size or message[-1]:
            raise RefusedError(Status.OUT_OF_RANGE)
        if box >= _N_BOXES:
            raise RefusedError(Status.ILLEGAL_MAILBOX)
        self._checked_running_name()
        self._boxes[box + _ANSWERS if box < _ANSWERS else box].append(message)
        return b""

    def _read_message(self, box: int, local_box: int, remove: int) -> bytes:
        def padded(message: bytes) -> bytes:
            return bytes((local_box, len(message))) + message.ljust(_SIZE, b"\0")

        if self.running is None:
            raise RefusedError(Status.NO_PROGRAM, padded(b""))
        if box >= _N_BOXES:
            raise RefusedError(Status.ILLEGAL_MAILBOX, padded(b""))
        if not self._boxes[box]:
            raise RefusedError(Status.MAILBOX_EMPTY, padded(b""))
        return padded(self._boxes[box].popleft() if remove else self._boxes[box][0])

    def _checked_running_name(self) -> bytes:
        """Return the running program's name; RefusedError if none runs."""
        if self.running is None:
            raise RefusedError(Status.NO_PROGRAM)
        return self.running
