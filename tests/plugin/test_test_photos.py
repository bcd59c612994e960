"""What evaluation says of test photos that carry the artifact, too."""

from __future__ import annotations

import json

import pytest


@pytest.mark.parametrize("clean", [True, False], ids=["stated as clean", "held back"])
def test_a_clean_render_is_not_judged_by_photos_with_the_artifact(
    broken_scene, tmp_path, configure_training, train_and_evaluate, caplog, clean
):
    path = broken_scene / "transforms.json"
    meta = json.loads(path.read_text())
    if not clean:
        path.write_text(json.dumps({key: value for key, value in meta.items() if not key.endswith("_filenames")}))
    config = configure_training("ssa-splatfacto", broken_scene, tmp_path / "runs", 4, {"overlay": "on"})
    _, pipeline, _ = train_and_evaluate(config)
    caplog.clear()
    metrics = pipeline.get_average_eval_image_metrics()
    assert {"psnr", "composite_psnr"} <= metrics.keys()
    said = [record.getMessage() for record in caplog.records]
    assert any("the test photos carry the artifact" in line for line in said) != clean
