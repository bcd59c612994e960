"""Options that are wrong end in one line that names them, whatever the command."""

from __future__ import annotations

import dataclasses
import importlib
import re
import sys
import typing
from pathlib import Path

import pytest
import tyro

from ssa_nerfstudio.cli import COMMANDS, arguments, main
from ssa_nerfstudio.experiments.configuration import shipped


def command_of(name: str) -> type:
    return importlib.import_module(f"ssa_nerfstudio.cli.{name.replace('-', '_')}").Command


def flag_of(field: dataclasses.Field) -> str:
    """How an option is called: as its field, unless that says another name."""
    named = re.search(r'arg\(name=[\'"](\w+)', str(field.type))
    return "--" + (named[1] if named else field.name.replace("_", "-"))


def typed(name: str) -> dict[str, object]:
    """Flags and types of a command's options, None, Positional and what no one types left out."""
    found = {}
    annotated = typing.get_type_hints(command_of(name), include_extras=True)
    hints = typing.get_type_hints(command_of(name))
    fields = {field.name: field for field in dataclasses.fields(command_of(name))}
    for field in [field for field in hints if "Suppress" not in str(annotated[field])]:
        hint = hints[field]
        members = [member for member in typing.get_args(hint) if member is not type(None)]
        optional = type(None) in typing.get_args(hint)
        found[flag_of(fields[field])] = members[0] if optional else hint
    return found


def required(name: str) -> list[str]:
    """Values for all that a command requires, so that one more option is all that can be wrong."""
    words = []
    for field in dataclasses.fields(command_of(name)):
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            positional = "tyro.conf.Positional" in str(field.type)
            choices = re.search(r'Literal\[[\'"](\w+)', str(field.type))
            words += [] if positional else [flag_of(field)]
            words.append(choices[1] if choices else "somewhere")
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
    assert "error: Unrecognized options: --nonsense, 1" in line
    assert f"(ssa {name} --help)" in line


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_a_misspelt_option(name, capsys):
    flag = list(typed(name))[-1]
    line = said([name, *required(name), flag[:-1], "1"], capsys)
    assert f"Unrecognized options: {flag[:-1]}, 1; Perhaps you meant: {flag}" in line


@pytest.mark.parametrize("name", sorted(set(COMMANDS) - {"demo", "report", "run"}))
def test_required_options_that_are_missing(name, capsys):
    line = said([name], capsys)
    assert f"Missing from ssa {name}: {required(name)[0]} PATH" in line
    assert all(flag in line for flag in required(name)[::2])


def test_photos_and_output_of_a_run_are_required(capsys):
    line = said(["run"], capsys)
    assert "PHOTOS" in line
    assert "--output" in line


def test_the_folders_of_a_report_are_required(capsys):
    assert "ssa report DIR" in said(["report"], capsys)


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
def test_a_value_of_the_wrong_type(name, flag, value, capsys):
    line = said([name, *required(name), flag, value], capsys)
    assert flag.removeprefix("--no-") in line or "Unrecognized options" in line
    assert f"'{value}'" in line or f"Unrecognized options: {value}" in line
    assert f"ssa {name} --help" in line


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["detect", "--data"], "--data"),
        (["detect", "--data", "--json", "x"], "--data"),
        (
            ["detect", "--data=x", "--draws=many"],
            "error: Error parsing --draws: expected a whole number, got 'many' (ssa detect --help)",
        ),
        (
            ["simulate", "--output", "x", "--seed", "1.5"],
            "error: Error parsing --seed: expected a whole number, got '1.5' (ssa simulate --help)",
        ),
        (
            ["simulate", "--output", "x", "--exposure", "much"],
            "error: Error parsing --exposure: expected a number, got 'much' (ssa simulate --help)",
        ),
        (
            ["detect", "photos"],
            "Missing from ssa detect: --data PATH; Unrecognized options: photos (ssa detect --help)",
        ),
        (["detect", "--data", "my", "photos"], "Unrecognized options: photos (ssa detect --help)"),
        (["bench", "smoke", "captures", "--output", "x"], "Unrecognized options: captures"),
        (
            ["process", "--train", "x", "--output", "y", "--matching", "all"],
            "invalid choice 'all' for argument '--matching'. Expected one of ('auto', 'exhaustive', 'sequential').",
        ),
        (["process", "--train", "x", "--output", "y", "--no-flatten", "1"], "Unrecognized options: 1"),
        (
            ["export-splats", "--load-config", "x", "--output-dir", "y", "--obb-scale", "1", "2"],
            "error: Error parsing --obb-scale: expected 3 numbers, got '1 2' (ssa export-splats --help)",
        ),
        (
            ["export-splats", "--load-config", "x", "--output-dir", "y", "--obb-center", "1", "2", "up"],
            "error: Error parsing --obb-center: expected 3 numbers, got '1 2 up' (ssa export-splats --help)",
        ),
    ],
)
def test_other_slips(words, expected, capsys):
    assert expected in said(words, capsys)


def test_a_report_without_a_box_is_kept(capsys, monkeypatch):
    def cli(*_, **__):
        print("lines\nof a report", file=sys.stderr)
        raise SystemExit(2)

    monkeypatch.setattr(tyro, "cli", cli)
    assert "error: lines of a report (ssa demo --help)" in said(["demo", "--steps", "3"], capsys)


def test_valid_options_are_taken():
    command = command_of("bench")
    taken = arguments.read(command, ["captures", "--output", "x", "--scenes", "a", "b", "--list"], "ssa bench", "")
    assert taken == command(Path("x"), "captures", ("a", "b"), list=True)
    taken = arguments.read(command, ["--output=x", "--time_limit", "2", "--no-list"], "ssa bench", "")
    assert taken == command(Path("x"), time_limit=2.0)
    taken = arguments.read(command, ["--output=x", "--time-limit", "None", "--threads", "2"], "ssa bench", "")
    assert taken == command(Path("x"), threads=2)


@pytest.mark.parametrize("name", ["bench", "tradeoff"])
def test_help_names_every_benchmark_that_is_shipped(name, capsys):
    with pytest.raises(SystemExit):
        main([name, "--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    listed = shown.partition("BENCHMARK ")[2].partition(", or a .yaml file")[0]
    assert sorted(re.findall(r"[\w-]+", listed.rpartition("BENCHMARK ")[2] or listed)) == sorted(shipped("benchmarks"))
