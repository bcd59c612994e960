"""Results as files: whole or not at all, checked when read, added up from several folders."""

from __future__ import annotations

import dataclasses
import json
import math

import pytest
from made_results import all_results, folder_of

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.results import merge, read, read_all, write


@pytest.fixture
def one():
    return all_results()[0]


def test_what_is_written_is_what_is_read(one, tmp_path):
    write(one, tmp_path / f"{one.run.id}.json")
    assert read(tmp_path / f"{one.run.id}.json") == one
    assert [path.name for path in tmp_path.iterdir()] == [f"{one.run.id}.json"]


def test_an_infinite_psnr_is_valid_json(one, tmp_path):
    path = tmp_path / f"{one.run.id}.json"
    write(dataclasses.replace(one, metrics={**one.metrics, "psnr": math.inf}), path)
    assert json.loads(path.read_text())["metrics"]["psnr"] is None
    assert read(path).metrics["psnr"] is None


def test_a_model_setting_that_no_longer_exists_is_read_as_it_was_written(one, tmp_path):
    run = dataclasses.replace(one.run, model={**one.run.model, "ssim": "shifted-sums"})
    path = tmp_path / f"{run.id}.json"
    write(dataclasses.replace(one, run=run), path)
    assert read(path).run.model["ssim"] == "shifted-sums"


def _broken(values: dict, change: str) -> str:
    if change == "status":
        values["status"] = "good"
    elif change == "no seconds":
        values["seconds"] = {}
    elif change == "no psnr":
        del values["metrics"]["psnr"]
    elif change == "word for a number":
        values["views"]["view_0.png"]["psnr"] = "high"
    elif change == "no run":
        del values["run"]
    elif change == "half a run":
        del values["run"]["steps"]
    elif change == "other run":
        values["run"]["seed"] = 77
    elif change == "version":
        values["version"] = 99
    elif change == "foreign":
        values = {"psnr": 30.0}
    elif change == "list":
        return "[1, 2]"
    text = json.dumps(values)
    return text[: len(text) // 2] if change == "truncated" else "" if change == "empty" else text


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ("status", "status"),
        ("no seconds", "without startup"),
        ("no psnr", "without psnr"),
        ("word for a number", "psnr: .* valid number, got 'high'"),
        ("no run", "run"),
        ("half a run", "steps"),
        ("other run", "renamed, or edited"),
        ("version", "version 99"),
        ("foreign", "not a result"),
        ("list", "not a result"),
        ("truncated", "truncated"),
        ("empty", "truncated"),
    ],
)
def test_a_file_that_is_no_result_is_named_with_the_reason_and_the_others_are_read(one, tmp_path, change, why):
    folder_of(tmp_path, all_results()[:3])
    path = tmp_path / "results" / f"{one.run.id}.json"
    path.write_text(_broken(json.loads(path.read_text()), change))
    with pytest.raises(InputError, match=why):
        read(path)
    found, problems = read_all([tmp_path])
    assert len(found) == 2
    assert len(problems) == 1
    assert str(path) in problems[0]
    assert "\n" not in problems[0]


def test_of_several_folders_every_run_counts_once_and_a_failure_gives_way(one, tmp_path):
    failed = dataclasses.replace(one, status="failed", reason="CUDA out of memory")
    folder_of(tmp_path / "a", [failed, all_results()[1]])
    folder_of(tmp_path / "b", [one, all_results()[1]])
    found, problems = read_all([tmp_path / "a", tmp_path / "b"])
    assert problems == []
    assert sorted(r.status for r in found) == ["finished", "finished"]


def test_merging_takes_over_what_is_missing_with_pictures_and_logs(one, tmp_path):
    source, target = tmp_path / "source", tmp_path / "target"
    first, second = all_results()[:2]
    folder_of(source, [first, second])
    folder_of(target, [dataclasses.replace(first, gaussians=7)])
    (source / "pictures" / second.run.id).mkdir(parents=True)
    (source / "pictures" / second.run.id / "render.jpg").write_bytes(b"jpeg")
    (source / "logs").mkdir()
    (source / "logs" / f"{second.run.id}.log").write_text("log")
    assert merge(source, target) == 1
    assert merge(source, target) == 0
    assert {r.gaussians for r in read_all([target])[0]} == {7, 1000}
    assert (target / "pictures" / second.run.id / "render.jpg").read_bytes() == b"jpeg"
    assert (target / "logs" / f"{second.run.id}.log").read_text() == "log"
