"""JSON as the formats mean it: no NaN, no Infinity, each name once."""

from __future__ import annotations

import json
from typing import Any

__all__ = ["strict_json"]


def strict_json(text: str) -> Any:
    """Parse a JSON text.

    Raises
    ------
    json.JSONDecodeError
        If it does not parse.
    ValueError
        If a number stands for none (NaN, Infinity), or a name comes twice in one object: which of the two is
        meant nobody can say.
    RecursionError
        If it is nested deeper than Python can follow.
    """
    return json.loads(text, object_pairs_hook=_once, parse_constant=_no_constant)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, value in pairs:
        if name in out:
            raise ValueError(f"the name {name!r} comes twice")
        out[name] = value
    return out


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")
