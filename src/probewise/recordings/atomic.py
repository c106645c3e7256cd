"""Writing of files, each whole or not at all."""

from __future__ import annotations

import contextlib
import glob
import os
import secrets
import stat
import sys
from io import FileIO
from pathlib import Path

from probewise._signals import defer_signals
from probewise.errors import FileError


def write_bytes_atomically(path: str | os.PathLike[str], content: bytes, *, named: bool = True) -> None:
    """Replace the file at `path` by `content` atomically; its permissions stay.

    The bytes are written to a temporary file in the same folder and synced to disk; then it is renamed. Temporary
    files that killed processes left are removed. If a person has `named` this very file, a symbolic link is followed,
    and a device or a named pipe is written to; one that stands where a further file goes is replaced.

    Raises FileError if the folder does not exist or cannot be written to, `path` is a folder, or the disk is full.
    """
    path = Path(path)
    try:
        if named and is_device_or_pipe(path):
            with open(path, "wb", buffering=0) as file:
                _write_all(file, content)
            return
        target = Path(os.path.realpath(path)) if named else path
        for left in target.parent.glob(f".{glob.escape(target.name)}.*.part"):
            _remove_unless_being_written(left)
        temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
        with defer_signals(), contextlib.ExitStack() as stack:
            with open(temporary, "xb", buffering=0) as file:
                stack.callback(temporary.unlink, missing_ok=True)
                with contextlib.suppress(OSError):  # where files cannot be locked, nobody removes it
                    _lock(file.fileno())
                write_and_sync(file, path, content)
            if target.is_file() and not target.is_symlink():
                os.chmod(temporary, stat.S_IMODE(target.stat().st_mode))
            os.replace(temporary, target)
    except (OSError, ValueError) as error:
        if isinstance(error, FileError):
            raise
        raise _error_of_writing(path, error, "a file in an existing, writable folder") from error


def write_text_atomically(path: str | os.PathLike[str], text: str, *, named: bool = True) -> None:
    """Replace the file at `path` by `text` in UTF-8, as `write_bytes_atomically` does, with line ends unchanged.

    Bytes of a file's name that are no UTF-8, which Python reads as lone surrogates, are written as escapes.
    """
    write_bytes_atomically(path, text.encode("utf-8", "backslashreplace"), named=named)


def write_and_sync(file: FileIO, path: Path, content: bytes) -> None:
    """Write all of `content` to an open, unbuffered file and sync it to disk; FileError, of `path`, if that fails."""
    try:
        _write_all(file, content)
        os.fsync(file.fileno())
    except OSError as error:
        raise _error_of_writing(path, error, "a file on a disk with room") from error


def is_device_or_pipe(path: Path) -> bool:
    """Return whether something is at `path`, or where a symbolic link leads, that is neither a file nor a folder."""
    return path.exists() and not path.is_file() and not path.is_dir()


def _write_all(file: FileIO, content: bytes) -> None:
    left_over = memoryview(content)
    while left_over:
        left_over = left_over[file.write(left_over) :]


def _lock(handle: int) -> None:
    """Lock an open file until it is closed; raise OSError if another process has a lock on it, or without locks."""
    if sys.platform != "win32":  # where nobody can remove an open file
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _remove_unless_being_written(path: Path) -> None:
    with contextlib.suppress(OSError), contextlib.ExitStack() as stack:
        if sys.platform != "win32" and path.is_file():  # a pipe would be waited for
            _lock(stack.enter_context(open(path, "rb")).fileno())
        path.unlink()


def _error_of_writing(path: Path, error: Exception, allowed: str) -> FileError:
    return FileError(path, f"cannot be written ({getattr(error, 'strerror', None) or error})", allowed)
