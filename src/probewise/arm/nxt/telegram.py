"""Encoding and decoding of the brick's telegrams: pure functions without input or output.

A telegram is a type byte, an opcode and a body, on Bluetooth preceded by its length (`framed`); numbers are
little-endian. Only the commands that the arm needs are here.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar, cast

from probewise.errors import LinkError, require


class TelegramError(LinkError):
    """Raised for bytes that are not the expected telegram; the message shows the bytes and the expectation."""


def in_hex(raw: bytes) -> str:
    """Format bytes in hexadecimal."""
    return raw.hex(" ").upper() or "no bytes"


OK = 0x00

MEANINGS: Mapping[int, str] = {
    0x8A: "undefined error",
    0xBE: "the brick does not know this command",
    0xBF: "the brick finds the telegram malformed",
    0xC0: "a value is out of range: a port that is none, or a file that is not there",
    0xDE: "no room in the communication buffer",
    0xDF: "the connection is not valid",
    0xE0: "the port is busy, or not set up for such a sensor",
    0xEC: "no program is running on the brick",
    0xED: "illegal size",
    0xEF: "invalid structure field",
    0xF0: "no such port",
    0xFB: "the brick is out of memory",
    0xFF: "bad arguments",
}
"""Meanings of the status bytes that these commands get; 00 is success."""


class BrickError(LinkError):
    """Raised if the brick refused a command; `status` is its status byte."""

    def __init__(self, command: str, status: int) -> None:
        self.command, self.status = command, status
        meaning = MEANINGS.get(status, "a status that has no known meaning")
        super().__init__(f"the brick answered {command} with status {status:02X}: {meaning}")

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self.command, self.status)


A_co = TypeVar("A_co", covariant=True)

SYSTEM, REPLY, NO_REPLY = 0x01, 0x02, 0x80
FIRST_SYSTEM_OPCODE = 0x80
LONGEST = 128
"""Bytes of the longest telegram that a brick sends or takes over Bluetooth."""


ALL_OUTPUTS = 0xFF
NO_SENSOR, LED_ON, LED_OFF = 0x00, 0x05, 0x06
"""Types of the sensor at an input: none, the light sensor with its LED on, and off."""
RAW = 0x00  # reading mode of an input
MOTOR_ON, BRAKE, REGULATED = 0x01, 0x02, 0x04
"""Driving modes of a motor, flags."""
BY_SPEED = 0x01  # what is regulated
IDLE, RUNNING = 0x00, 0x20
"""Run states of a motor; the brick also reports transient states."""


class OutputState(NamedTuple):
    """State of a motor, and its three counters in counts (degrees of its shaft)."""

    port: int
    power: int
    mode: int
    regulation: int
    turn_ratio: int
    run_state: int
    limit_counts: int
    tacho_counts: int
    block_counts: int
    rotation_counts: int


class InputValues(NamedTuple):
    """Values of an input, raw and converted; out of date while `valid` is 0."""

    port: int
    valid: int
    calibrated: int
    type: int
    mode: int
    raw: int
    normalized: int
    scaled: int
    calibrated_value: int


class FirmwareVersion(NamedTuple):
    """Versions of protocol and firmware."""

    protocol_minor: int
    protocol_major: int
    firmware_minor: int
    firmware_major: int


@dataclass(frozen=True)
class Request(Generic[A_co]):
    """A command, generic in the type of a successful answer: named fields, a number or text, or None."""

    name: str  # in LEGO's documentation
    opcode: int
    body: bytes = b""  # of a command to a port, beginning with it
    answer: str = ""  # layout of the answer's body, as the module struct has it
    fields: Callable[..., Any] | None = None  # what holds more than one value; its first one is the port
    is_repeatable: bool = True  # whether repeating the command does no harm

    def decode_answer(self, reply: Reply) -> A_co:
        """Decode a reply to this command into its answer.

        BrickError if the brick refused the command; TelegramError for another command, port or length.
        """
        if reply.opcode != self.opcode:
            raise TelegramError(f"a reply to opcode {reply.opcode:02X} came for {self.name}, {self.opcode:02X}")
        # A refusal is padded with zeros, or empty: only its status matters.
        if reply.status != OK:
            raise BrickError(self.name, reply.status)
        layout = "<" + self.answer
        if len(reply.body) != (size := struct.calcsize(layout)):
            raise TelegramError(
                f"the answer to {self.name} has {size} bytes; there are {len(reply.body)}: {in_hex(reply.body)}"
            )
        # A text ends at its first NUL and is Latin-1.
        values = [
            value.partition(b"\0")[0].decode("latin-1") if isinstance(value, bytes) else value
            for value in struct.unpack(layout, reply.body)
        ]
        if self.fields is None:
            return cast(A_co, values[0] if values else None)
        if self.body and values[0] != self.body[0]:
            raise TelegramError(f"an answer about port {values[0]} came for {self.name} of port {self.body[0]}")
        return cast(A_co, self.fields(*values))


def set_output_state(
    port: int, power: int = 0, mode: int = 0, regulation: int = 0, *, run_state: int = IDLE, limit_counts: int = 0
) -> Request[None]:
    """Drive a motor, or all with port 255; `limit_counts` 0 is no limit. The defaults release the motor.

    A limited move is not repeatable: limits add up, so it would go twice as far. Raises ParameterError for a port or a
    power that is none: it would move an arm.
    """
    require(port in (0, 1, 2, ALL_OUTPUTS), "port", port, f"0 to 2, or {ALL_OUTPUTS} for all")
    require(-100 <= power <= 100, "power", power, "-100 to 100")
    body = struct.pack("<BbBBbBI", port, power, mode, regulation, 0, run_state, limit_counts)
    return Request("SETOUTPUTSTATE", 0x04, body, is_repeatable=limit_counts == 0)


def get_output_state(port: int) -> Request[OutputState]:
    """Read the state of a motor."""
    return Request("GETOUTPUTSTATE", 0x06, bytes([port]), "BbBBbBIiii", OutputState)


def reset_rotation_counter(port: int) -> Request[None]:
    """Set the rotation counter of a motor to 0."""
    return Request("RESETMOTORPOSITION", 0x0A, bytes([port, 0]))


def set_input_type(port: int, kind: int) -> Request[None]:
    """Set the sensor type of an input, in raw mode."""
    return Request("SETINPUTMODE", 0x05, bytes([port, kind, RAW]))


def get_input_values(port: int) -> Request[InputValues]:
    """Read the values of an input."""
    return Request("GETINPUTVALUES", 0x07, bytes([port]), "BBBBBHHhh", InputValues)


GET_BATTERY_LEVEL: Request[int] = Request("GETBATTERYLEVEL", 0x0B, answer="H")  # mV
KEEP_ALIVE: Request[int] = Request("KEEPALIVE", 0x0D, answer="I")
"""Reset the brick's sleep timer, which no other command does; the answer is its limit in ms, 0: never."""
GET_CURRENT_PROGRAM_NAME: Request[str] = Request("GETCURRENTPROGRAMNAME", 0x11, answer="20s")
GET_FIRMWARE_VERSION: Request[FirmwareVersion] = Request(
    "GETFIRMWAREVERSION", 0x88, answer="BBBB", fields=FirmwareVersion
)
GET_DEVICE_INFO: Request[str] = Request("GETDEVICEINFO", 0x9B, answer="15s15x")  # the brick's name


@dataclass(frozen=True)
class Reply:
    """A raw reply: opcode, status, and body in bytes."""

    opcode: int
    status: int
    body: bytes


def encode(request: Request[Any], *, wants_reply: bool = True) -> bytes:
    """Encode a command as a telegram, without its length."""
    first = SYSTEM if request.opcode >= FIRST_SYSTEM_OPCODE else 0
    return bytes([first if wants_reply else first | NO_REPLY, request.opcode]) + request.body


def decode(telegram: bytes) -> Reply:
    """Decode a reply, without its length; TelegramError if the bytes are none."""
    if len(telegram) < 3 or telegram[0] != REPLY:
        raise TelegramError(f"a reply has the type 02, an opcode and a status; there is {in_hex(telegram)}")
    return Reply(telegram[1], telegram[2], telegram[3:])


def framed(telegram: bytes) -> bytes:
    """Prefix a telegram with its length, two bytes, as on Bluetooth."""
    return struct.pack("<H", len(telegram)) + telegram
