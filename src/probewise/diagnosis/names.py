"""Type of a combination of effects: their names."""

from __future__ import annotations

from typing import TypeAlias

__all__ = ["Names"]

Names: TypeAlias = tuple[str, ...]
