"""The brick: files, programs, battery and sleep timer, and its replies to telegrams."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from probewise.emulator.inputs import EmptyPort, InputPorts, Sensor
from probewise.emulator.motors import Motor, OutputPorts
from probewise.emulator.protocol import Clock, RefusedError, Request, Status, build_reply, parse_request
from probewise.errors import ParameterError

_N_HANDLES = 16
_NAME = 20
_LONGEST_READ = 122  # what fits a Bluetooth message of 128 bytes


@dataclass
class _OpenFile:
    """An open file, or a search for files, behind one handle."""

    name: str
    at: int = 0
    size: int | None = None  # size requested by a writer; None for a reader
    matches: tuple[str, ...] = ()  # remaining results of a search


class Files:
    """The flash file system, `capacity` bytes: files, open handles, and the file commands by opcode (`commands`)."""

    def __init__(self, contents: Mapping[str, bytes], *, capacity: int) -> None:
        self._files = {name: bytearray(content) for name, content in contents.items()}
        self._capacity = capacity
        self._open_files: dict[int, _OpenFile] = {}
        self.commands: Mapping[int, Callable[..., bytes]] = {
            0x80: self._open_to_read,
            0x81: self._open_to_write,
            0x82: self._read_file,
            0x83: self._write_file,
            0x84: self._close_file,
            0x85: self._delete_file,
            0x86: self._find_first_file,
            0x87: self._find_next_file,
            0x89: self._open_to_write,
            0x8B: self._open_to_write,
            0x8C: self._open_to_append,
            0xA0: self._delete_all_files,
        }

    @property
    def free_bytes(self) -> int:
        """Free bytes of flash; those reserved by open files count as used."""
        promised = sum(opened.size - opened.at for opened in self._open_files.values() if opened.size is not None)
        return self._capacity - promised - sum(len(content) for content in self._files.values())

    def exists(self, name: str) -> bool:
        """Return whether a file exists; names are not case-sensitive."""
        return self._stored_name_or_none(name) is not None

    def _open_to_read(self, name: bytes) -> bytes:
        found = self._checked_stored_name(name)
        return bytes((self._new_handle(_OpenFile(found)),)) + struct.pack("<I", len(self._files[found]))

    def _open_to_write(self, name: bytes, size: int) -> bytes:
        text = _checked_name(name)
        if self.exists(text):
            raise RefusedError(Status.FILE_EXISTS)
        if size > self.free_bytes:
            raise RefusedError(Status.NO_SPACE)
        handle = self._new_handle(_OpenFile(text, size=size))
        self._files[text] = bytearray()
        return bytes((handle,))

    def _open_to_append(self, name: bytes) -> bytes:
        found = self._checked_stored_name(name)
        length = len(self._files[found])
        room = self.free_bytes
        handle = self._new_handle(_OpenFile(found, at=length, size=length + room))
        return bytes((handle,)) + struct.pack("<I", room)

    def _read_file(self, handle: int, wanted: int) -> bytes:
        reader = self._file_of_handle(handle)
        n_read = min(wanted, _LONGEST_READ)
        part = bytes(self._files[reader.name][reader.at : reader.at + n_read])
        reader.at += len(part)
        payload = struct.pack("<BH", handle, n_read) + part.ljust(n_read, b"\0")
        if len(part) < n_read:
            raise RefusedError(Status.END_OF_FILE, payload)
        return payload

    def _write_file(self, handle: int, data: bytes) -> bytes:
        writer = self._file_of_handle(handle)
        if writer.size is None:
            raise RefusedError(Status.ILLEGAL_HANDLE, struct.pack("<BH", handle, 0))
        part = data[: writer.size - writer.at]
        self._files[writer.name] += part
        writer.at += len(part)
        payload = struct.pack("<BH", handle, len(part))
        if len(part) < len(data):
            raise RefusedError(Status.FILE_FULL, payload)
        return payload

    def _close_file(self, handle: int) -> bytes:
        self._file_of_handle(handle)
        del self._open_files[handle]
        return bytes((handle,))

    def _delete_file(self, name: bytes) -> bytes:
        found = self._stored_name_or_none(_checked_name(name))
        if found is None:
            raise RefusedError(Status.FILE_NOT_FOUND, name)
        if any(opened.name == found for opened in self._open_files.values()):
            raise RefusedError(Status.FILE_BUSY, name)
        del self._files[found]
        return name

    def _delete_all_files(self) -> bytes:
        self._files.clear()
        self._open_files.clear()
        return b""

    def _find_first_file(self, pattern: bytes) -> bytes:
        wanted = _checked_name(pattern).lower()
        matches = tuple(name for name in sorted(self._files) if fnmatchcase(name.lower(), wanted))
        if not matches:
            raise RefusedError(Status.FILE_NOT_FOUND)
        return self._find_next_file(self._new_handle(_OpenFile("", matches=matches)))

    def _find_next_file(self, handle: int) -> bytes:
        search = self._file_of_handle(handle)
        matches = tuple(name for name in search.matches if name in self._files)
        if not matches:
            raise RefusedError(Status.FILE_NOT_FOUND, bytes((handle,)) + bytes(24))
        name, search.matches = matches[0], matches[1:]
        return bytes((handle,)) + struct.pack("<20sI", name.encode("latin-1"), len(self._files[name]))

    def _new_handle(self, opened: _OpenFile) -> int:
        for handle in range(_N_HANDLES):
            if handle not in self._open_files:
                self._open_files[handle] = opened
                return handle
        raise RefusedError(Status.NO_MORE_HANDLES)

    def _file_of_handle(self, handle: int) -> _OpenFile:
        if handle >= _N_HANDLES:
            raise RefusedError(Status.ILLEGAL_HANDLE)
        if handle not in self._open_files:
            raise RefusedError(Status.HANDLE_CLOSED)
        return self._open_files[handle]

    def _checked_stored_name(self, name: bytes) -> str:
        found = self._stored_name_or_none(_checked_name(name))
        if found is None:
            raise RefusedError(Status.FILE_NOT_FOUND)
        return found

    def _stored_name_or_none(self, name: str) -> str | None:
        return next((known for known in self._files if known.lower() == name.lower()), None)


def _checked_name(name: bytes) -> str:
    text = name.split(b"\0")[0].decode("latin-1")
    if not 1 <= len(text) < _NAME or "." not in text:
        raise RefusedError(Status.ILLEGAL_FILE_NAME)
    return text


_N_BOXES = 20
_ANSWERS = 10  # a program's outbox n is the host's box n + 10
_DEPTH = 5
_SIZE = 59


class Programs:
    """The brick's running program and its mailboxes; every emulated program echoes each message.

    `exists` says whether there is a program of a name; `on_change` is called when one starts or stops.
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

    Raises ParameterError if the name or `sleep_min` is invalid.

    Parameters
    ----------
    clock
        Time in seconds, for motors and timers.
    motors, sensors
        Motors at ports A, B, C; sensors at ports 1 to 4.
    name, sleep_min
        Up to 14 characters of Latin-1; minutes without KEEPALIVE until the brick switches itself off, 0: never.
    battery
        The battery.
    files
        Files in flash, by name; None: echo.rxe, empty. Each file runs as a program that echoes messages.
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

    def _refuse_reading_map(self, module: int, offset: int, wanted: int) -> bytes:
        raise RefusedError(Status.MODULE_NOT_FOUND, struct.pack("<IH", module, 0) + bytes(min(wanted, 119)))

    def _refuse_writing_map(self, module: int, offset: int, wanted: int, data: bytes) -> bytes:
        raise RefusedError(Status.MODULE_NOT_FOUND, struct.pack("<IH", module, 0))

    def _poll_buffer(self, buffer: int, wanted: int) -> bytes:
        if wanted > _LONGEST_POLL:
            raise RefusedError(Status.UNDEFINED_ERROR, bytes((buffer, 0)))
        return bytes((buffer, 0)) + bytes(wanted)

    def _refuse_module(self, *fields: bytes | int) -> bytes:
        raise RefusedError(Status.MODULE_NOT_FOUND)

    def _refuse_usb_only(self, *fields: bytes) -> bytes:
        raise RefusedError(Status.UNDEFINED_ERROR)
