"""The brick: motors, light sensor and battery, with all motors stopped and LEDs off at the end."""

from __future__ import annotations

import time
import warnings
from types import TracebackType
from typing import Self

from probewise._signals import defer_signals
from probewise.arm.basics import Clock
from probewise.arm.nxt.light import LightSensor
from probewise.arm.nxt.link import Link
from probewise.arm.nxt.motor import DriveParameters, Guard, Motor
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
    Request,
    SetOutputState,
)
from probewise.errors import LinkError, LowBatteryWarning

LOW_MV = 6000
"""Voltage below which six cells are nearly empty: motors slow down, and the brick soon switches itself off."""

STEP_MV = 50  # largest plausible change of the battery's voltage between two questions
N_ASKED = 6
NO_PROGRAM = 0xEC


class Brick:
    """A LEGO NXT; a `with` block, at its end, releases the motors, switches the LEDs off and disconnects.

    Parameters
    ----------
    link
        The connection to the brick.
    clock
        Clock used for waiting.
    """

    def __init__(self, link: Link, *, clock: Clock = time) -> None:
        self.link, self._clock = link, clock
        self._lights: dict[int, LightSensor] = {}
        self._last_mv: int | None = None
        self._told_low = False

    @classmethod
    def open(cls, path: str) -> Self:
        """Return the brick at a serial port, opened here: /dev/rfcomm0, COM5, a pseudo-terminal.

        Raises
        ------
        LinkError
            If the port cannot be opened.
        """
        return cls(Link(SerialPort.open(path)))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop and release the motors, switch the LEDs off and close the connection; signals are deferred until then.

        Raises
        ------
        LinkError
            If this could not be confirmed, and no other exception is pending.
        """
        with defer_signals():
            try:
                self._switch_off_motors_and_leds()
            except LinkError:
                if error is None:
                    raise
            finally:
                self.link.close()

    def motor(self, port: int, *, guard: Guard | None = None, drive: DriveParameters | None = None) -> Motor:
        """Make the motor at port 0 to 2; see `Motor`."""
        return Motor(self.link, port, guard=guard, drive=drive, clock=self._clock)

    def light_sensor(self, port: int) -> LightSensor:
        """Return the light sensor at input 0 to 3, the same object at every call; see `LightSensor`."""
        return self._lights.setdefault(port, LightSensor(self.link, port, clock=self._clock))

    def battery_mv(self) -> int:
        """Read the battery's voltage, in mV; warn once if it is low.

        Since the protocol has no checksum, the voltage is read until two successive values agree within 50 mV.

        Raises
        ------
        LinkError
            If the brick does not answer, or no two of six successive voltages agree.

        Warns
        -----
        LowBatteryWarning
            If the voltage is below 6 V.
        """
        for _ in range(N_ASKED):
            before, self._last_mv = self._last_mv, self.link.ask(GetBatteryLevel()).millivolt
            if before is not None and abs(self._last_mv - before) <= STEP_MV:
                break
        else:
            raise LinkError(
                f"the NXT on {self.link.name} reports another battery voltage each of {N_ASKED} times; is it near?"
            )
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
        """Return the brick's name."""
        return self.link.ask(GetDeviceInfo()).brick_name

    def version(self) -> FirmwareVersion:
        """Return the versions of the brick's firmware and protocol."""
        return self.link.ask(GetFirmwareVersion())

    def running_program(self) -> str | None:
        """Return the file name of the program running on the brick, which could drive motors and sensors, or None."""
        try:
            return self.link.ask(GetCurrentProgramName()).file
        except BrickError as error:
            if error.status == NO_PROGRAM:
                return None
            raise

    def _switch_off_motors_and_leds(self) -> None:
        """Release the motors and switch the LEDs off, each even if another fails; then raise the last LinkError.

        First send all commands without asking for answers, which may be missing or late; then send them with answers.
        """
        commands: list[Request[Done]] = [
            SetOutputState(ALL_OUTPUTS),
            *(light.off_command for light in self._lights.values()),
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
