"""The brick's telegrams as values and back: pure functions, no input or output.

A telegram is a type byte, an opcode and a body; on Bluetooth its length goes before it
(`framed`). One class a command holds the body's fields in the order of the bytes; its
`REPLY` is what a successful answer holds. A value out of bounds cannot be made, so nothing
wrong can be sent, and bytes that are no value raise TelegramError.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import ClassVar, Generic, Self, TypeVar, cast

from probewise.arm.nxt.status import OK, error_of
from probewise.arm.nxt.wire import Block, Counted, Packed, TelegramError, Text, Whole, field_of, shown
from probewise.errors import ParameterError

__all__ = [
    "ALL_OUTPUTS",
    "LONGEST",
    "REQUESTS",
    "BatteryLevel",
    "DeviceInfo",
    "Done",
    "FirmwareVersion",
    "GetBatteryLevel",
    "GetCurrentProgramName",
    "GetDeviceInfo",
    "GetFirmwareVersion",
    "GetInputValues",
    "GetOutputState",
    "InputValues",
    "KeepAlive",
    "LsData",
    "LsGetStatus",
    "LsRead",
    "LsStatus",
    "LsWrite",
    "Message",
    "MessageRead",
    "MessageWrite",
    "Mode",
    "OutputMode",
    "OutputState",
    "PlayTone",
    "ProgramName",
    "Regulation",
    "Reply",
    "Request",
    "ResetInputScaledValue",
    "ResetMotorPosition",
    "RunState",
    "SensorType",
    "Sent",
    "SetBrickName",
    "SetInputMode",
    "SetOutputState",
    "SleepLimit",
    "StartProgram",
    "StopProgram",
    "StopSoundPlayback",
    "decode",
    "encode",
    "framed",
]

R_co = TypeVar("R_co", bound=Packed, covariant=True)

SYSTEM, REPLY, NO_REPLY = 0x01, 0x02, 0x80
FIRST_SYSTEM_OPCODE = 0x80
LONGEST = 128
"""Bytes of the longest telegram that a brick sends or takes over Bluetooth."""

_U8, _S8 = Whole("B", 0, 0xFF), Whole("b", -0x80, 0x7F)
_U16, _S16 = Whole("H", 0, 0xFFFF), Whole("h", -0x8000, 0x7FFF)
_U32, _S32 = Whole("I", 0, 0xFFFFFFFF), Whole("i", -0x80000000, 0x7FFFFFFF)
_OUTPUT, _INPUT, _PERCENT = Whole("B", 0, 2), Whole("B", 0, 3), Whole("b", -100, 100)
_FLAG, _MAILBOX = Whole("B", 0, 1), Whole("B", 0, 19)

ALL_OUTPUTS = 0xFF


class SensorType(IntEnum):
    """What is plugged into an input."""

    NONE = 0x00
    SWITCH = 0x01
    TEMPERATURE = 0x02
    RCX_LIGHT = 0x03
    RCX_ANGLE = 0x04
    LIGHT_ACTIVE = 0x05  # its LED on
    LIGHT_INACTIVE = 0x06  # its LED off
    SOUND_DB = 0x07
    SOUND_DBA = 0x08
    CUSTOM = 0x09
    LOWSPEED = 0x0A
    LOWSPEED_9V = 0x0B
    HIGHSPEED = 0x0C
    COLOR_FULL = 0x0D
    COLOR_RED = 0x0E
    COLOR_GREEN = 0x0F
    COLOR_BLUE = 0x10
    COLOR_NONE = 0x11
    INTERNAL = 0x12


class Mode(IntEnum):
    """How an input is read; a boolean's slope, 0 to 31, is added."""

    RAW = 0x00
    BOOLEAN = 0x20
    TRANSITIONS = 0x40
    PERIODS = 0x60
    PERCENT = 0x80
    CELSIUS = 0xA0
    FAHRENHEIT = 0xC0
    ANGLE_STEPS = 0xE0


class OutputMode(IntFlag):
    """How a motor is driven."""

    IDLE = 0x00
    ON = 0x01
    BRAKE = 0x02
    REGULATED = 0x04


class Regulation(IntEnum):
    """What is regulated."""

    IDLE = 0x00
    SPEED = 0x01
    SYNC = 0x02


class RunState(IntEnum):
    """What a motor is doing; the brick shows others in passing."""

    IDLE = 0x00
    RAMP_UP = 0x10
    RUNNING = 0x20
    RAMP_DOWN = 0x40


@dataclass(frozen=True)
class Done(Packed):
    """The brick has taken the command."""


@dataclass(frozen=True)
class Request(Packed, Generic[R_co]):
    """A command; `R_co` is what a successful answer holds."""

    OPCODE: ClassVar[int]
    REPLY: ClassVar[type[Packed]] = Done

    @property
    def repeatable(self) -> bool:
        """Whether sending it twice does no more than sending it once."""
        return True

    @property
    def name(self) -> str:
        """The command's name, as LEGO writes it."""
        return type(self).__name__.upper()

    def answer(self, reply: Reply) -> R_co:
        """Read the answer to this command.

        Raises
        ------
        BrickError
            If the brick refused it: the status says why; its subclass NotYetError where there is nothing yet.
        TelegramError
            If the reply is one to another command, or its length is wrong.
        """
        if reply.opcode != self.OPCODE:
            raise TelegramError(f"a reply to opcode {reply.opcode:02X} came for {self.name}, {self.OPCODE:02X}")
        # A refusal has the full length with zeros, or none: its status says all there is.
        if reply.status != OK:
            raise error_of(self.name, reply.status)
        return cast(R_co, self.REPLY.unpack(reply.body))


@dataclass(frozen=True)
class StartProgram(Request[Done]):
    """Start a program on the brick, by its file name with its extension."""

    OPCODE = 0x00
    file: str = field_of(Text(20, sent=True))

    @property
    def repeatable(self) -> bool:
        """Starting again would begin anew."""
        return False


@dataclass(frozen=True)
class StopProgram(Request[Done]):
    """Stop the program that runs."""

    OPCODE = 0x01


@dataclass(frozen=True)
class PlayTone(Request[Done]):
    """Sound a tone; it takes the place of one that still sounds."""

    OPCODE = 0x03
    frequency_hz: int = field_of(Whole("H", 200, 14000))
    duration_ms: int = field_of(_U16)


@dataclass(frozen=True)
class SetOutputState(Request[Done]):
    """Drive a motor, or all with port 255; a limit of 0 counts is none."""

    OPCODE = 0x04
    port: int = field_of(Whole("B", 0, 2, (ALL_OUTPUTS,)))
    power: int = field_of(_PERCENT)
    mode: int = field_of(Whole("B", 0, 7))
    regulation: int = field_of(Whole("B", 0, 2))
    turn_ratio: int = field_of(_PERCENT)
    run_state: int = field_of(Whole("B", 0, 0, (0x10, 0x20, 0x40)))
    limit_counts: int = field_of(_U32)

    @property
    def repeatable(self) -> bool:
        """Limits add up: a move sent twice would go twice as far."""
        return self.limit_counts == 0


@dataclass(frozen=True)
class SetInputMode(Request[Done]):
    """Say what is plugged into an input and how to read it."""

    OPCODE = 0x05
    port: int = field_of(_INPUT)
    type: int = field_of(Whole("B", 0, 0x12))
    mode: int = field_of(_U8)


@dataclass(frozen=True)
class OutputState(Packed):
    """What a motor is doing, and its three counters in counts (degrees of its shaft)."""

    port: int = field_of(_U8)
    power: int = field_of(_S8)
    mode: int = field_of(_U8)
    regulation: int = field_of(_U8)
    turn_ratio: int = field_of(_S8)
    run_state: int = field_of(_U8)
    limit_counts: int = field_of(_U32)
    tacho_counts: int = field_of(_S32)
    block_counts: int = field_of(_S32)
    rotation_counts: int = field_of(_S32)


@dataclass(frozen=True)
class GetOutputState(Request[OutputState]):
    """Ask what a motor is doing."""

    OPCODE = 0x06
    REPLY = OutputState
    port: int = field_of(_OUTPUT)


@dataclass(frozen=True)
class InputValues(Packed):
    """What an input reads; of no use while `valid` is 0."""

    port: int = field_of(_U8)
    valid: int = field_of(_U8)
    calibrated: int = field_of(_U8)
    type: int = field_of(_U8)
    mode: int = field_of(_U8)
    raw: int = field_of(_U16)
    normalized: int = field_of(_U16)
    scaled: int = field_of(_S16)
    calibrated_value: int = field_of(_S16)


@dataclass(frozen=True)
class GetInputValues(Request[InputValues]):
    """Ask what an input reads."""

    OPCODE = 0x07
    REPLY = InputValues
    port: int = field_of(_INPUT)


@dataclass(frozen=True)
class ResetInputScaledValue(Request[Done]):
    """Set an input's scaled value to 0."""

    OPCODE = 0x08
    port: int = field_of(_INPUT)


@dataclass(frozen=True)
class MessageWrite(Request[Done]):
    """Put a message into a mailbox of the program that runs; its last byte is 0."""

    OPCODE = 0x09
    mailbox: int = field_of(_MAILBOX)
    data: bytes = field_of(Counted(59, padded=False, shortest=1))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.data[-1]:
            raise ParameterError("data", self.data, "bytes of which the last is 0")

    @property
    def repeatable(self) -> bool:
        """The program would read it twice."""
        return False


@dataclass(frozen=True)
class ResetMotorPosition(Request[Done]):
    """Set the block counter (`relative` 1) or the rotation counter (0) of a motor to 0."""

    OPCODE = 0x0A
    port: int = field_of(_OUTPUT)
    relative: int = field_of(_FLAG)


@dataclass(frozen=True)
class BatteryLevel(Packed):
    """The battery's voltage."""

    millivolt: int = field_of(_U16)


@dataclass(frozen=True)
class GetBatteryLevel(Request[BatteryLevel]):
    """Ask for the battery's voltage."""

    OPCODE = 0x0B
    REPLY = BatteryLevel


@dataclass(frozen=True)
class StopSoundPlayback(Request[Done]):
    """Be silent."""

    OPCODE = 0x0C


@dataclass(frozen=True)
class SleepLimit(Packed):
    """After how long without keys or keep-alives the brick switches itself off; 0: never."""

    limit_ms: int = field_of(_U32)


@dataclass(frozen=True)
class KeepAlive(Request[SleepLimit]):
    """Start the brick's sleep timer anew: no other command does."""

    OPCODE = 0x0D
    REPLY = SleepLimit


@dataclass(frozen=True)
class LsStatus(Packed):
    """How many bytes an I2C sensor has ready."""

    bytes_ready: int = field_of(_U8)


@dataclass(frozen=True)
class LsGetStatus(Request[LsStatus]):
    """Ask whether an I2C sensor has answered."""

    OPCODE = 0x0E
    REPLY = LsStatus
    port: int = field_of(_INPUT)


@dataclass(frozen=True)
class LsWrite(Request[Done]):
    """Send bytes to an I2C sensor and say how many are to come back."""

    OPCODE = 0x0F
    port: int = field_of(_INPUT)
    n_answer: int = field_of(Whole("B", 0, 16))
    data: bytes = field_of(Counted(16, padded=False))

    @property
    def repeatable(self) -> bool:
        """A sensor may act on what it is sent."""
        return False

    def pack(self) -> bytes:
        """Write the count of bytes sent before that of bytes wanted, as the brick has it."""
        return bytes([self.port, len(self.data), self.n_answer]) + self.data

    @classmethod
    def unpack(cls, raw: bytes) -> Self:
        """Read the two counts in their order."""
        return super().unpack(raw[:1] + raw[2:3] + raw[1:2] + raw[3:])


@dataclass(frozen=True)
class LsData(Packed):
    """What an I2C sensor answered, up to 16 bytes."""

    data: bytes = field_of(Counted(16, padded=True))


@dataclass(frozen=True)
class LsRead(Request[LsData]):
    """Fetch what an I2C sensor answered."""

    OPCODE = 0x10
    REPLY = LsData
    port: int = field_of(_INPUT)

    @property
    def repeatable(self) -> bool:
        """What was fetched is gone."""
        return False


@dataclass(frozen=True)
class ProgramName(Packed):
    """The file name of the program that runs."""

    file: str = field_of(Text(20, sent=False))


@dataclass(frozen=True)
class GetCurrentProgramName(Request[ProgramName]):
    """Ask which program runs."""

    OPCODE = 0x11
    REPLY = ProgramName


@dataclass(frozen=True)
class Message(Packed):
    """A message out of a mailbox, with the 0 at its end."""

    mailbox: int = field_of(_U8)
    data: bytes = field_of(Counted(59, padded=True))


@dataclass(frozen=True)
class MessageRead(Request[Message]):
    """Fetch a message that the brick's program wrote, and take it out of the mailbox (`remove` 1) or not."""

    OPCODE = 0x13
    REPLY = Message
    mailbox: int = field_of(_MAILBOX)
    local_mailbox: int = field_of(_U8)
    remove: int = field_of(_FLAG)

    @property
    def repeatable(self) -> bool:
        """A message that was removed is gone."""
        return not self.remove


@dataclass(frozen=True)
class FirmwareVersion(Packed):
    """Versions of protocol and firmware."""

    protocol_minor: int = field_of(_U8)
    protocol_major: int = field_of(_U8)
    firmware_minor: int = field_of(_U8)
    firmware_major: int = field_of(_U8)


@dataclass(frozen=True)
class GetFirmwareVersion(Request[FirmwareVersion]):
    """Ask for the versions of protocol and firmware."""

    OPCODE = 0x88
    REPLY = FirmwareVersion


@dataclass(frozen=True)
class DeviceInfo(Packed):
    """Who the brick is: its name, its Bluetooth address (six bytes and a 0), its free memory in bytes."""

    brick_name: str = field_of(Text(15, sent=False))
    address: bytes = field_of(Block(7))
    link_quality: bytes = field_of(Block(4))
    free_flash: int = field_of(_U32)

    @property
    def address_text(self) -> str:
        """The address as it is usually written."""
        return self.address[:6].hex(":").upper()


@dataclass(frozen=True)
class GetDeviceInfo(Request[DeviceInfo]):
    """Ask who the brick is."""

    OPCODE = 0x9B
    REPLY = DeviceInfo


@dataclass(frozen=True)
class SetBrickName(Request[Done]):
    """Give the brick another name."""

    OPCODE = 0x98
    brick_name: str = field_of(Text(16, sent=True))


REQUESTS: dict[int, type[Request[Packed]]] = {
    kind.OPCODE: kind
    for kind in (
        StartProgram,
        StopProgram,
        PlayTone,
        SetOutputState,
        SetInputMode,
        GetOutputState,
        GetInputValues,
        ResetInputScaledValue,
        MessageWrite,
        ResetMotorPosition,
        GetBatteryLevel,
        StopSoundPlayback,
        KeepAlive,
        LsGetStatus,
        LsWrite,
        LsRead,
        GetCurrentProgramName,
        MessageRead,
        GetFirmwareVersion,
        SetBrickName,
        GetDeviceInfo,
    )
}
"""Every command by its opcode."""


@dataclass(frozen=True)
class Sent:
    """A command on its way: what it says, and whether an answer is wanted."""

    request: Request[Packed]
    wants_reply: bool


@dataclass(frozen=True)
class Reply:
    """An answer as it comes: to which opcode, its status, its body still in bytes."""

    opcode: int
    status: int
    body: bytes

    def pack(self) -> bytes:
        """Write the telegram."""
        return bytes([REPLY, self.opcode, self.status]) + self.body


def encode(request: Request[Packed], *, wants_reply: bool = True) -> bytes:
    """Write a command's telegram, without its length."""
    first = SYSTEM if request.OPCODE >= FIRST_SYSTEM_OPCODE else 0
    return bytes([first if wants_reply else first | NO_REPLY, request.OPCODE]) + request.pack()


def decode(telegram: bytes) -> Sent | Reply:
    """Read a telegram, without its length.

    Raises
    ------
    TelegramError
        If the bytes are none: too short, another type, an opcode that is no command, a body that does not fit.
    """
    if len(telegram) < 2:
        raise TelegramError(f"a telegram has a type and an opcode; there is {shown(telegram)}")
    first, opcode = telegram[0], telegram[1]
    if first == REPLY:
        if len(telegram) < 3:
            raise TelegramError(f"a reply has a status; there is {shown(telegram)}")
        return Reply(opcode, telegram[2], telegram[3:])
    if first & ~(SYSTEM | NO_REPLY):
        raise TelegramError(f"type {first:02X} is none of 00, 01, 02, 80, 81")
    if opcode not in REQUESTS or bool(first & SYSTEM) != (opcode >= FIRST_SYSTEM_OPCODE):
        raise TelegramError(f"opcode {opcode:02X} is no {'system' if first & SYSTEM else 'direct'} command known here")
    return Sent(REQUESTS[opcode].unpack(telegram[2:]), wants_reply=not first & NO_REPLY)


def framed(telegram: bytes) -> bytes:
    """Put a telegram's length before it, as on Bluetooth."""
    return struct.pack("<H", len(telegram)) + telegram
