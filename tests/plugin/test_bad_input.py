"""What cannot be worked with ends in one line that names the culprit and the remedy, and exit code 2."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import edit_transforms
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.training.fused_adam import FusedAdamConfig
from ssa_nerfstudio.plugin.validation import check_device, check_optimizers


def refusal(run: Callable) -> str:
    """The one line that says why `run` is refused."""
    with pytest.raises(InputError) as caught:
        run()
    line = str(caught.value)
    assert "\n" not in line
    return line


@pytest.fixture(scope="session")
def train(configure_training, train_and_evaluate):
    def train(data: Path, output: Path, steps: int = 2, **changes) -> None:
        config = configure_training("ssa-splatfacto", data, output, steps, {"num_downscales": 0})
        for name, value in changes.items():
            setattr(config, name, value)
        train_and_evaluate(config)

    return train


def edit_frames(scene: Path, edit: Callable[[list[dict]], list[dict]]) -> None:
    path = scene / "transforms.json"
    transforms = json.loads(path.read_text())
    transforms["frames"] = edit(transforms["frames"])
    for split in ("train", "val", "test"):
        transforms.pop(f"{split}_filenames")
    path.write_text(json.dumps(transforms))


def test_a_folder_that_does_not_exist_is_named(tmp_path, train):
    assert str(tmp_path / "nowhere") in refusal(lambda: train(tmp_path / "nowhere", tmp_path))


def test_a_folder_without_transforms_tells_how_to_make_them(tmp_path, train):
    assert "ns-process-data" in refusal(lambda: train(tmp_path, tmp_path / "out"))


def test_a_dataset_without_photos_is_refused(broken_scene, tmp_path, train):
    edit_frames(broken_scene, lambda frames: [])
    assert "lists 0 photos" in refusal(lambda: train(broken_scene, tmp_path / "out"))


def test_a_single_photo_is_refused(broken_scene, tmp_path, train):
    edit_frames(broken_scene, lambda frames: frames[:1])
    assert "lists 1 photo; at least 2" in refusal(lambda: train(broken_scene, tmp_path / "out"))


def test_a_split_that_leaves_one_photo_to_train_on_is_refused(broken_scene, tmp_path, train):
    edit_frames(broken_scene, lambda frames: frames[:2])
    assert "leaves 1 photo to train on" in refusal(lambda: train(broken_scene, tmp_path / "out"))


def test_a_missing_photo_is_named(broken_scene, tmp_path, train):
    (broken_scene / "images" / "train_0003.png").unlink()
    assert "train_0003.png does not exist" in refusal(lambda: train(broken_scene, tmp_path / "out"))


def test_a_truncated_photo_is_named(broken_scene, tmp_path, train):
    photo = broken_scene / "images" / "train_0004.png"
    photo.write_bytes(photo.read_bytes()[:200])
    message = refusal(lambda: train(broken_scene, tmp_path / "out"))
    assert "train_0004.png cannot be read as a photo" in message
    assert "copy it again" in message


def test_a_text_file_named_like_a_photo_is_named(broken_scene, tmp_path, train):
    (broken_scene / "images" / "train_0005.png").write_text("no photo")
    assert "train_0005.png cannot be read as a photo" in refusal(lambda: train(broken_scene, tmp_path / "out"))


def test_a_photo_of_another_size_is_refused(broken_scene, tmp_path, train):
    from PIL import Image

    path = broken_scene / "images" / "train_0002.png"
    Image.open(path).resize((32, 24)).save(path)
    assert "train_0002.png is 32 x 24, expected 64 x 48" in refusal(lambda: train(broken_scene, tmp_path / "out"))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "x", None])
def test_a_pose_that_is_no_number_names_its_photo(broken_scene, tmp_path, value, train):
    def spoil(frames: list[dict]) -> list[dict]:
        frames[7]["transform_matrix"][1][3] = value
        return frames

    name = json.loads((broken_scene / "transforms.json").read_text())["frames"][7]["file_path"]
    edit_frames(broken_scene, spoil)
    assert f"the pose of {name}" in refusal(lambda: train(broken_scene, tmp_path / "out"))


def test_transforms_that_are_no_json_are_named(broken_scene, tmp_path, train):
    (broken_scene / "transforms.json").write_text("{")
    assert "transforms.json is no valid JSON" in refusal(lambda: train(broken_scene, tmp_path / "out"))


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has CUDA")
def test_cuda_where_there_is_none_is_refused_with_the_flag_that_helps(
    tiny_scene, tmp_path, configure_training, train_and_evaluate
):
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 2)
    config.machine.device_type = "cuda"
    assert "--machine.device-type cpu" in refusal(lambda: train_and_evaluate(config))


def test_a_gpu_that_is_not_the_current_one_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    check_device("cuda")
    check_device("cuda:0")
    assert "torch.cuda.set_device(1)" in refusal(lambda: check_device("cuda:1"))


def test_resuming_with_photos_of_another_size_is_refused(tiny_scene, tmp_path, configure_training, train_and_evaluate):
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 2, {"num_downscales": 0})
    _, _, path = train_and_evaluate(config)
    other = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 4, {"num_downscales": 0}, scale_factor=0.5)
    other.load_dir = path.parent / "nerfstudio_models"
    message = refusal(lambda: train_and_evaluate(other))
    assert "(64, 48)" in message
    assert "(32, 24)" in message


def test_resuming_an_overlay_without_one_is_refused(tiny_scene, tmp_path, configure_training, train_and_evaluate):
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 2, {"num_downscales": 0})
    _, _, path = train_and_evaluate(config)
    other = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 4, {"num_downscales": 0, "overlay": "off"})
    other.load_dir = path.parent / "nerfstudio_models"
    assert "--pipeline.model.overlay on" in refusal(lambda: train_and_evaluate(other))


def test_resuming_from_an_empty_folder_is_refused(tiny_scene, tmp_path, train):
    assert "holds no step-*.ckpt" in refusal(lambda: train(tiny_scene, tmp_path / "out", load_dir=tmp_path))


@pytest.mark.parametrize(
    ("option", "says"),
    [
        ("load_dir", "nerfstudio_models holds no checkpoint that can be read"),
        ("load_step", "step-000000001.ckpt cannot be read (the checksum"),
        ("load_checkpoint", "step-000000001.ckpt cannot be read (the checksum"),
    ],
)
def test_resuming_from_a_damaged_checkpoint_is_refused(
    tiny_scene, tmp_path, option, says, train, configure_training, train_and_evaluate
):
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 2, {"num_downscales": 0})
    _, _, path = train_and_evaluate(config)
    checkpoint = next((path.parent / "nerfstudio_models").glob("*.ckpt"))
    content = bytearray(checkpoint.read_bytes())
    content[len(content) // 2] ^= 0xFF
    checkpoint.write_bytes(content)
    options = {"load_dir": checkpoint.parent, "load_step": 1 if option == "load_step" else None}
    if option == "load_checkpoint":
        options = {"load_checkpoint": checkpoint}
    message = refusal(lambda: train(tiny_scene, tmp_path / "out", 4, **options))
    assert says in message
    if option != "load_dir":
        assert message.endswith(f"; name another checkpoint: --{option.replace('_', '-')}")


def test_resuming_a_learned_overlay_with_a_given_one_is_refused(
    tiny_scene, tmp_path, configure_training, train_and_evaluate
):
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 2, {"num_downscales": 0})
    _, _, path = train_and_evaluate(config)
    layers = tmp_path / "layers.npz"
    np.savez(layers, T=np.ones((48, 64, 3)), B=np.zeros((48, 64, 3)))
    model = {"num_downscales": 0, "overlay": "given", "overlay_given": layers}
    other = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 4, model)
    other.load_dir = path.parent / "nerfstudio_models"
    assert "trained with overlay on, this run has given" in refusal(lambda: train_and_evaluate(other))


@pytest.mark.parametrize(
    ("model", "complaint"),
    [
        ({"sparsity_weight": -1.0}, "--pipeline.model.sparsity-weight must be at least 0, got -1.0"),
        ({"sparsity_weight": float("nan")}, "--pipeline.model.sparsity-weight must be at least 0, got nan"),
        ({"cap_max": -5}, "--pipeline.model.cap-max must be at least 1, got -5"),
        ({"refine_every": 0}, "--pipeline.model.refine-every must be at least 1, got 0"),
        ({"mcmc_opacity_start": 1.0}, "--pipeline.model.mcmc-opacity-start must be in (0, 1), got 1.0"),
        ({"rasterizer": "reference"}, "--pipeline.model.use-absgrad False"),
        ({"rasterizer": "gsplat"}, "does not run on cpu"),
    ],
)
def test_settings_that_cannot_work_are_refused(
    tiny_scene, tmp_path, model, complaint, configure_training, train_and_evaluate
):
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 2, model)
    config.machine.device_type = "cpu"
    assert complaint in refusal(lambda: train_and_evaluate(config))


@pytest.mark.parametrize("steps", [0, -5])
def test_a_training_of_no_steps_is_refused(tiny_scene, tmp_path, steps, train):
    refused = refusal(lambda: train(tiny_scene, tmp_path, steps))
    assert f"--max-num-iterations must be at least 1, got {steps}" in refused


@pytest.mark.parametrize("factor", [0.0, -1.0, float("nan")])
def test_photos_of_no_size_are_refused(tiny_scene, tmp_path, factor, configure_training, train_and_evaluate):
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 2, scale_factor=factor)
    assert "camera-res-scale-factor must be above 0" in refusal(lambda: train_and_evaluate(config))


def test_a_focal_length_that_is_no_number_is_refused(broken_scene, tmp_path, train):
    edit_transforms(broken_scene, fl_x=float("nan"))
    assert "intrinsics must be finite, fl_x is nan" in refusal(lambda: train(broken_scene, tmp_path / "out"))


def test_frames_that_are_no_objects_are_refused(broken_scene, tmp_path, train):
    edit_transforms(broken_scene, frames=["a", "b", "c"])
    assert "the frame 'a'" in refusal(lambda: train(broken_scene, tmp_path / "out"))


@pytest.mark.parametrize(
    ("arrays", "complaint"),
    [
        ({"T": np.ones((48, 64, 3))}, "holds no usable layers"),
        ({"T": np.ones((48, 64)), "B": np.ones((48, 64))}, "must both be [H, W, 3]"),
        ({"T": np.full((48, 64, 3), 2.0), "B": np.zeros((48, 64, 3))}, "T must lie in [0, 1]"),
        ({"T": np.full((48, 64, 3), np.nan), "B": np.zeros((48, 64, 3))}, "not finite"),
        ({"T": np.ones((24, 32, 3)), "B": np.zeros((24, 32, 3))}, "48 x 64"),
    ],
)
def test_given_layers_that_do_not_fit_are_refused(
    tiny_scene, tmp_path, arrays, complaint, configure_training, train_and_evaluate
):
    path = tmp_path / "layers.npz"
    np.savez(path, **arrays)
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 2, {"overlay": "given", "overlay_given": path})
    assert complaint in refusal(lambda: train_and_evaluate(config))


def test_the_command_line_ends_with_the_line_alone_and_exit_code_2(broken_scene, tmp_path):
    photo = broken_scene / "images" / "train_0004.png"
    photo.write_bytes(photo.read_bytes()[:200])
    command = [str(Path(sys.executable).with_name("ns-train")), "ssa-splatfacto", "--data", str(broken_scene)]
    options = ["--vis", "tensorboard", "--output-dir", str(tmp_path / "out")]
    done = subprocess.run([*command, *options], capture_output=True, text=True, timeout=300)
    assert done.returncode == 2
    assert "train_0004.png cannot be read as a photo" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_group_without_a_schedule_may_be_frozen():
    """A schedule takes the rate's logarithm."""
    frozen = FusedAdamConfig(lr=0.0)
    check_optimizers({"opacities": {"optimizer": frozen, "scheduler": None}})
    with pytest.raises(InputError, match=r"means\.optimizer\.lr must be finite and above 0, got 0"):
        check_optimizers({"means": {"optimizer": frozen, "scheduler": ExponentialDecaySchedulerConfig()}})
