"""Byte layout of a telegram's fields: little-endian integers, and texts."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from probewise.errors import LinkError, ParameterError


class TelegramError(LinkError):
    """Raised for bytes that are not the expected telegram; the message shows the bytes and the expectation."""


@dataclass(frozen=True)
class IntegerField:
    """An integer field: its `code` in Python's module struct; allowed are `low` to `high`, and `others`."""

    code: str
    low: int
    high: int
    others: tuple[int, ...] = ()

    def check(self, name: str, value: Any) -> None:
        """Raise ParameterError unless the value is an integer within the bounds."""
        plain = isinstance(value, int) and not isinstance(value, bool)
        if not plain or not (self.low <= value <= self.high or value in self.others):
            more = "".join(f" or {other}" for other in self.others)
            raise ParameterError(name, value, f"a whole number from {self.low} to {self.high}{more}")


def packed_field(kind: IntegerField, default: Any = dataclasses.MISSING) -> Any:
    """Return a dataclass field of a command, packed as `kind`; without a default, the field is required."""
    return dataclasses.field(default=default, metadata={"kind": kind})


@dataclass(frozen=True)
class CommandFields:
    """Body of a command: successive integers, each within its bounds."""

    def __post_init__(self) -> None:
        for name, kind in self._named_fields():
            kind.check(name, getattr(self, name))

    def pack(self) -> bytes:
        """Encode the fields."""
        return b"".join(struct.pack("<" + kind.code, getattr(self, name)) for name, kind in self._named_fields())

    def _named_fields(self) -> Iterator[tuple[str, IntegerField]]:
        return ((field.name, field.metadata["kind"]) for field in dataclasses.fields(self))


@dataclass(frozen=True)
class Answer:
    """Body of an answer: successive fields, with their little-endian `LAYOUT` as in Python's module struct."""

    LAYOUT: ClassVar[str] = ""

    @classmethod
    def unpack(cls, raw: bytes) -> Self:
        """Decode the fields; a text ends at its first NUL and is Latin-1.

        Raises
        ------
        TelegramError
            If the number of bytes is wrong.
        """
        try:
            values = struct.unpack("<" + cls.LAYOUT, raw)
        except struct.error as error:
            size = struct.calcsize("<" + cls.LAYOUT)
            raise TelegramError(f"{cls.__name__} has {size} bytes; there are {len(raw)}: {in_hex(raw)}") from error
        return cls(*(_text_before_nul(value) if isinstance(value, bytes) else value for value in values))


def in_hex(raw: bytes) -> str:
    """Format bytes in hexadecimal."""
    return raw.hex(" ").upper() or "no bytes"


def _text_before_nul(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode("latin-1")
