"""Names in a sentence."""

from __future__ import annotations

from collections.abc import Sequence

_SHOWN = 5


def name_list(names: Sequence[str]) -> str:
    """The first five names, and dots where there are more."""
    return ", ".join([*names[:_SHOWN], *["..."][: len(names) > _SHOWN]])
