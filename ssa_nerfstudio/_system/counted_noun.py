"""A number and what it counts in a sentence."""

from __future__ import annotations


def counted(count: int, noun: str) -> str:
    """The number and the noun that it takes, of those whose plural ends in s: "1 photo", "2 photos", "2,000 steps"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"
