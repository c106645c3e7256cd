"""Locks on files against other processes; the system releases a lock when its process dies."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from probewise.errors import FileError

_NO_LOCKS = "flock not supported"  # newer versions of the library warn so, and make a file that a killed process leaves


@contextlib.contextmanager
def hold_lock(path: str | os.PathLike[str], *, patience_s: float = 0.0) -> Iterator[None]:
    """Hold an exclusive lock on a file or folder, by way of an empty lock file .NAME.lock beside it, which stays.

    `path` need not exist, but its folder must. Raises FileError if another process holds the lock for longer than
    `patience_s`, the lock file is a symbolic link or cannot be written, or the file system has no locks.
    """
    path = Path(path)
    file = path.with_name(f".{path.name}.lock")
    if not path.parent.is_dir():  # the library would make it
        raise FileError(path, "cannot be written (no such folder)", "a file in an existing, writable folder")
    lock = FileLock(file, timeout=patience_s, thread_local=False)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", _NO_LOCKS)
            lock.acquire()
    except (Timeout, RuntimeError) as error:  # the latter: within this process
        if isinstance(error, NotImplementedError):
            raise _error_of_lock(file, "this file system has no locks") from error
        raise FileError(path, "another process is writing to it", "one process at a time") from error
    except (OSError, UserWarning) as error:
        found = "is a symbolic link" if file.is_symlink() else getattr(error, "strerror", None) or error
        raise _error_of_lock(file, found) from error
    try:
        yield
    finally:
        lock.release()


def _error_of_lock(file: Path, found: object) -> FileError:
    return FileError(file, f"cannot be locked ({found})", "none, or an ordinary file, where files can be locked")
