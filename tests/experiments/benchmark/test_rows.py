"""The table with a row for each capture and artifact, from results made up."""

from __future__ import annotations

import dataclasses

import pytest
from made_results import all_results, folder_of

from benchmarks.rows import Command
from ssa_nerfstudio.errors import InputError


def test_a_row_compares_the_default_with_the_better_reference(tmp_path, capsys):
    results = all_results()
    for k, r in enumerate(results):
        if (r.run.scene, r.run.effect, r.run.method, r.run.densification) == ("barn", "mud", "default", "adc"):
            results[k] = dataclasses.replace(r, metrics={**r.metrics, "psnr": 20.0})
    Command((folder_of(tmp_path, results),)).run()
    printed = capsys.readouterr().out
    missed, held = (
        next(line for line in printed.splitlines() if f"`{scene}` | mud" in line) for scene in ("barn", "attic")
    )
    assert [cell.strip() for cell in missed.split("|")][7] == "**-0.35**"
    assert [cell.strip() for cell in held.split("|")][7] == "+0.20"
    assert "at most 0.3 dB behind" in printed


def rows_of(printed: str) -> dict[tuple[str, str], list[str]]:
    """The cells of each row of the first table, by scene and effect."""
    _, first, *_ = printed.strip().split("\n\n")
    table = [[cell.strip() for cell in line.split("|")] for line in first.splitlines()]
    return {(scene, effect): values for _, scene, effect, *values, _ in table[2:]}


def test_methods_side_by_side(tmp_path, capsys):
    missing = {("barn", "mud", "paper"), ("attic", "mud", "default")}
    results = [r for r in all_results() if (r.run.scene, r.run.effect, r.run.method) not in missing]
    Command((folder_of(tmp_path, results),), ("paper", "default", "default/mcmc")).run()
    rows = rows_of(capsys.readouterr().out)
    assert rows["`barn`", "mud"][0] == ""
    assert rows["`attic`", "mud"][0] != ""
    assert rows["`attic`", "mud"][1:] == ["", ""]
    (label,) = (scene for scene, _ in rows if scene.startswith("mean of"))
    whole = [values for (scene, _), values in rows.items() if "" not in values and scene != label]
    assert label == f"mean of {len(whole)}"
    for k, value in enumerate(rows[label, ""]):
        assert float(value) == pytest.approx(sum(float(values[k]) for values in whole) / len(whole), abs=0.006)


def test_one_method_has_its_rows_and_their_mean(tmp_path, capsys):
    Command((folder_of(tmp_path, all_results()),), ("default",)).run()
    rows = rows_of(capsys.readouterr().out)
    ((label, _), (mean,)) = rows.popitem()
    assert rows
    assert label == f"mean of {len(rows)}"
    assert float(mean) == pytest.approx(sum(float(value) for (value,) in rows.values()) / len(rows), abs=0.006)


def test_costs_are_means_over_the_rows_that_all_methods_have(tmp_path, capsys):
    results = [r for r in all_results() if (r.run.scene, r.run.effect, r.run.method) != ("attic", "mud", "default")]
    for k, r in enumerate(results):
        if r.run.method == "default":
            slower = {**r.seconds, "training": 2 * r.seconds["training"]}  # of 1 s of statistics and 7 s of training
            sizes = {"dashboard": 700.0, "mud": 400.0, "none": 0.0}
            results[k] = dataclasses.replace(r, seconds=slower, peak_memory_mb=sizes[r.run.effect])
        elif (r.run.scene, r.run.effect) == ("attic", "mud"):
            results[k] = dataclasses.replace(r, peak_memory_mb=9e9, metrics={**r.metrics, "flip": 1.0})
    Command((folder_of(tmp_path, results),), ("paper", "default")).run()
    _, _, costs = capsys.readouterr().out.strip().split("\n\n")
    heads, _, *lines = costs.splitlines()
    assert heads == "| mean of 3 | FLIP | color deviation | peak MB | seconds, paper = 1 |"
    assert lines == ["| paper | 0.200 | 5.0 | 500 | 1.00 |", f"| default | 0.200 | 5.0 | 600 | {15 / 8:.2f} |"]


def test_a_method_without_results_is_refused(tmp_path):
    folder = folder_of(tmp_path, all_results())
    for name in ("defalt", "default/adcs"):
        with pytest.raises(InputError, match=rf"no results of '{name}'; choose among .*default, default/mcmc"):
            Command((folder,), ("3dgs", name)).run()


def test_a_folder_without_results_is_refused(tmp_path):
    (tmp_path / "results").mkdir()
    with pytest.raises(InputError, match="no results"):
        Command((tmp_path,)).run()
