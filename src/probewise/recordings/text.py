"""Reading of files as bytes and as text."""

from __future__ import annotations

import codecs
import warnings
from pathlib import Path

from probewise.errors import FileError, PipeWarning


def read_bytes(path: Path, what: str) -> bytes:
    """Read a whole file; `what`, for messages, is what it should be. A pipe gives a PipeWarning.

    Raises
    ------
    FileError
        If it is missing, cannot be read or is a device.
    """
    try:
        device = path.is_char_device() or path.is_block_device()  # /dev/zero never ends
        if path.is_fifo():
            warnings.warn(f"{path} is a pipe: reading it waits for its writer to end", PipeWarning, stacklevel=2)
        content = b"" if device else path.read_bytes()
    except FileNotFoundError as error:
        raise FileError(path, "there is no such file", what) from error
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be read ({error})", what) from error
    if device:
        raise FileError(path, "this is a device", what)
    return content


def read_text(path: Path, what: str) -> str:
    """Read a whole file of UTF-8, or of UTF-16 with its byte-order mark, without that mark; `what` as in `read_bytes`.

    Raises
    ------
    FileError
        If it is missing, cannot be read or is no such text.
    """
    content = read_bytes(path, what)
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        return content.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        row = content.count(b"\n", 0, error.start) + 1
        found = f"byte 0x{content[error.start]:02x} at offset {error.start} is not {'UTF-16' if wide else 'UTF-8'}"
        raise FileError(path, found, "UTF-8 text (save the file again with that encoding)", row=row) from error
