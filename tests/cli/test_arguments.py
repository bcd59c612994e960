"""Options that are wrong end in one line that names them, whatever the command."""

from __future__ import annotations

import dataclasses
import importlib
import sys
import typing
from pathlib import Path

import pytest
import tyro

from ssa_nerfstudio.cli import COMMANDS, arguments, main


def command_of(name: str) -> type:
    return importlib.import_module(f"ssa_nerfstudio.cli.{name.replace('-', '_')}").Command


def typed(name: str) -> dict[str, object]:
    """Flags and types of a command's options, None and Positional left out."""
    found = {}
    for field, hint in typing.get_type_hints(command_of(name)).items():
        members = [member for member in typing.get_args(hint) if member is not type(None)]
        optional = type(None) in typing.get_args(hint)
        found["--" + field.replace("_", "-")] = members[0] if optional else hint
    return found


def required(name: str) -> list[str]:
    """Values for all that a command requires, so that one more option is all that can be wrong."""
    words = []
    for field in dataclasses.fields(command_of(name)):
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            words += ["--" + field.name.replace("_", "-"), "somewhere"]
    return words


def said(words: list[str], capsys) -> str:
    """The one line of a refusal."""
    with pytest.raises(SystemExit) as caught:
        main(words)
    assert caught.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("ssa-nerfstudio: error: ")
    assert err.count("\n") == 1
    return err


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_an_unknown_option(name, capsys):
    line = said([name, *required(name), "--nonsense", "1"], capsys)
    assert "--nonsense" in line
    assert "--output" in line
    assert f"ssa {name} --help" in line


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_a_misspelt_option(name, capsys):
    flag = list(typed(name))[-1]
    assert f"did you mean {flag}?" in said([name, *required(name), flag[:-1], "1"], capsys)


@pytest.mark.parametrize("name", sorted(set(COMMANDS) - {"demo"}))
def test_what_is_required_and_missing(name, capsys):
    line = said([name], capsys)
    assert all(flag in line for flag in required(name)[::2])
    assert f"ssa {name} " in line


NOT_ANY = {int: "1.5", float: "much", bool: "True"}
"""For types that do not take every word, one that they do not take."""
REFUSED = [
    (name, flag, NOT_ANY.get(hint, "nonsense"))  # pyright: ignore[reportArgumentType]
    for name in sorted(COMMANDS)
    for flag, hint in typed(name).items()
    # What follows a switch of bench and tradeoff is their benchmark's name.
    if (hint in NOT_ANY and not (hint is bool and name in ("bench", "tradeoff")))
    or typing.get_origin(hint) is typing.Literal
    or typing.get_args(hint)[:1] == (float,)
]


@pytest.mark.parametrize(("name", "flag", "value"), REFUSED)
def test_a_value_that_an_option_does_not_take(name, flag, value, capsys):
    line = said([name, *required(name), flag, value], capsys)
    assert f"{flag} takes " in line
    assert f"got '{value}'" in line
    assert f"ssa {name} --help" in line


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["detect", "--data"], "--data takes a path, got nothing"),
        (["detect", "--data", "--json", "x"], "--data takes a path, got nothing"),
        (["detect", "--data=x", "--draws=many"], "--draws takes a whole number, got 'many'"),
        (["detect", "photos"], "'photos' belongs to no option; did you mean --data photos?"),
        (["detect", "--data", "my", "photos"], "'photos' belongs to no option"),
        (["bench", "smoke", "captures", "--output", "x"], "'captures' belongs to no option"),
        (["process", "--train", "x", "--output", "y", "--matching", "all"], "one of auto, exhaustive, sequential, got"),
        (["process", "--train", "x", "--output", "y", "--no-flatten", "1"], "--no-flatten takes no value, got '1'"),
        (["export-splats", "--load-config", "x", "--output-dir", "y", "--obb-scale", "1", "2"], "takes 3 numbers, got"),
    ],
)
def test_other_slips(words, expected, capsys):
    assert expected in said(words, capsys)


def test_whatever_tyro_refuses_is_one_line(capsys, monkeypatch):
    original = tyro.cli

    def cli(it, **options):
        if not dataclasses.is_dataclass(it):
            return original(it, **options)
        print("a box\nof lines", file=sys.stderr)
        raise SystemExit(2)

    monkeypatch.setattr(tyro, "cli", cli)
    assert "not understood: --steps 3 (ssa demo --help)" in said(["demo", "--steps", "3"], capsys)


def test_what_tyro_takes_is_taken():
    command = command_of("bench")
    taken = arguments.read(command, ["captures", "--output", "x", "--scenes", "a", "b", "--list"], "ssa bench", "")
    assert taken == command(Path("x"), "captures", ("a", "b"), list=True)
    taken = arguments.read(command, ["--output=x", "--time_limit", "2", "--no-list"], "ssa bench", "")
    assert taken == command(Path("x"), time_limit=2.0)
