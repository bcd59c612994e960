"""YAML in, validated dataclass out; whatever is wrong ends in one line that names the file and the key."""

from __future__ import annotations

import dataclasses
import difflib
import types
from collections.abc import Hashable
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from ssa_nerfstudio.errors import InputError

Kind = Literal["effects", "scenes", "benchmarks"]
"""The shipped folders of configurations."""
T = TypeVar("T")


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
    """The keys and values of a YAML file.

    Raises:
        InputError: the file cannot be read, is no YAML, is no mapping, or has a key twice.
    """
    try:
        values = yaml.load(path.read_text(encoding="utf-8"), Loader=_UniqueKeyLoader)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read ({error})", "give a YAML file") from error
    except yaml.YAMLError as error:
        raise InputError(f"{path} is no valid YAML ({error})", "mend that line") from error
    if not isinstance(values, dict):
        raise InputError(f"{path} holds no keys and values", "write one 'key: value' a line")
    return values


def build(cls: type[T], values: object, where: str) -> T:
    """A dataclass from keys and values; nested dataclasses, tuples, lists, unions and literals are followed.

    Args:
        cls: dataclass whose `__post_init__` raises ValueError for values out of range.
        values: a mapping, as `read` gives it.
        where: file, and the key in it, for messages.

    Raises:
        InputError: a key is unknown or missing, or a value is of the wrong type or out of range.
    """
    try:
        return _build(cls, values)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from error


class _UniqueKeyLoader(yaml.SafeLoader):
    """PyYAML keeps the last of two equal keys without a word; here that is an error."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for number, key in enumerate(keys):
            if key in keys[:number]:
                raise yaml.constructor.ConstructorError(None, None, f"key {key!r} twice", node.start_mark)
        return super().construct_mapping(node, deep)


def _build(cls: Any, values: object) -> Any:
    known = {field.name: field for field in dataclasses.fields(cls) if field.init}
    if not isinstance(values, dict):
        raise ValueError(f"{cls.__name__} must be keys and values, got {values!r}")
    for key in values:
        if key not in known:
            raise ValueError(
                f"unknown key {key!r}{_suggestion(key, known)}; {cls.__name__} has {', '.join(known) or 'no keys'}"
            )
    for name, field in known.items():
        needed = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if needed and name not in values:
            raise ValueError(f"{cls.__name__} needs the key {name!r}")
    hints = get_type_hints(cls)
    return cls(**{key: _converted(hints[key], value, f"{cls.__name__}.{key}") for key, value in values.items()})


def _converted(hint: Any, value: Any, name: str) -> Any:
    """The value as its annotation wants it: ints become floats and lists become tuples, nothing else changes."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if origin in (Union, types.UnionType):
        nested = [choice for choice in arguments if dataclasses.is_dataclass(choice)]
        if len(nested) == 1 and isinstance(value, dict):
            return _build(nested[0], value)  # so that the message names the key inside
        for choice in arguments:
            try:
                return _converted(choice, value, name)
            except ValueError:
                continue
    elif origin is Literal:
        if value in arguments:
            return value
        raise ValueError(f"{name} must be one of {', '.join(map(str, arguments))}, got {value!r}")
    elif origin in (tuple, list):
        if isinstance(value, (list, tuple)):
            repeated = origin is list or arguments[-1] is Ellipsis
            kinds = [arguments[0]] * len(value) if repeated else list(arguments)
            if len(kinds) == len(value):
                return origin(_converted(kind, item, name) for kind, item in zip(kinds, value, strict=True))
    elif origin is dict or hint is dict:
        if isinstance(value, dict):
            return value
    elif dataclasses.is_dataclass(hint):
        return _build(hint, value)
    elif hint is float:
        # YAML 1.1 reads 1e-3 as a string.
        if not isinstance(value, bool) and isinstance(value, (int, float, str)):
            try:
                return float(value)
            except ValueError:
                pass
    elif hint is Path:
        if isinstance(value, str):
            return Path(value)
    elif hint is types.NoneType:
        if value is None:
            return None
    elif isinstance(value, hint) and (hint is bool or not isinstance(value, bool)):
        return value
    raise ValueError(f"{name} must be {_described(hint)}, got {value!r}")


def _described(hint: Any) -> str:
    plain = {float: "a number", int: "a whole number", str: "a text", bool: "true or false", Path: "a path"}
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return " or ".join(map(_described, arguments))
    if origin is tuple and arguments[-1] is not Ellipsis:
        return f"a list of {len(arguments)} values"
    if origin in (tuple, list):
        return "a list"
    if hint is types.NoneType:
        return "nothing"
    return plain.get(hint, "keys and values")


def _suggestion(name: object, known: Any) -> str:
    close = difflib.get_close_matches(str(name), list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
