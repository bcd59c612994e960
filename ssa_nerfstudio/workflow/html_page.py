"""Pages from jinja2 templates; one of HTML embeds its pictures and needs no other file."""

from __future__ import annotations

import base64
import functools
import re
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, select_autoescape
from markupsafe import Markup, escape

_MEDIA_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".svg": "image/svg+xml"}


def render_page(template: Path, title: str, **values: Any) -> str:
    """Render a page.

    Args:
        template: the file; one of HTML extends base.html, which is beside this module.
        title: of the page.
        values: what the template shows; HTML escapes text.

    Returns:
        The page as text.
    """
    return _environment(template.parent).get_template(template.name).render(title=title, **values)


@functools.cache
def _environment(folder: Path) -> Environment:
    loader = FileSystemLoader([folder, Path(__file__).parent / "templates"])
    environment = Environment(loader=loader, autoescape=select_autoescape(), trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"inline": _inline, "embedded": _embedded}
    return environment


def _inline(text: str) -> Markup:
    """Text in which **bold** and `code` are marked as in Markdown."""
    marked = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", str(escape(text)))
    return Markup(re.sub(r"`(.+?)`", r"<code>\1</code>", marked))


def _embedded(picture: Path) -> str:
    """A picture's file as a data URI."""
    return f"data:{_MEDIA_TYPES[picture.suffix]};base64,{base64.b64encode(picture.read_bytes()).decode()}"
