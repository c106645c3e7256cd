"""Type of a combination of effects: their names."""

from __future__ import annotations

from typing import TypeAlias

Names: TypeAlias = tuple[str, ...]
