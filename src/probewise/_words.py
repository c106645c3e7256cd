"""Words that sentences of every package share."""

from __future__ import annotations


def count_with_noun(n: int, noun: str) -> str:
    """Write a count with its noun, plus "s" unless the count is 1."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
