"""The last stage of a run: files, and how far it is."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from export.small_checkpoints import one_camera, write_run

from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.workflow.photos_to_splats import COMPRESSED, SPLATS, Plan, stages


def test_every_file_is_counted_as_it_is_written(tiny_scene, tmp_path):
    config = write_run(tmp_path / "run", one_camera(ScreenSpaceOverlay(48, 64)))
    training: Any = SimpleNamespace(get_base_dir=lambda: config.parent)
    plan = Plan(tmp_path, lambda _: {}, None, tiny_scene, training, {"detect": {}, "train": {}})
    (stage,) = [stage for stage in stages(plan) if stage.name == "export"]
    told = []
    result = stage.work(lambda *step: told.append(step))
    assert told == [("file", 1, 4), ("file", 4, 4)]
    assert result.text == "3 Gaussians"
    assert all((tmp_path / name).is_file() for name in (SPLATS, COMPRESSED, *result.files))
    assert len(result.files) == 2
