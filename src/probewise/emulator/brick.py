"""The brick: programs, battery, sleep timer, replies to telegrams; what an arm never asks for is an unknown command."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence

from probewise.emulator.inputs import InputPorts, Sensor, empty_port
from probewise.emulator.motors import Motor, OutputPorts
from probewise.emulator.protocol import Clock, RefusedError, Status, build_reply, parse_request
from probewise.errors import ParameterError, require

ADDRESS = bytes.fromhex("0016530A0B0C")
SLEEP_MIN = (0, 2, 5, 10, 30, 60)
"""The sleep times of the brick's menu, in minutes; 0 is never."""

_FLASH_BYTES = 61440
_VERSIONS = bytes((124, 1, 31, 1))  # protocol 1.124, firmware 1.31, the smaller number first
_LONGEST_NAME = 14


class Brick:
    """An NXT brick, switched on at construction; ParameterError if the name or `sleep_min` is invalid.

    Parameters
    ----------
    clock
        Time in seconds, for motors and timers.
    motors, sensors
        Motors at ports A, B, C; sensors at ports 1 to 4.
    name, sleep_min
        Up to 14 characters of Latin-1; minutes without KEEPALIVE until the brick switches itself off, 0: never.
    full_mv, sag_mv_min
        The battery's voltage at the start, and its loss per minute, in mV.
    programs
        Names of the programs in flash; one that starts or stops resets all ports, and does nothing else.
    watch
        Function called every 10 ms while a motor turns.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        motors: Sequence[Motor] | None = None,
        sensors: Sequence[Sensor] | None = None,
        name: str = "NXT",
        full_mv: float = 7412.0,
        sag_mv_min: float = 0.0,
        sleep_min: int = 10,
        programs: Sequence[str] = ("idle.rxe",),
        watch: Callable[[], None] = lambda: None,
    ) -> None:
        if not 1 <= len(name) <= _LONGEST_NAME or not name.isprintable() or any(ord(c) > 255 for c in name):
            raise ParameterError("name", name, f"1 to {_LONGEST_NAME} printable characters of Latin-1")
        require(sleep_min in SLEEP_MIN, "sleep_min", sleep_min, f"one of {', '.join(map(str, SLEEP_MIN))}")
        self._clock, self._sleep_s = clock, 60.0 * sleep_min
        self._began_s = self._awake_s = clock()
        self._full_mv, self._sag_mv_min = full_mv, sag_mv_min
        self._name = name.encode("latin-1")
        self._programs, self._running = programs, b""
        plugged = [Motor() for _ in range(3)] if motors is None else motors
        self.outputs = OutputPorts(plugged, now_s=self._began_s, watch=watch)
        self.inputs = InputPorts([empty_port] * 4 if sensors is None else sensors, clock)
        self._commands: Mapping[int, Callable[..., bytes]] = {
            **self.outputs.commands,
            **self.inputs.commands,
            0x00: self._start_program,
            0x01: self._stop_program,
            0x03: lambda hertz, ms: b"",
            0x0B: lambda: struct.pack("<H", int(self.battery_mv)),
            0x0D: self._keep_alive,
            0x11: self._running_name,
            0x88: lambda: _VERSIONS,
            0x98: self._rename_brick,
            0x9B: lambda: struct.pack("<15s7s4xI", self._name, ADDRESS, _FLASH_BYTES),
        }

    @property
    def battery_mv(self) -> float:
        """The battery's voltage now, in mV, at least 5500."""
        return max(self._full_mv - self._sag_mv_min * (self._clock() - self._began_s) / 60, 5500.0)

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
        status, payload = Status.OK, b""
        try:
            if request.command is None:
                raise RefusedError(Status.UNKNOWN_COMMAND)
            payload = self._commands[request.opcode](*request.command.parse_fields(request.body))
        except RefusedError as refused:
            status, payload = refused.status, bytes(0 if request.command is None else request.command.error_bytes)
        return build_reply(request.opcode, status, payload) if request.wants_reply else None

    def _start_program(self, name: bytes) -> bytes:
        if name.split(b"\0")[0].decode("latin-1") not in self._programs:
            raise RefusedError(Status.OUT_OF_RANGE)
        return self._switch_program(name)

    def _stop_program(self) -> bytes:
        self._running_name()
        return self._switch_program(b"")

    def _switch_program(self, name: bytes) -> bytes:
        self._running = name
        self.outputs.release()
        self.inputs.reset_ports()
        return b""

    def _running_name(self) -> bytes:
        if not self._running:
            raise RefusedError(Status.NO_PROGRAM)
        return self._running

    def _keep_alive(self) -> bytes:
        self._awake_s = self._clock()
        return struct.pack("<I", int(1000 * self._sleep_s))

    def _rename_brick(self, name: bytes) -> bytes:
        self._name = name.split(b"\0")[0][:15]
        return b""
