"""Status bytes of replies, and the error for a refusal."""

from __future__ import annotations

from collections.abc import Mapping

from probewise.errors import LinkError

OK = 0x00

MEANINGS: Mapping[int, str] = {
    0x20: "the transaction with the I2C sensor is still going on",
    0x40: "the mailbox is empty",
    0x81: "no more handles",
    0x82: "no space left",
    0x83: "no more files",
    0x84: "end of file expected",
    0x85: "end of file",
    0x86: "not a linear file",
    0x87: "file not found",
    0x88: "handle closed already",
    0x89: "no linear space",
    0x8A: "undefined error",
    0x8B: "file busy",
    0x8C: "no write buffers",
    0x8D: "appending is not possible",
    0x8E: "file full",
    0x8F: "file exists already",
    0x90: "module not found",
    0x91: "out of the module's bounds",
    0x92: "illegal file name",
    0x93: "illegal handle",
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
    0xEE: "illegal mailbox number",
    0xEF: "invalid structure field",
    0xF0: "no such port",
    0xFB: "the brick is out of memory",
    0xFF: "bad arguments",
}
"""Meanings of status bytes; 00 is success."""


class BrickError(LinkError):
    """Raised if the brick refused a command; `status` is its status byte."""

    def __init__(self, command: str, status: int) -> None:
        self.command, self.status = command, status
        meaning = MEANINGS.get(status, "a status that has no known meaning")
        super().__init__(f"the brick answered {command} with status {status:02X}: {meaning}")

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self.command, self.status)
