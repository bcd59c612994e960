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
    assert not [name for name in metrics if name.endswith("_std")], "deviations come where they are asked for"
    said = [record.getMessage() for record in caplog.records]
    assert any("the test photos carry the artifact" in line for line in said) != clean


@pytest.mark.parametrize(("mode", "split"), [("val", "val"), ("test", "test"), ("inference", "test")])
def test_photos_for_validation_and_for_the_test_are_told_apart(broken_scene, tmp_path, configure_training, mode, split):
    path = broken_scene / "transforms.json"
    meta = json.loads(path.read_text())
    meta["val_filenames"], meta["test_filenames"] = meta["test_filenames"][:1], meta["test_filenames"][1:]
    path.write_text(json.dumps(meta))
    model = {"overlay": "on", "overlay_start": "constant"}
    config = configure_training("ssa-splatfacto", broken_scene, tmp_path / "runs", 1, model)
    manager = config.pipeline.setup(device="cpu", test_mode=mode).datamanager
    assert manager.photo_names(manager.eval_dataset) == meta[f"{split}_filenames"]
