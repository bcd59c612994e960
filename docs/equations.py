"""A hook of mkdocs: equations become MathML, which browsers draw without scripts or fonts.

Pages use GitHub's notation: a block fenced as `math`, and inline a dollar sign around backticks.
"""

from __future__ import annotations

import re
from typing import Any

from latex2mathml.converter import convert

_BLOCK = re.compile(r"^```math\n(.*?)\n```$", re.MULTILINE | re.DOTALL)
_INLINE = re.compile(r"\$`([^`\n]+)`\$")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace every equation by MathML."""
    return _INLINE.sub(_inline, _BLOCK.sub(_block, markdown))


def _block(found: re.Match[str]) -> str:
    return f'\n<div style="overflow-x: auto; margin: 1em 0">{convert(found[1], display="block")}</div>\n'


def _inline(found: re.Match[str]) -> str:
    # In a span: Markdown takes a line that begins with <math> for a block.
    return f"<span>{convert(found[1])}</span>"
