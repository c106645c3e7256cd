"""The brick: ports, files, battery and sleep timer, and its replies to telegrams."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from probewise.emulator.clock import Clock
from probewise.emulator.files import Files
from probewise.emulator.inputs import InputPorts, Sensor
from probewise.emulator.motor import Motor
from probewise.emulator.outputs import OutputPorts
from probewise.emulator.programs import Programs
from probewise.emulator.protocol import RefusedError, Request, Status, build_reply, parse_request
from probewise.emulator.sensors import EmptyPort
from probewise.errors import ParameterError

ADDRESS = bytes.fromhex("0016530A0B0C")
SLEEP_MIN = (0, 2, 5, 10, 30, 60)
"""The sleep times of the brick's menu, in minutes; 0 is never."""

_FLASH_BYTES = 61440
_VERSIONS = bytes((124, 1, 31, 1))  # protocol 1.124, firmware 1.31, the smaller number first
_LONGEST_NAME = 14
_LONGEST_POLL = 121  # over Bluetooth; more is an error


@dataclass(frozen=True)
class Battery:
    """A battery's voltage at the start, and its loss per minute, in mV."""

    full_mv: float = 7412.0
    sag_mv_min: float = 0.0

    def millivolts_after(self, seconds: float) -> float:
        """Return the voltage in mV after some seconds, at least 5500."""
        return max(self.full_mv - self.sag_mv_min * seconds / 60, 5500.0)


class Brick:
    """An NXT brick, switched on at construction.

    Parameters
    ----------
    clock
        Time in seconds, for motors and timers.
    motors
        Motors at ports A, B, C.
    sensors
        Sensors at ports 1 to 4.
    name
        Up to 14 characters of Latin-1.
    battery
        The battery.
    sleep_min
        Minutes without KEEPALIVE after which the brick switches itself off; 0: never.
    files
        Files in flash, by name; None: echo.rxe, empty. Each file runs as a program that echoes messages.
    watch
        Function called every 10 ms while a motor turns.

    Raises
    ------
    ParameterError
        If the name or `sleep_min` is invalid.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        motors: Sequence[Motor] | None = None,
        sensors: Sequence[Sensor] | None = None,
        name: str = "NXT",
        battery: Battery | None = None,
        sleep_min: int = 10,
        files: Mapping[str, bytes] | None = None,
        watch: Callable[[], None] = lambda: None,
    ) -> None:
        if not 1 <= len(name) <= _LONGEST_NAME or not name.isprintable() or any(ord(c) > 255 for c in name):
            raise ParameterError("name", name, f"1 to {_LONGEST_NAME} printable characters of Latin-1")
        if sleep_min not in SLEEP_MIN:
            raise ParameterError("sleep_min", sleep_min, f"one of {', '.join(map(str, SLEEP_MIN))}")
        self._clock, self._sleep_s = clock, 60.0 * sleep_min
        self._began_s = self._awake_s = clock()
        self._battery = Battery() if battery is None else battery
        self._name = name.encode("latin-1")
        plugged = [Motor() for _ in range(3)] if motors is None else motors
        self.outputs = OutputPorts(plugged, now_s=self._began_s, watch=watch)
        self.inputs = InputPorts([EmptyPort()] * 4 if sensors is None else sensors, clock)
        self._files = Files({"echo.rxe": b""} if files is None else files, capacity=_FLASH_BYTES)
        self._programs = Programs(self._files.exists, self._reset_ports)
        self._commands: Mapping[int, Callable[..., bytes]] = {
            **self.outputs.commands,
            **self.inputs.commands,
            **self._files.commands,
            **self._programs.commands,
            0x02: self._play_file,
            0x03: lambda hertz, ms: b"",
            0x0B: lambda: struct.pack("<H", int(self.battery_mv)),
            0x0C: lambda: b"",
            0x0D: self._keep_alive,
            0x88: lambda: _VERSIONS,
            0x90: self._refuse_module,
            0x91: self._refuse_module,
            0x92: lambda handle: b"\0",
            0x94: self._refuse_reading_map,
            0x95: self._refuse_writing_map,
            0x97: self._refuse_usb_only,
            0x98: self._rename_brick,
            0x9B: self._device_info,
            0xA1: lambda buffer: bytes((buffer, 0)),
            0xA2: self._poll_buffer,
            0xA4: self._refuse_usb_only,
        }

    @property
    def battery_mv(self) -> float:
        """The battery's voltage now, in mV."""
        return self._battery.millivolts_after(self._clock() - self._began_s)

    @property
    def is_off(self) -> bool:
        """Whether the brick has gone to sleep; only its orange button could wake it."""
        return self._sleep_s > 0 and self._clock() - self._awake_s >= self._sleep_s

    def advance(self) -> None:
        """Simulate the motors up to the clock's time; from the brick's sleep on, they coast."""
        if self.is_off:
            self.outputs.advance(self._awake_s + self._sleep_s, self.battery_mv)
            self.outputs.release()
        self.outputs.advance(self._clock(), self.battery_mv)

    def answer(self, telegram: bytes) -> bytes | None:
        """Execute a telegram and return the reply, or None for no reply.

        There is no reply to a command with the no-reply bit, even after an error, nor while the brick is off.
        """
        self.advance()
        request = None if self.is_off else parse_request(telegram)
        if request is None:
            return None
        status, payload = self._execute_request(request)
        return build_reply(request.opcode, status, payload) if request.wants_reply else None

    def _execute_request(self, request: Request) -> tuple[Status, bytes]:
        if request.command is None:
            return Status.UNKNOWN_COMMAND, b""
        try:
            return Status.OK, self._commands[request.opcode](*request.command.parse_fields(request.body))
        except RefusedError as refused:
            zeros = bytes(request.command.error_bytes)
            return refused.status, zeros if refused.payload is None else refused.payload

    def _reset_ports(self) -> None:
        self.outputs.release()
        self.inputs.reset_ports()

    def _play_file(self, loop: int, name: bytes) -> bytes:
        if not self._files.exists(name.split(b"\0")[0].decode("latin-1")):
            raise RefusedError(Status.OUT_OF_RANGE)
        return b""

    def _keep_alive(self) -> bytes:
        self._awake_s = self._clock()
        return struct.pack("<I", int(1000 * self._sleep_s))

    def _rename_brick(self, name: bytes) -> bytes:
        self._name = name.split(b"\0")[0][:15]
        return b""

    def _device_info(self) -> bytes:
        return struct.pack("<15s7s4xI", self._name, ADDRESS, self._files.free_bytes)

    def _refuse_module(self, wanted: bytes | int) -> bytes:
        raise RefusedError(Status.MODULE_NOT_FOUND)

    def _refuse_reading_map(self, module: int, offset: int, wanted: int) -> bytes:
        raise RefusedError(Status.MODULE_NOT_FOUND, struct.pack("<IH", module, 0) + bytes(min(wanted, 119)))

    def _refuse_writing_map(self, module: int, offset: int, wanted: int, data: bytes) -> bytes:
        raise RefusedError(Status.MODULE_NOT_FOUND, struct.pack("<IH", module, 0))

    def _poll_buffer(self, buffer: int, wanted: int) -> bytes:
        if wanted > _LONGEST_POLL:
            raise RefusedError(Status.UNDEFINED_ERROR, bytes((buffer, 0)))
        return bytes((buffer, 0)) + bytes(wanted)

    def _refuse_usb_only(self, *fields: bytes) -> bytes:
        raise RefusedError(Status.UNDEFINED_ERROR)
