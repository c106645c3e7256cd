"""Encoding and decoding of the brick's telegrams: pure functions without input or output.

A telegram is a type byte, an opcode and a body, on Bluetooth preceded by its length (`framed`). One class per command
holds the body's fields in the order of the bytes; its `ANSWER` says what a successful answer holds. Construction raises
ParameterError for values out of bounds, and decoding TelegramError for bytes that are not an answer. Only the commands
that the arm needs are here.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Mapping
from dataclasses import MISSING, dataclass
from typing import Any, ClassVar, Generic, TypeVar, cast

from probewise.errors import LinkError, ParameterError


class TelegramError(LinkError):
    """Raised for bytes that are not the expected telegram; the message shows the bytes and the expectation."""


def number(code: str, *bounds: int, default: Any = MISSING) -> Any:
    """Declare a field, a whole number of a `code` of Python's module struct.

    `bounds` of a command's field are its least and greatest value, and others that are allowed: a wrong power or port
    moves an arm.
    """
    return dataclasses.field(default=default, metadata={"code": code, "bounds": bounds})


@dataclass(frozen=True)
class Body:
    """Body of a command or an answer: successive fields (`number`), little-endian."""

    @classmethod
    def layout(cls) -> str:
        """Return the layout of the fields as the module struct has it."""
        return "".join(field.metadata["code"] for field in dataclasses.fields(cls))

    def pack(self) -> bytes:
        """Encode the fields."""
        return struct.pack("<" + self.layout(), *(getattr(self, field.name) for field in dataclasses.fields(self)))


def in_hex(raw: bytes) -> str:
    """Format bytes in hexadecimal."""
    return raw.hex(" ").upper() or "no bytes"


OK = 0x00

MEANINGS: Mapping[int, str] = {
    0x8A: "undefined error",
    0xBD: "the request failed; is there a file of that name on the brick?",
    0xBE: "the brick does not know this command",
    0xBF: "the brick finds the telegram malformed",
    0xC0: "a value is out of range: a port that is none, or a file that is not there",
    0xDD: "I2C bus error; is the sensor plugged in?",
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


@dataclass(frozen=True)
class Request(Body, Generic[A_co]):
    """A command, generic in the type of a successful answer: a body, the only value of `ANSWER`'s layout, or None."""

    OPCODE: ClassVar[int]
    ANSWER: ClassVar[type[Body] | str] = ""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            (low, high, *others), value = field.metadata["bounds"], getattr(self, field.name)
            plain = isinstance(value, int) and not isinstance(value, bool)
            if not plain or not (low <= value <= high or value in others):
                more = "".join(f" or {other}" for other in others)
                raise ParameterError(field.name, value, f"a whole number from {low} to {high}{more}")

    @property
    def is_repeatable(self) -> bool:
        """Whether repeating the command does no harm."""
        return True

    @property
    def name(self) -> str:
        """Name of the command in LEGO's documentation."""
        return type(self).__name__.upper()

    def decode_answer(self, reply: Reply) -> A_co:
        """Decode a reply to this command into its answer.

        BrickError if the brick refused the command; TelegramError for another command, port or length.
        """
        if reply.opcode != self.OPCODE:
            raise TelegramError(f"a reply to opcode {reply.opcode:02X} came for {self.name}, {self.OPCODE:02X}")
        # A refusal is padded with zeros, or empty: only its status matters.
        if reply.status != OK:
            raise BrickError(self.name, reply.status)
        layout = "<" + (self.ANSWER if isinstance(self.ANSWER, str) else self.ANSWER.layout())
        if len(reply.body) != (size := struct.calcsize(layout)):
            raise TelegramError(
                f"the answer to {self.name} has {size} bytes; there are {len(reply.body)}: {in_hex(reply.body)}"
            )
        # A text ends at its first NUL and is Latin-1.
        values = [
            value.partition(b"\0")[0].decode("latin-1") if isinstance(value, bytes) else value
            for value in struct.unpack(layout, reply.body)
        ]
        if isinstance(self.ANSWER, str):
            return cast(A_co, values[0] if values else None)
        said = self.ANSWER(*values)
        if isinstance(said, OutputState | InputValues) and said.port != getattr(self, "port", None):
            raise TelegramError(f"an answer about port {said.port} came for {self}")
        return cast(A_co, said)


@dataclass(frozen=True)
class SetOutputState(Request[None]):
    """Drive a motor, or all with port 255; `limit_counts` 0 is no limit. The defaults release the motor."""

    OPCODE = 0x04
    port: int = number("B", 0, 2, ALL_OUTPUTS)
    power: int = number("b", -100, 100, default=0)
    mode: int = number("B", 0, 7, default=0)
    regulation: int = number("B", 0, 2, default=0)
    turn_ratio: int = number("b", -100, 100, default=0)
    run_state: int = number("B", 0, 0, 0x10, 0x20, 0x40, default=IDLE)
    limit_counts: int = number("I", 0, 0xFFFFFFFF, default=0)

    @property
    def is_repeatable(self) -> bool:
        """False for limited moves: limits add up, so a repeated move would go twice as far."""
        return self.limit_counts == 0


@dataclass(frozen=True)
class SetInputMode(Request[None]):
    """Set the sensor type and the reading mode of an input."""

    OPCODE = 0x05
    port: int = number("B", 0, 3)
    type: int = number("B", 0, 0x12)
    mode: int = number("B", 0, 0xFF)


@dataclass(frozen=True)
class OutputState(Body):
    """State of a motor, and its three counters in counts (degrees of its shaft)."""

    port: int = number("B")
    power: int = number("b")
    mode: int = number("B")
    regulation: int = number("B")
    turn_ratio: int = number("b")
    run_state: int = number("B")
    limit_counts: int = number("I")
    tacho_counts: int = number("i")
    block_counts: int = number("i")
    rotation_counts: int = number("i")


@dataclass(frozen=True)
class GetOutputState(Request[OutputState]):
    """Read the state of a motor."""

    OPCODE = 0x06
    ANSWER = OutputState
    port: int = number("B", 0, 2)


@dataclass(frozen=True)
class InputValues(Body):
    """Values of an input, raw and converted; out of date while `valid` is 0."""

    port: int = number("B")
    valid: int = number("B")
    calibrated: int = number("B")
    type: int = number("B")
    mode: int = number("B")
    raw: int = number("H")
    normalized: int = number("H")
    scaled: int = number("h")
    calibrated_value: int = number("h")


@dataclass(frozen=True)
class GetInputValues(Request[InputValues]):
    """Read the values of an input."""

    OPCODE = 0x07
    ANSWER = InputValues
    port: int = number("B", 0, 3)


@dataclass(frozen=True)
class ResetMotorPosition(Request[None]):
    """Set the block counter (`relative` 1) or the rotation counter (0) of a motor to 0."""

    OPCODE = 0x0A
    port: int = number("B", 0, 2)
    relative: int = number("B", 0, 1)


@dataclass(frozen=True)
class GetBatteryLevel(Request[int]):
    """Read the battery's voltage, in mV."""

    OPCODE = 0x0B
    ANSWER = "H"


@dataclass(frozen=True)
class KeepAlive(Request[int]):
    """Reset the brick's sleep timer, which no other command does; the answer is its limit in ms, 0: never."""

    OPCODE = 0x0D
    ANSWER = "I"


@dataclass(frozen=True)
class GetCurrentProgramName(Request[str]):
    """Read the file name of the running program."""

    OPCODE = 0x11
    ANSWER = "20s"


@dataclass(frozen=True)
class FirmwareVersion(Body):
    """Versions of protocol and firmware."""

    protocol_minor: int = number("B")
    protocol_major: int = number("B")
    firmware_minor: int = number("B")
    firmware_major: int = number("B")


@dataclass(frozen=True)
class GetFirmwareVersion(Request[FirmwareVersion]):
    """Read the versions of protocol and firmware."""

    OPCODE = 0x88
    ANSWER = FirmwareVersion


@dataclass(frozen=True)
class GetDeviceInfo(Request[str]):
    """Read the name of the brick."""

    OPCODE = 0x9B
    ANSWER = "15s15x"


@dataclass(frozen=True)
class Reply:
    """A raw reply: opcode, status, and body in bytes."""

    opcode: int
    status: int
    body: bytes


def encode(request: Request[Any], *, wants_reply: bool = True) -> bytes:
    """Encode a command as a telegram, without its length."""
    first = SYSTEM if request.OPCODE >= FIRST_SYSTEM_OPCODE else 0
    return bytes([first if wants_reply else first | NO_REPLY, request.OPCODE]) + request.pack()


def decode(telegram: bytes) -> Reply:
    """Decode a reply, without its length; TelegramError if the bytes are none."""
    if len(telegram) < 3 or telegram[0] != REPLY:
        raise TelegramError(f"a reply has the type 02, an opcode and a status; there is {in_hex(telegram)}")
    return Reply(telegram[1], telegram[2], telegram[3:])


def framed(telegram: bytes) -> bytes:
    """Prefix a telegram with its length, two bytes, as on Bluetooth."""
    return struct.pack("<H", len(telegram)) + telegram
