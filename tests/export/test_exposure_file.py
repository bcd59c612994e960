"""exposure.json, from checkpoints with and without exposures."""

from __future__ import annotations

import json

import pytest
import torch
from small_checkpoints import one_camera, write_run

from ssa_nerfstudio.cli import main
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.plugin.exposure import Exposure

PHOTOS = ["images/a.png", "images/b.png"]


def with_exposure(config, **changes):
    """Adds exposures to the run's checkpoint."""
    exposure = Exposure(2)
    exposure.photos, exposure.place = PHOTOS, "scene"
    with torch.no_grad():
        exposure.transforms.copy_(
            torch.tensor([[[0.2, 0.0, 0.1], [0.01, 0.0, 0.0]]]).mul(torch.tensor([[[1.0]], [[-1.0]]]))
        )
    path = config.parent / "nerfstudio_models" / "step-000000009.ckpt"
    saved = torch.load(path, weights_only=False)
    saved["pipeline"] |= {f"_model.exposure.{name}": value for name, value in exposure.state_dict().items()} | changes
    torch.save(saved, path)
    return config


@pytest.mark.parametrize("command", ["export-splats", "export-overlay"])
def test_exposures_are_written_beside_splats_and_artifact(command, tmp_path):
    config = with_exposure(write_run(tmp_path / "run", one_camera(ScreenSpaceOverlay(24, 32))))
    option = "--output-dir" if command == "export-splats" else "--output"
    main([command, "--load-config", str(config), option, str(tmp_path / "out")])
    written = json.loads((tmp_path / "out" / "exposure.json").read_text())
    assert written["place"] == "scene"
    assert list(written["photos"]) == PHOTOS
    first, second = (torch.tensor(written["photos"][name]["gain"]) for name in PHOTOS)
    torch.testing.assert_close(first, torch.tensor([0.2, 0.0, 0.1]).exp())
    torch.testing.assert_close(first * second, torch.ones(3))  # the mean is the identity
    assert written["photos"][PHOTOS[0]]["offset"] == pytest.approx([0.01, 0, 0])


def test_a_run_without_exposures_writes_none(tmp_path):
    main(
        [
            "export-splats",
            "--load-config",
            str(write_run(tmp_path / "run", None)),
            "--output-dir",
            str(tmp_path / "out"),
        ]
    )
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["splat.ply"]


@pytest.mark.parametrize(
    "changes",
    [
        {"_model.exposure.transforms": torch.full((2, 2, 3), torch.nan)},
        {"_model.exposure.transforms": torch.zeros(3, 2, 3)},
        {"_model.exposure.transforms": torch.zeros(2, 3)},
        {"_model.exposure._extra_state": {"photos": PHOTOS, "place": "elsewhere"}},
        {"_model.exposure._extra_state": {}},
    ],
)
def test_broken_exposures_are_named_in_one_line(changes, tmp_path, capsys):
    config = with_exposure(write_run(tmp_path / "run", None), **changes)
    with pytest.raises(SystemExit) as ended:
        main(["export-splats", "--load-config", str(config), "--output-dir", str(tmp_path / "out")])
    assert ended.value.code == 2
    assert "exposures cannot be read" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
