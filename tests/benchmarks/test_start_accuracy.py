"""Errors of the start against the layers that were drawn."""

from __future__ import annotations

import json

import pytest

from benchmarks.start_accuracy import HELD_OUT, LAYERS, Command
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence import layer_estimate


@pytest.mark.slow
def test_each_constant_has_a_row_and_nothing_is_measured_twice(write_built_in_scene, tmp_path, capsys):
    clean = write_built_in_scene(tmp_path / "clean", None, views=12, test_views=3, width=64, height=48)
    main(["simulate", "--data", str(clean), "--output", str(tmp_path / "covered"), "--effects", "dashboard"])
    output = tmp_path / "errors.jsonl"
    former = {"data": "covered", "constant": "initialization.GONE", "factor": 0.5, "T_on": 0.1}  # without a verdict
    output.write_text(json.dumps(former) + "\n")
    before = layer_estimate.ROUNDS
    for _ in range(2):
        Command([tmp_path / "covered"], vary=True, held_out=True, output=output).run()
    assert before == layer_estimate.ROUNDS
    _, *rows = [json.loads(line) for line in output.read_text().splitlines()]
    assert len({(row["constant"], row["factor"]) for row in rows}) == len(rows)
    as_it_is, *others = rows
    assert as_it_is["constant"] == ""
    assert as_it_is["T_off"] < 0.1 < 0.4 > as_it_is["T_on"], "a dashboard over a third of the frame"
    assert any(row["T_on"] != as_it_is["T_on"] for row in others)
    assert all(("held_out" in row) == (row["constant"].split(".")[0] in HELD_OUT) for row in rows)
    predicted = {row["held_out"] for row in rows if row["constant"] == "layer_estimate.PRIOR_SCALE"}
    assert len(predicted - {as_it_is["held_out"]}) == 2
    assert as_it_is["seeds"] == 0, "a room of walls"
    assert as_it_is["gaps"] > 0, "between its points"
    assert all("gaps" in row for row in others if row["constant"].startswith(("distant_points.", "gap_points.")))
    printed = capsys.readouterr().out
    assert printed.count("| layer_estimate.PRIOR_SCALE |") == 2
    assert printed.count("verdicts changed | held out |") == 4
    for constant in ("distant_points.SPACING", "gap_points.NEIGHBORS", "scene_photos.MIN_SHOWN"):
        assert printed.count(f"| {constant} | ") == 2


def test_what_is_not_drawn_on_a_clean_capture_is_an_error(write_built_in_scene, tmp_path, capsys):
    clean = write_built_in_scene(tmp_path / "clean", None, views=12, test_views=3, width=64, height=48)
    output = tmp_path / "errors.jsonl"
    Command([clean], output=output).run()
    row = json.loads(output.read_text())
    assert row["T_on"] == row["B_on"] == 0
    assert row["verdict"] in capsys.readouterr().out


def test_in_the_mean_light_a_start_is_nearer_to_the_truth(write_built_in_scene, tmp_path):
    clean = write_built_in_scene(tmp_path / "clean", None, views=12, test_views=3, width=96, height=72)
    output = tmp_path / "errors.jsonl"
    main(["simulate", "--data", str(clean), "--output", str(tmp_path / "finger"), "--effects", "finger"])
    Command([tmp_path / "finger"], first=True, output=output).run()
    start, first = (json.loads(line) for line in output.read_text().splitlines())
    assert [start["constant"], first["constant"]] == ["", "first estimate"]
    assert first["light"] > 0.05
    assert 0 < first["left"] < 0.5
    assert "left" not in start
    assert start["noise"] < first["noise"]
    assert start["B_on"] < first["B_on"]


FOREIGN = '{"verdict": "none", "data": [1], "constant": "", "factor": 1}'


@pytest.mark.parametrize("text", ['{"data"', "3", "[1, 2]", '{"verdict": "none"}', '{"a": 1}', FOREIGN])
def test_a_file_of_something_else_is_refused(write_built_in_scene, tmp_path, text):
    clean = write_built_in_scene(tmp_path / "clean", None, views=12, test_views=3, width=64, height=48)
    (tmp_path / "a.jsonl").write_text(text)
    with pytest.raises(InputError, match=r"a\.jsonl holds no results of this script"):
        Command([clean], output=tmp_path / "a.jsonl").run()


def test_a_folder_that_is_no_dataset_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"transforms\.json does not exist"):
        Command([tmp_path]).run()


def test_what_would_be_taken_for_a_clean_capture_is_refused(write_built_in_scene, tmp_path):
    clean = write_built_in_scene(tmp_path / "clean", None, views=12, test_views=3, width=64, height=48)
    main(["simulate", "--data", str(clean), "--output", str(tmp_path / "covered"), "--effects", "dashboard"])
    with pytest.raises(InputError, match="is a file; name the dataset's folder"):
        Command([tmp_path / "covered" / "transforms.json"]).run()
    (tmp_path / "covered" / LAYERS).unlink()
    with pytest.raises(InputError, match=f"has no {LAYERS}, though"):
        Command([tmp_path / "covered"]).run()
    (clean / "sparse_pc.ply").unlink()
    with pytest.raises(InputError, match=r"sparse_pc\.ply cannot be read"):
        Command([clean]).run()
