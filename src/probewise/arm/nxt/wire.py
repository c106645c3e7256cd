"""How the fields of a telegram stand in its bytes: whole numbers (little-endian), texts, blocks.

A telegram's body is a frozen dataclass whose fields are made by `field_of(kind)`. The kind knows
the bytes of one field and what values it may have; `Packed` strings the fields together.
"""

from __future__ import annotations

import dataclasses
import struct
from dataclasses import dataclass
from typing import Any, Protocol, Self

from probewise.errors import LinkError, ParameterError

__all__ = ["Block", "Counted", "Kind", "Packed", "TelegramError", "Text", "Whole", "field_of"]


class TelegramError(LinkError):
    """Report bytes that are no telegram: what they were, what was expected."""


class Kind(Protocol):
    """One field's bytes."""

    @property
    def size(self) -> int | None:
        """How many bytes it takes; None: all that are left."""
        ...

    def check(self, name: str, value: Any) -> None:
        """Raise ParameterError where the field cannot have this value."""
        ...

    def pack(self, value: Any) -> bytes:
        """Write a checked value."""
        ...

    def unpack(self, raw: bytes) -> Any:
        """Read a value, to be checked.

        Raises
        ------
        ValueError
            If no value has these bytes.
        """
        ...


@dataclass(frozen=True)
class Whole:
    """A whole number: `code` as in the module struct, `low` to `high`, or one of `others`."""

    code: str
    low: int
    high: int
    others: tuple[int, ...] = ()

    @property
    def size(self) -> int:
        """As many bytes as the code says."""
        return struct.calcsize(self.code)

    def check(self, name: str, value: Any) -> None:
        """Take whole numbers within the bounds."""
        plain = isinstance(value, int) and not isinstance(value, bool)
        if not plain or not (self.low <= value <= self.high or value in self.others):
            more = "".join(f" or {other}" for other in self.others)
            raise ParameterError(name, value, f"a whole number from {self.low} to {self.high}{more}")

    def pack(self, value: int) -> bytes:
        """Write it little-endian."""
        return struct.pack("<" + self.code, value)

    def unpack(self, raw: bytes) -> int:
        """Read it little-endian."""
        return int(struct.unpack("<" + self.code, raw)[0])


@dataclass(frozen=True)
class Text:
    """A text with a NUL behind it, padded with NULs to `width` bytes.

    Of what the brick says every byte is taken (Latin-1), with or without the NUL; what is sent to
    it, `sent`, must be printable ASCII, not empty, and may come back in a shorter field.
    """

    width: int
    sent: bool

    @property
    def size(self) -> int | None:
        """The field's width; what was sent by others may be narrower."""
        return None if self.sent else self.width

    def check(self, name: str, value: Any) -> None:
        """Take texts short enough for the field."""
        longest = self.width - 1 if self.sent else self.width
        good = isinstance(value, str) and len(value) <= longest
        if self.sent:
            good = good and bool(value) and value.isascii() and value.isprintable()
        else:
            good = good and "\0" not in value and all(ord(letter) < 256 for letter in value)
        if not good:
            kind = "1 to {} printable ASCII letters" if self.sent else "up to {} Latin-1 letters"
            raise ParameterError(name, value, kind.format(longest))

    def pack(self, value: str) -> bytes:
        """Pad to the field's width."""
        return value.encode("latin-1").ljust(self.width, b"\0")

    def unpack(self, raw: bytes) -> str:
        """Take the letters before the first NUL."""
        if self.sent and not (len(raw) <= self.width and b"\0" in raw):
            raise ValueError(f"a text in up to {self.width} bytes that end with 00")
        return raw.partition(b"\0")[0].decode("latin-1")


@dataclass(frozen=True)
class Block:
    """So many plain bytes."""

    size: int

    def check(self, name: str, value: Any) -> None:
        """Take exactly that many bytes."""
        if not isinstance(value, bytes) or len(value) != self.size:
            raise ParameterError(name, value, f"{self.size} bytes")

    def pack(self, value: bytes) -> bytes:
        """Write them as they are."""
        return value

    def unpack(self, raw: bytes) -> bytes:
        """Read them as they are."""
        return raw


@dataclass(frozen=True)
class Counted:
    """A count and that many bytes, at most `longest`; `padded` with zeros to that length or not."""

    longest: int
    padded: bool
    shortest: int = 0

    @property
    def size(self) -> int | None:
        """Count and room for the longest, where padded."""
        return 1 + self.longest if self.padded else None

    def check(self, name: str, value: Any) -> None:
        """Take bytes within the limits."""
        if not isinstance(value, bytes) or not self.shortest <= len(value) <= self.longest:
            raise ParameterError(name, value, f"{self.shortest} to {self.longest} bytes")

    def pack(self, value: bytes) -> bytes:
        """Write count, bytes, padding."""
        return bytes([len(value)]) + (value.ljust(self.longest, b"\0") if self.padded else value)

    def unpack(self, raw: bytes) -> bytes:
        """Read as many bytes as the count says."""
        if not raw or raw[0] > len(raw) - 1 or (not self.padded and raw[0] != len(raw) - 1):
            raise ValueError(f"a count and as many bytes, up to {self.longest}")
        return raw[1 : 1 + raw[0]]


def field_of(kind: Kind, *, default: Any = dataclasses.MISSING) -> Any:
    """Make a dataclass field with these bytes."""
    return dataclasses.field(default=default, metadata={"kind": kind})


@dataclass(frozen=True)
class Packed:
    """A telegram's body: fields one after another, each within its bounds."""

    def __post_init__(self) -> None:
        for name, kind in _fields(type(self)):
            kind.check(name, getattr(self, name))

    def pack(self) -> bytes:
        """Write the fields."""
        return b"".join(kind.pack(getattr(self, name)) for name, kind in _fields(type(self)))

    @classmethod
    def size(cls) -> int | None:
        """How many bytes the fields take; None where that varies."""
        sizes = [kind.size for _, kind in _fields(cls)]
        fixed = [size for size in sizes if size is not None]
        return sum(fixed) if len(fixed) == len(sizes) else None

    @classmethod
    def unpack(cls, raw: bytes) -> Self:
        """Read the fields.

        Raises
        ------
        TelegramError
            If there are too few or too many bytes, or a field has a value that it cannot have.
        """
        values: dict[str, Any] = {}
        at = 0
        try:
            for name, kind in _fields(cls):
                end = len(raw) if kind.size is None else at + kind.size
                if end > len(raw):
                    raise ValueError(f"{end} bytes or more for {name}; there are {len(raw)}")
                values[name] = kind.unpack(raw[at:end])
                at = end
            if at != len(raw):
                raise ValueError(f"{at} bytes; there are {len(raw)}")
            return cls(**values)
        except ValueError as error:  # ParameterError, from a value out of bounds, is one too
            raise TelegramError(f"{cls.__name__} cannot be read from {shown(raw)}: {error}") from error


def shown(raw: bytes) -> str:
    """Show bytes as a person compares them."""
    return raw.hex(" ").upper() or "no bytes"


def _fields(cls: type[Packed]) -> tuple[tuple[str, Kind], ...]:
    return tuple((field.name, field.metadata["kind"]) for field in dataclasses.fields(cls))
