"""The emulated link as a serial device: a pseudo-terminal that behaves like /dev/rfcomm0."""

from __future__ import annotations

import contextlib
import os
import select
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Self

from probewise.emulator.protocol import Clock
from probewise.emulator.radio import Radio
from probewise.errors import FileError

_LONGEST_WAIT_S = 0.05


class Terminal:
    """A raw pseudo-terminal; clients may come and go.

    `link` is the path of a symbolic link to it that survives disconnections, as /dev/rfcomm0 does; FileError if
    something else is at that path.
    """

    def __init__(self, link: Path | None = None) -> None:
        if link is not None and link.exists() and not link.is_symlink():
            raise FileError(link, "the path exists already", "a new name, or a symbolic link to replace")
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
    clock: Clock,
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
