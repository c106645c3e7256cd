"""Strict JSON: no NaN, no Infinity, no number beyond the floats, no repeated names."""

from __future__ import annotations

import json
import math
import os
from typing import Any

from probewise.errors import FileError, shown

_MOST_DIGITS = 400  # more digits than any finite float has before the point


def parse_json_file_text(
    path: str | os.PathLike[str], text: str | bytes, allowed: str, *, row: int | None = None
) -> Any:
    """Parse a JSON text, or UTF-8 bytes, from a file.

    Parameters
    ----------
    path, row
        Its place, for messages; without `row`, the row of the error within the text.
    text
        The text.
    allowed
        What the file should contain, for messages.

    Raises
    ------
    FileError
        If it is not strict JSON; see `parse_strict_json`.
    """
    try:
        return parse_strict_json(text)
    except json.JSONDecodeError as error:
        found = f"does not parse as JSON: {error.msg} at character {error.colno}"
        raise FileError(path, found, allowed, row=error.lineno if row is None else row) from error
    except ValueError as error:
        raise FileError(path, f"does not parse as JSON: {error}", allowed, row=row) from error


def parse_strict_json(text: str | bytes) -> Any:
    """Parse a JSON text, or UTF-8 bytes; a byte-order mark is skipped.

    Raises
    ------
    json.JSONDecodeError
        If it does not parse.
    ValueError
        If it is nested too deep, bytes are not UTF-8, a lone surrogate is escaped, a number is NaN, infinite or
        beyond the floats, or an object repeats a name.
    """
    text = text.decode("utf-8-sig") if isinstance(text, bytes) else text.removeprefix("\ufeff")
    try:
        value = json.loads(
            text,
            object_pairs_hook=_dict_of_unique_names,
            parse_constant=_refuse_constant,
            parse_int=_parse_whole_number,
            parse_float=_parse_finite_number,
        )
        if "\\u" in text:  # an escaped lone surrogate could not be written to a file
            json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        raise ValueError("half of an escaped character, a surrogate, stands alone") from error
    except RecursionError as error:
        raise ValueError("lists or objects nested too deep") from error
    return value


def _dict_of_unique_names(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    out = dict(pairs)
    if len(out) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"the name {shown(next(n for n in names if names.count(n) > 1))} comes twice")
    return out


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")


def _parse_whole_number(digits: str) -> int:
    # Python refuses to convert texts of thousands of digits.
    if len(digits) > _MOST_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits, beyond every float")
    _parse_finite_number(digits)
    return int(digits)


def _parse_finite_number(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError(f"the number {shown(digits)} is beyond every float")
    return value
