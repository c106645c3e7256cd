"""Digest of a value's types and numbers, reproducible across processes."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any

import numpy as np

from probewise.errors import ParameterError


def value_digest(value: object) -> str:
    """Digest a value built of dataclasses, arrays, mappings, sequences, numbers and texts (sha256, hex).

    Two values have the same digest when their types, their fields and every bit of their numbers are the same, in
    whatever process; a list counts as a tuple.

    Raises
    ------
    ParameterError
        If the value holds anything else, such as a function, which has no reproducible digest.
    """
    digest = hashlib.sha256()
    _add_to_digest(digest, value)
    return digest.hexdigest()


def _add_to_digest(digest: Any, value: object) -> None:
    """Add types, names of fields and bits of a value to a digest."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        digest.update(f"<{type(value).__qualname__}>".encode())
        for item in dataclasses.fields(value):
            digest.update(item.name.encode())
            _add_to_digest(digest, getattr(value, item.name))
    elif isinstance(value, np.ndarray):
        digest.update(f"[{value.dtype.str}{value.shape}]".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, Enum):
        digest.update(f"<{value}>".encode())
    elif value is None or isinstance(value, (bool, int, float, str, np.generic)):
        plain = value.item() if isinstance(value, np.generic) else value
        digest.update(f"{type(plain).__name__}:{plain!r};".encode())
    elif isinstance(value, Mapping):
        digest.update(f"{{{len(value)}".encode())
        for key in sorted(value, key=str):
            _add_to_digest(digest, key)
            _add_to_digest(digest, value[key])
    elif isinstance(value, Sequence):
        digest.update(f"({len(value)}".encode())
        for item in value:
            _add_to_digest(digest, item)
    else:
        raise ParameterError(
            "fingerprint of", value, "frozen dataclasses of arrays, numbers and texts, so that a journal can name them"
        )
