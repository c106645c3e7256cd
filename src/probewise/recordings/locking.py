"""Locks on files against other processes; the system releases a lock when its process dies."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from probewise.errors import FileError

_BUSY = {errno.EACCES, errno.EAGAIN, errno.EDEADLK, errno.EWOULDBLOCK}
_BEHIND = 1 << 20  # Windows locks bytes against reading too: lock one far beyond the process id
_RETRY_S = 0.05


@contextlib.contextmanager
def hold_lock(path: str | os.PathLike[str], *, patience_s: float = 0.0) -> Iterator[None]:
    """Hold an exclusive lock on a file or folder, by way of a lock file .NAME.lock beside it.

    The lock belongs to the open file and so ends with the process, however that ends. A killed process
    leaves an unlocked lock file, which the next process takes over and removes.

    Parameters
    ----------
    path
        The file or folder; it need not exist, but its folder must.
    patience_s
        Wait at most this long for another process.

    Raises
    ------
    FileError
        If another process holds the lock (the message names it where known), or the file system has no locks.
    """
    path = Path(path)
    lock = path.with_name(f".{path.name}.lock")
    deadline_s = time.monotonic() + patience_s
    while (handle := _open_and_lock(lock, path)) is None:
        if time.monotonic() >= deadline_s:
            raise FileError(path, f"{_holder_in_words(lock)} is writing to it", "one process at a time")
        time.sleep(_RETRY_S)
    try:
        with contextlib.suppress(OSError):  # the process id is only used in messages
            os.ftruncate(handle, 0)
            os.write(handle, b"%d" % os.getpid())
        yield
    finally:
        _release(handle, lock)


def _open_and_lock(lock: Path, path: Path) -> int | None:
    """Open and lock the lock file, and return its file descriptor; None if another process holds the lock."""
    while True:
        try:
            handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise FileError(
                path, f"cannot be written ({error.strerror})", "a file in an existing, writable folder"
            ) from error
        try:
            if not try_lock(handle):
                os.close(handle)
                return None
            # The previous holder may have removed the file after it was opened here.
            if os.path.samestat(os.fstat(handle), os.stat(lock)):
                return handle
        except FileNotFoundError:
            pass
        except OSError as error:
            os.close(handle)
            raise FileError(path, f"cannot be locked ({error.strerror})", "a file system that has locks") from error
        os.close(handle)


def try_lock(handle: int) -> bool:
    """Lock an open file until it is closed; return False, without a lock, if another process holds one."""
    try:
        _lock(handle)
    except OSError as error:
        if error.errno in _BUSY:
            return False
        raise
    return True


def remove_unless_locked(path: Path) -> None:
    """Remove a file unless a living process holds its lock."""
    with contextlib.suppress(OSError):
        if sys.platform == "win32":
            path.unlink()  # refused while another process has it open
            return
        handle = os.open(path, os.O_RDWR)
        try:
            if try_lock(handle):
                path.unlink()
        finally:
            os.close(handle)


if sys.platform == "win32":
    import msvcrt

    def _lock(handle: int) -> None:
        os.lseek(handle, _BEHIND, os.SEEK_SET)
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        os.lseek(handle, 0, os.SEEK_SET)

    def _release(handle: int, lock: Path) -> None:
        os.close(handle)  # Windows cannot remove an open file; one opened by another process stays
        with contextlib.suppress(OSError):
            os.unlink(lock)

else:
    import fcntl

    def _lock(handle: int) -> None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def _release(handle: int, lock: Path) -> None:
        with contextlib.suppress(OSError):
            os.unlink(lock)
        os.close(handle)


def _holder_in_words(lock: Path) -> str:
    try:
        return f"process {int(lock.read_text(encoding='ascii'))}"
    except (OSError, ValueError):
        return "another process"
