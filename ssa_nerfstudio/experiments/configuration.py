"""Configuration files: YAML in, validated dataclass out; every error is one line that names the file and the key."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import json
import math
import re
import reprlib
from collections.abc import Hashable, Iterable
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_type_hints

import yaml
from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from ssa_nerfstudio._system.text_files import MAX_SETTINGS_BYTES, read_text
from ssa_nerfstudio.errors import InputError

Kind = Literal["effects", "scenes", "benchmarks", "published"]
"""The shipped folders of configurations."""
T = TypeVar("T")
_MAX_VALUES = 100_000
"""Of a file: every benchmark has a few hundred."""


def shipped(kind: Kind) -> dict[str, Path]:
    """The configurations of one kind that come with the package, by name."""
    here = Path(__file__).parents[1]
    # An installed package holds them; in a checkout they lie beside the package.
    folder = here / "configs" if (here / "configs").is_dir() else here.parent / "configs"
    return {path.stem: path for path in sorted((folder / kind).glob("*.yaml"))}


def locate(kind: Kind, name: str, stated_in: str = "") -> Path:
    """The file of a configuration.

    Args:
        kind: folder to look in.
        name: that of a shipped configuration, or the path of a .yaml file.
        stated_in: file and key that name it, for messages.

    Raises:
        InputError: there is none.
    """
    where = f"{stated_in}: " if stated_in else ""
    if Path(name).suffix in (".yaml", ".yml"):
        if not Path(name).is_file():
            known = ", ".join(shipped(kind))
            raise InputError(f"{where}{name} does not exist", f"give the path of a .yaml file or a name ({known})")
        return Path(name)
    if name not in shipped(kind):
        raise InputError(
            f"{where}{kind} has no {name!r}{_suggestion(name, shipped(kind))}",
            f"choose one of {', '.join(shipped(kind))}, or give the path of a .yaml file",
        )
    return shipped(kind)[name]


def read(path: Path) -> dict[str, Any]:
    """Read the keys and values of a YAML file.

    Raises:
        InputError: the file cannot be read, is no YAML, is no mapping, or has a key twice.
    """
    try:
        values = yaml.load(read_text(path, MAX_SETTINGS_BYTES), Loader=_Loader)
    except (OSError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path} cannot be read ({error})", "give a YAML file") from error
    except yaml.YAMLError as error:
        raise InputError(f"{path} is no valid YAML ({error})", "correct that line") from error
    if not isinstance(values, dict):
        raise InputError(f"{path} holds no keys and values", "write one 'key: value' a line")
    return values


def build(cls: type[T], values: object, where: str) -> T:
    """Build a dataclass from keys and values; types are checked strictly, and `__post_init__` may check more.

    Args:
        cls: dataclass whose `__post_init__` raises ValueError for values out of range.
        values: a mapping, as `read` gives it.
        where: file, and the key in it, for messages.

    Raises:
        InputError: a key is unknown or missing, or a value is of the wrong type or out of range.
    """
    try:
        # pydantic's strict mode takes lists for tuples, text for paths and mappings for dataclasses from JSON alone.
        text = json.dumps(values, default=str)
        return _validator(cls).validate_json(text, strict=True, extra="forbid")
    except ValidationError as invalid:
        # A misspelt key is often reported as a missing one, too; the former says more.
        errors = sorted(invalid.errors(), key=lambda error: error["type"] != "unexpected_keyword_argument")
        raise InputError(f"{where}: {_description(cls, errors[0])}") from invalid
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{where}: the values cannot be represented ({error})", "use plain keys and values") from error


class _Loader(yaml.SafeLoader):
    """PyYAML, stricter: a key is text and appears once; 1e-3 is a number, as in YAML 1.2; aliases stand for little."""

    def get_single_node(self) -> yaml.Node | None:
        node = super().get_single_node()
        if node is not None and _count(node, {}) > _MAX_VALUES:
            problem = f"with its aliases it holds more than {_MAX_VALUES} values"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for number, key in enumerate(keys):
            problem = "twice" if key in keys[:number] else "must be text, in quotes" if not isinstance(key, str) else ""
            if problem:
                raise yaml.constructor.ConstructorError(None, None, f"key {key!r} {problem}", node.start_mark)
        return super().construct_mapping(node, deep)


def _count(node: yaml.Node, known: dict[yaml.Node, float]) -> float:
    """Values that a node stands for, each alias counted as what it names; infinite where one names itself."""
    if node not in known:
        known[node] = math.inf
        parts = [part for pair in node.value for part in pair] if isinstance(node, yaml.MappingNode) else node.value
        known[node] = 1 + sum(_count(part, known) for part in parts if isinstance(part, yaml.Node))
    return known[node]


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


@functools.cache
def _validator(cls: type[T]) -> TypeAdapter[T]:
    return TypeAdapter(cls)


def _description(cls: type, error: ErrorDetails) -> str:
    """The key and what is wrong with it."""
    *parents, key = error["loc"] or ("",)
    if error["type"] == "unexpected_keyword_argument":
        known = [field.name for field in dataclasses.fields(_class_at(cls, parents))]
        place = f" in {_path(parents)}" if parents else ""
        return f"unknown key {key!r}{place}{_suggestion(key, known)}; known are {', '.join(known) or 'none'}"
    if error["type"] == "missing":
        return f"{_path(error['loc'])} is missing"
    place = f"{_path(error['loc'])}: " if error["loc"] else ""
    if error["type"] == "value_error":
        return f"{place}{error['ctx']['error']}"  # pyright: ignore[reportTypedDictNotRequiredAccess]
    return f"{place}{error['msg']}, got {reprlib.repr(error['input'])}"


def _class_at(cls: Any, location: Iterable[int | str]) -> Any:
    """The dataclass at a location inside another."""
    for key in location:
        if isinstance(key, str):
            hint = get_type_hints(cls)[key]
            cls = next(choice for choice in (hint, *get_args(hint)) if dataclasses.is_dataclass(choice))
    return cls


def _path(location: Iterable[int | str]) -> str:
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in location).removeprefix(".")


def _suggestion(name: object, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(str(name), list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
