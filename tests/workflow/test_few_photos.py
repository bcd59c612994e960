"""A run of so few photos that nerfstudio leaves none of them to test on."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from ssa_nerfstudio.cli import main
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.workflow.resumable_training import load_trained


@pytest.fixture
def nine_photos(broken_scene: Path) -> Path:
    path = broken_scene / "transforms.json"
    meta = json.loads(path.read_text())
    meta["frames"] = sorted(meta["frames"], key=lambda frame: frame["file_path"])[:9]
    path.write_text(json.dumps({key: value for key, value in meta.items() if not key.endswith("_filenames")}))
    return broken_scene


def test_it_ends_with_splats_and_a_page_that_says_that_nothing_was_measured(nine_photos, tmp_path):
    output = tmp_path / "out"
    main(
        [
            *("run", str(nine_photos), "--output", str(output), "--steps", "6", "--detect.draws", "300"),
            *("--train.steps-per-eval-image", "2", "--train.scale-schedules", "False"),
        ]
    )
    stages = json.loads((output / "run.json").read_text())
    assert stages["evaluate"]["done"]["text"].startswith("nothing to measure on: all 9 photos were trained on")
    assert (output / "splats.ply").is_file()
    page = (output / "report.html").read_text()
    assert "no photo was left to test on" in page
    assert page.count("data:image/jpeg;base64,") == 2
    assert "ns-eval" not in page
    (config,) = output.glob("training/*/config.yml")
    pipeline = load_trained(yaml.load(config.read_text(), Loader=yaml.Loader))
    with pytest.raises(InputError, match="none is left to test on"):
        pipeline.get_average_eval_image_metrics()
