"""The brick as a person sees it: motors, a light sensor, a battery, and nothing left running at the end."""

from __future__ import annotations

import contextlib
import time
from types import TracebackType
from typing import Self

from probewise.arm.basics import Clock
from probewise.arm.nxt.light import Light
from probewise.arm.nxt.link import Link
from probewise.arm.nxt.motor import Drive, Guard, Motor
from probewise.arm.nxt.serial_port import SerialPort
from probewise.arm.nxt.telegram import (
    ALL_OUTPUTS,
    DeviceInfo,
    GetBatteryLevel,
    GetDeviceInfo,
    OutputMode,
    Regulation,
    RunState,
    SetOutputState,
)
from probewise.errors import LinkError

__all__ = ["Brick"]


class Brick:
    """A LEGO NXT; use it in a `with` block, whose end stops and releases all motors.

    Parameters
    ----------
    link
        The line to it.
    clock
        What is waited with.
    """

    def __init__(self, link: Link, *, clock: Clock = time) -> None:
        self.link, self._clock = link, clock
        self._lights: dict[int, Light] = {}

    @classmethod
    def open(cls, path: str) -> Self:
        """Open the line at a serial port: /dev/rfcomm0, COM5, a pseudo-terminal.

        Raises
        ------
        LinkError
            If it cannot be opened.
        """
        return cls(Link(SerialPort.open(path)))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop and release the motors, after an exception and Ctrl-C too, then close the line.

        Raises
        ------
        LinkError
            If the motors could not be stopped, and nothing else went wrong before.
        """
        try:
            self._come_to_rest()
        except LinkError:
            if error is None:
                raise
        finally:
            self.link.close()

    def motor(self, port: int, *, guard: Guard | None = None, drive: Drive | None = None) -> Motor:
        """Make the motor at port 0 to 2; see `Motor`."""
        return Motor(self.link, port, guard=guard, drive=drive, clock=self._clock)

    def light(self, port: int) -> Light:
        """Make the light sensor at input 0 to 3; see `Light`."""
        return self._lights.setdefault(port, Light(self.link, port, clock=self._clock))

    def battery_mv(self) -> int:
        """Read the battery's voltage."""
        return self.link.ask(GetBatteryLevel()).millivolt

    def info(self) -> DeviceInfo:
        """Ask who it is."""
        return self.link.ask(GetDeviceInfo())

    def _come_to_rest(self) -> None:
        release = SetOutputState(ALL_OUTPUTS, 0, OutputMode.IDLE, Regulation.IDLE, 0, RunState.IDLE, 0)
        # First without an answer, which works even where answers are missing or late; then make sure.
        self.link.tell(release)
        self.link.ask(release)
        for light in self._lights.values():
            with contextlib.suppress(LinkError):
                light.switch_off()
