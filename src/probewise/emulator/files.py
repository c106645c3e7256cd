"""The brick's flash file system, and the file commands."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase

from probewise.emulator.protocol import RefusedError, Status

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
    """The flash file system: the files, the open handles, and the file commands by opcode (`commands`).

    Parameters
    ----------
    contents
        The files at the start, by name.
    capacity
        Bytes of flash.
    """

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
