"""A serial port, by pyserial, which only this file imports."""

from __future__ import annotations

import os
import shlex
import sys
from typing import TYPE_CHECKING, Self

from probewise.errors import LinkError

if TYPE_CHECKING:
    import serial

WRITE_S = 2.0


class SerialPort:
    """A serial port in raw mode: /dev/rfcomm0, COM5, /dev/tty.NXT-DevB, a pseudo-terminal."""

    def __init__(self, port: serial.Serial) -> None:
        self._port = port

    @classmethod
    def open(cls, path: str) -> Self:
        """Open a port exclusively.

        Raises
        ------
        LinkError
            If pyserial is not installed, or the port cannot be opened.
        """
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

    @property
    def name(self) -> str:
        """The port's path."""
        return str(self._port.name)

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
    """Return the system's message, without pyserial's additions."""
    number = getattr(error, "errno", None)
    return os.strerror(number) if number else str(error)
