"""Refuses a config.yml that calls what no run's configuration calls, before nerfstudio executes it.

nerfstudio reads config.yml with PyYAML's unsafe loader: tags name Python objects, and `python/object/apply` calls them.
Runs of any method use classes, and calls of few. What is refused here are functions, and the standard library but for
what holds values. A class of an installed package can still run code when it is made.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import yaml

from ssa_nerfstudio._system.text_files import MAX_SETTINGS_BYTES, read_text
from ssa_nerfstudio.errors import InputError

_PREFIX = "tag:yaml.org,2002:python/"
_CALLS = {"object/apply", "object/new"}
_VALUES = {"pathlib", "collections", "datetime", "enum"}
"""Modules of the standard library whose classes hold values."""
_TYPES = {"dict", "list", "tuple", "set", "frozenset", "int", "float", "str", "bool", "bytes", "complex"}
_CALLED = {"torch.device", "torch.Size", "_operator.getitem"}
"""What is called without being a class by its name; the last one makes members of enumerations."""


def refuse_calls(path: Path) -> None:
    """Refuse a config.yml that calls a function, or names what does more than hold values in the standard library.

    Args:
        path: of the file; one that cannot be read or parsed is left to whoever reads it.

    Raises:
        InputError: it does.
    """
    try:
        root = yaml.compose(read_text(path, MAX_SETTINGS_BYTES), Loader=yaml.SafeLoader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError):
        return
    for tag in _tags(root):
        kind, _, name = tag.removeprefix(_PREFIX).partition(":")
        if _runs_code(kind, name):
            verb = "calls" if kind in _CALLS else "names"
            raise InputError(
                f"{path} is no run's configuration: it {verb} {name}",
                "do not use it, it may come from someone who means harm",
            )


def _runs_code(kind: str, name: str) -> bool:
    package, last = name.partition(".")[0], name.rpartition(".")[2]
    if not name or package in _VALUES or name in _CALLED:
        return False
    if package == "builtins" or "." not in name:
        return last not in _TYPES
    if package in sys.stdlib_module_names:
        return True
    return kind in _CALLS and not last[:1].isupper()


def _tags(root: yaml.Node | None) -> Iterator[str]:
    """Python's tags in a document; an alias is looked at once."""
    waiting, seen = [root] if root is not None else [], set()
    while waiting:
        node = waiting.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        if node.tag.startswith(_PREFIX):
            yield node.tag
        if isinstance(node, yaml.MappingNode):
            waiting += [part for pair in node.value for part in pair]
        elif isinstance(node, yaml.SequenceNode):
            waiting += node.value
