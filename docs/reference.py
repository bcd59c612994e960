"""A hook of mkdocs: generates the reference of commands and configuration from their dataclasses."""

from __future__ import annotations

import dataclasses
import importlib
import re
from typing import Any

import docstring_parser

from ssa_nerfstudio.cli import COMMANDS

OWN = {
    "Model": ("ssa_nerfstudio.plugin.settings", "ModelSettings", "--pipeline.model."),
    "Photos": ("ssa_nerfstudio.plugin.datamanager", "SSADatamanagerConfig", "--pipeline.datamanager."),
    "Training": ("ssa_nerfstudio.plugin.trainer", "SSATrainerConfig", "--"),
}
"""Heading: module, dataclass and the prefix of its options."""


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Replace the markers of a page by the generated tables.

    Raises:
        RuntimeError: a field has no docstring.
    """
    if "<!-- commands -->" in markdown:
        markdown = markdown.replace("<!-- commands -->", "\n".join(map(_command, COMMANDS)))
    if "<!-- configuration -->" in markdown:
        markdown = markdown.replace("<!-- configuration -->", "\n".join(_configuration(name) for name in OWN))
    return markdown


def _command(name: str) -> str:
    command = importlib.import_module(f"ssa_nerfstudio.cli.{name.replace('-', '_')}").Command
    rows = [
        (field.name.upper() if _positional(field) else _option(_name(field)), field, text)
        for field, text in _fields(command)
        if "tyro.conf.Suppress" not in str(field.type)
    ]
    return f"## `ssa {name}`\n\n{COMMANDS[name]}\n\n{_table(rows)}"


def _configuration(heading: str) -> str:
    module, name, prefix = OWN[heading]
    config = getattr(importlib.import_module(module), name)
    rows = [(_option(field.name, prefix), field, text) for field, text in _fields(config)]
    return f"## {heading}\n\n{_table(rows)}"


def _name(field: dataclasses.Field) -> str:
    """The name of an argument, which an annotation may give it because it is a word of Python."""
    named = re.search(r'tyro\.conf\.arg\(name=[\'"](\w+)', str(field.type))
    return named[1] if named else field.name


def _option(name: str, prefix: str = "--") -> str:
    return prefix + name.replace("_", "-")


def _fields(cls: type) -> list[tuple[dataclasses.Field, str]]:
    """The fields that a class itself declares, and their docstrings."""
    texts = {p.arg_name: p.description for p in docstring_parser.parse_from_object(cls).params}
    declared = [f for f in dataclasses.fields(cls) if f.name in vars(cls)["__annotations__"] and f.name[0] != "_"]
    missing = [f.name for f in declared if not texts.get(f.name)]
    if missing:
        raise RuntimeError(f"{cls.__name__}: no docstring under {', '.join(missing)}")
    return [(field, texts[field.name] or "") for field in declared]


def _table(rows: list[tuple[str, dataclasses.Field, str]]) -> str:
    lines = ["| option | type | default | |", "|---|---|---|---|"]
    for option, field, text in rows:
        # Within backticks Markdown shows | and * as they are, and a backslash before them, too.
        prose = re.sub(r"(`[^`]*`)|([|*])", lambda found: found[1] or f"\\{found[2]}", text)
        cells = (f"`{option}`", f"`{_type(field)}`", _default(field), prose)
        lines.append("| " + " | ".join(re.sub(r"\s+", " ", cell) for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def _positional(field: dataclasses.Field) -> bool:
    """Whether an argument is positional."""
    return "tyro.conf.Positional" in str(field.type)


def _type(field: dataclasses.Field) -> str:
    text = field.type if isinstance(field.type, str) else getattr(field.type, "__name__", str(field.type))
    return text.removeprefix("Annotated[").partition(", tyro.")[0]


def _default(field: dataclasses.Field) -> str:
    if field.default is not dataclasses.MISSING:
        if field.name == "threads":
            return "the machine's cores"
        return f"`{field.default}`"
    return "required" if field.default_factory is dataclasses.MISSING else ""
