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

if sys.platform != "win32":
    import fcntl

_WRITABLE = "a file in an existing, writable folder"


def write_bytes_atomically(path: str | os.PathLike[str], content: bytes, *, named: bool = True) -> None:
    """Replace the file at `path` by `content` atomically; its permissions stay.

    The bytes are written to a temporary file in the same folder and synced to disk; then it is renamed. Temporary files
    that killed processes left are removed.

    Parameters
    ----------
    path, content
        The file and its content.
    named
        Whether a person has named this very file: then a symbolic link is followed, and a device or a named pipe is
        written to. One that stands where a further file goes is replaced.

    Raises
    ------
    FileError
        If the folder does not exist or cannot be written to, `path` is a folder, or the disk is full.
    """
    path = Path(path)
    try:
        mode = _mode_of(path, follow_links=named)
        if named and mode is not None and not stat.S_ISREG(mode):  # a folder cannot be opened
            with open(path, "wb", buffering=0) as file:
                _write_all(file, content)
            return
        target = Path(os.path.realpath(path)) if named else path
    except (OSError, ValueError) as error:
        raise _error_of_writing(path, error, _WRITABLE) from error
    for left in target.parent.glob(f".{glob.escape(target.name)}.*.part"):
        _remove_unless_being_written(left)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
    with defer_signals():
        try:
            with open(temporary, "xb", buffering=0) as file:
                with contextlib.suppress(OSError):  # a file system without locks: others may remove the file
                    _lock(file.fileno())
                write_and_sync(file, path, content)
            if mode is not None and stat.S_ISREG(mode):
                os.chmod(temporary, stat.S_IMODE(mode))
            os.replace(temporary, target)
        except OSError as error:
            raise _error_of_writing(path, error, _WRITABLE) from error
        finally:
            with contextlib.suppress(OSError):
                os.unlink(temporary)


def write_text_atomically(path: str | os.PathLike[str], text: str, *, named: bool = True) -> None:
    """Replace the file at `path` by `text` in UTF-8, as `write_bytes_atomically` does, with line ends unchanged."""
    write_bytes_atomically(path, text.encode("utf-8"), named=named)


def write_and_sync(file: FileIO, path: Path, content: bytes) -> None:
    """Write all of `content` to an open, unbuffered file and sync it to the disk; `path` is its name in messages.

    Raises
    ------
    FileError
        If it cannot be written or synced, as on a full disk.
    """
    try:
        _write_all(file, content)
        os.fsync(file.fileno())
    except OSError as error:
        raise _error_of_writing(path, error, "a file on a disk with room") from error


def refuse_links(folder: Path, *names: str) -> None:
    """Raise FileError if one of these entries of a folder, or an entry of one, is a symbolic link: it may lead out."""
    for named in (folder / name for name in names):
        inner = named.iterdir() if named.is_dir() and not named.is_symlink() else ()
        for entry in (named, *inner):
            if entry.is_symlink():
                raise FileError(entry, "is a symbolic link, which may lead out of the folder", "another --out, or none")


def is_device_or_pipe(path: Path) -> bool:
    """Return whether something is at `path` that is neither a file nor a folder."""
    return path.exists() and not path.is_file() and not path.is_dir()


def _mode_of(path: Path, *, follow_links: bool) -> int | None:
    try:
        return path.stat(follow_symlinks=follow_links).st_mode
    except FileNotFoundError:  # or a symbolic link to a file that is to be made
        return None


def _write_all(file: FileIO, content: bytes) -> None:
    left_over = memoryview(content)
    while left_over:
        left_over = left_over[file.write(left_over) :]


def _error_of_writing(path: Path, error: Exception, allowed: str) -> FileError:
    return FileError(path, f"cannot be written ({getattr(error, 'strerror', None) or error})", allowed)


def _lock(handle: int) -> None:
    """Mark an open file as being written, until it is closed; Windows lets nobody remove an open file anyway."""
    if sys.platform != "win32":
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _remove_unless_being_written(path: Path) -> None:
    with contextlib.suppress(OSError):
        if sys.platform == "win32":
            path.unlink()
        elif stat.S_ISREG(path.lstat().st_mode):
            handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                _lock(handle)
                path.unlink()
            finally:
                os.close(handle)
