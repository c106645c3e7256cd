"""Writing of files, each whole or not at all."""

from __future__ import annotations

import contextlib
import glob
import os
import tempfile
from io import FileIO
from pathlib import Path

from probewise._signals import defer_signals
from probewise.errors import FileError
from probewise.recordings.locking import remove_unless_locked, try_lock

_SUFFIX = ".part"


def write_bytes_atomically(path: str | os.PathLike[str], content: bytes) -> None:
    """Replace the file at `path` by `content` atomically.

    The bytes are written to a temporary file and synced to disk; then the temporary file is renamed. It lies in the
    same folder, since a rename across file systems is not atomic. Temporary files that killed processes left behind
    are removed.

    Raises
    ------
    FileError
        If the folder does not exist or cannot be written to, or the disk is full.
    """
    path = Path(path)
    prefix = f".{path.name}."
    for left in path.parent.glob(f"{glob.escape(prefix)}*{_SUFFIX}"):
        remove_unless_locked(left)
    with defer_signals():
        try:
            handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=prefix, suffix=_SUFFIX)
        except OSError as error:
            raise FileError(
                path, f"cannot be written ({error.strerror})", "a file in an existing, writable folder"
            ) from error
        try:
            with os.fdopen(handle, "wb", buffering=0) as file:
                with contextlib.suppress(OSError):  # a file system without locks: others may remove the file
                    try_lock(handle)
                write_and_sync(file, path, content)
            # mkstemp makes the file private; give it the permissions of an ordinary new file.
            mask = os.umask(0)
            os.umask(mask)
            os.chmod(temporary, 0o666 & ~mask)
            os.replace(temporary, path)
        except OSError as error:
            raise FileError(path, f"cannot be written ({error.strerror})", "a file on a disk with room") from error
        finally:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(temporary)


def write_text_atomically(path: str | os.PathLike[str], text: str) -> None:
    """Replace the file at `path` by `text` in UTF-8 atomically, with line ends unchanged.

    Raises
    ------
    FileError
        If the folder does not exist or cannot be written to, or the disk is full.
    """
    write_bytes_atomically(path, text.encode("utf-8"))


def write_and_sync(file: FileIO, path: Path, content: bytes) -> None:
    """Write all of `content` to an open, unbuffered file and sync it to the disk; `path` is its name in messages.

    Raises
    ------
    FileError
        If it cannot be written or synced, as on a full disk.
    """
    left_over = memoryview(content)
    try:
        while left_over:
            left_over = left_over[file.write(left_over) :]
        os.fsync(file.fileno())
    except OSError as error:
        raise FileError(path, f"cannot be written ({error.strerror})", "a file on a disk with room") from error
