"""The brick as a person sees it: motors, a light sensor, a battery, and nothing left running or lit at the end."""

from __future__ import annotations

import time
import warnings
from types import TracebackType
from typing import Self

from probewise._signals import deferred
from probewise.arm.basics import Clock
from probewise.arm.nxt.light import Light
from probewise.arm.nxt.link import Link
from probewise.arm.nxt.motor import Drive, Guard, Motor
from probewise.arm.nxt.serial_port import SerialPort
from probewise.arm.nxt.status import BrickError
from probewise.arm.nxt.telegram import (
    ALL_OUTPUTS,
    Done,
    FirmwareVersion,
    GetBatteryLevel,
    GetCurrentProgramName,
    GetDeviceInfo,
    GetFirmwareVersion,
    OutputMode,
    Regulation,
    Request,
    RunState,
    SetOutputState,
)
from probewise.errors import LinkError, LowBatteryWarning

__all__ = ["LOW_MV", "Brick"]

LOW_MV = 6000
"""Below this six cells are nearly empty: motors slow down, and the brick soon switches itself off."""

STEP_MV = 50  # a battery's voltage changes by less from one question to the next
N_ASKED = 6
NO_PROGRAM = 0xEC


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
        self._last_mv: int | None = None
        self._told_low = False

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
        """Stop and release the motors, switch the LEDs off, close the line; a signal waits until that is done.

        Raises
        ------
        LinkError
            If that could not be made sure of, and nothing else went wrong before.
        """
        with deferred():
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
        """Read the battery's voltage; warn, once, where it is low.

        A voltage far from the last one is believed when the next is like it: the line has no checksum.

        Raises
        ------
        LinkError
            If the brick does not answer, or with another voltage every time.

        Warns
        -----
        LowBatteryWarning
            If it is below 6 V.
        """
        for _ in range(N_ASKED):
            before, self._last_mv = self._last_mv, self.link.ask(GetBatteryLevel()).millivolt
            if before is not None and abs(self._last_mv - before) <= STEP_MV:
                break
        else:
            raise LinkError(f"the NXT on {self.link.name} tells another battery voltage each of {N_ASKED} times")
        if self._last_mv < LOW_MV and not self._told_low:
            self._told_low = True
            warnings.warn(
                f"the NXT's battery is at {self._last_mv / 1000:.2f} V, below {LOW_MV / 1000:g} V: motors slow down, "
                "and the brick may switch itself off; change or charge it",
                LowBatteryWarning,
                stacklevel=2,
            )
        return self._last_mv

    def name(self) -> str:
        """Ask for its name."""
        return self.link.ask(GetDeviceInfo()).brick_name

    def version(self) -> FirmwareVersion:
        """Ask for the versions of its firmware and protocol."""
        return self.link.ask(GetFirmwareVersion())

    def program(self) -> str | None:
        """Ask which program runs on it, whose commands to motors and sensors would cross this one's; None: none."""
        try:
            return self.link.ask(GetCurrentProgramName()).file
        except BrickError as error:
            if error.status == NO_PROGRAM:
                return None
            raise

    def _come_to_rest(self) -> None:
        """Release the motors and switch the LEDs off, each whether or not the others could be.

        First all without an answer, which works even where answers are missing or late; then make sure.
        """
        commands: list[Request[Done]] = [
            SetOutputState(ALL_OUTPUTS, 0, OutputMode.IDLE, Regulation.IDLE, 0, RunState.IDLE, 0),
            *(light.off for light in self._lights.values()),
        ]
        failures = []
        for send in (self.link.tell, self.link.ask):
            for command in commands:
                try:
                    send(command)
                except LinkError as error:
                    failures.append(error)
        if failures:
            raise failures[-1]
