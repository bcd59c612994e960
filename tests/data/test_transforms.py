"""transforms.json: what is accepted, as by nerfstudio, and what is refused with the file and a remedy."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, CameraType
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image

from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.data.training_requirements import check_training
from ssa_nerfstudio.data.transforms import FISHEYE_MODELS, OTHER_MODELS, PERSPECTIVE_MODELS, Transforms
from ssa_nerfstudio.errors import InputError

NAMES = [f"images/{number}.png" for number in range(5)]


def write(folder: Path, edit: Callable[[dict], object] = lambda meta: None) -> Path:
    """A dataset of five photos in a row; `edit` changes transforms.json in place."""
    frames = []
    for number, name in enumerate(NAMES):
        pose = np.eye(4)
        pose[0, 3] = number
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    meta = {"w": 16, "h": 12, "fl_x": 14.0, "fl_y": 14.0, "cx": 8.0, "cy": 6.0, "frames": frames}
    for kind in ("images", "images_2", "masks"):
        (folder / kind).mkdir(parents=True)
        for name in NAMES:
            Image.new("RGB", (16, 12)).save(folder / kind / Path(name).name)
    edit(meta)
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder


def parsed_by_nerfstudio(data: Path, downscale_factor: int | None = None) -> None:
    parser = NerfstudioDataParserConfig(data=data, downscale_factor=downscale_factor).setup()
    for split in ("train", "val"):
        parser.get_dataparser_outputs(split)


def in_frames(key: str, values: list) -> Callable[[dict], None]:
    def edit(meta: dict) -> None:
        meta.pop(key, None)
        for frame, value in zip(meta["frames"], values, strict=True):
            frame[key] = value

    return edit


def test_camera_models_are_nerfstudios():
    kinds = CAMERA_MODEL_TO_TYPE
    assert {name for name, kind in kinds.items() if kind == CameraType.PERSPECTIVE} == PERSPECTIVE_MODELS
    assert {name for name, kind in kinds.items() if kind == CameraType.FISHEYE} == FISHEYE_MODELS
    assert kinds.keys() == PERSPECTIVE_MODELS | FISHEYE_MODELS | OTHER_MODELS


@pytest.mark.parametrize(
    "edit",
    [
        lambda meta: None,
        lambda meta: meta.update(w="16", fl_x="14.5", k1="0.01"),
        lambda meta: meta["frames"][1].update(transform_matrix=[["1", "0", "0", "7"], *np.eye(4)[1:].tolist()]),
        lambda meta: meta.update(distortion_params=[0.01, 0, 0, 0, 0, 0]),
        lambda meta: meta.update(camera_model="OPENCV_FISHEYE", k1=0.01, k4=0.001),
        in_frames("fl_x", [14.0, 15.0, "16", 17.0, 18.0]),
        in_frames("distortion_params", [[0.01 * number, 0, 0, 0, 0, 0] for number in range(5)]),
        in_frames("mask_path", [name.replace("images", "masks") for name in NAMES]),
        in_frames("depth_file_path", [name.replace("images", "nowhere") for name in NAMES]),
        lambda meta: meta["frames"].append(dict(meta["frames"][0])),
        lambda meta: meta.update(train_filenames=NAMES, val_filenames=NAMES[:1]),
        lambda meta: meta.update(train_filenames=[f"./{name}" for name in NAMES], val_filenames=[]),
        lambda meta: meta.update(
            applied_transform=np.eye(4)[:3].tolist(), applied_scale=2, orientation_override="none"
        ),
    ],
)
def test_what_nerfstudio_trains_on_is_accepted(edit, tmp_path):
    data = write(tmp_path / "data", edit)
    parsed_by_nerfstudio(data)
    check_training(Transforms.read(data))
    check_training(Transforms.read(data / "transforms.json"), splits=("train", "val"))


def test_photos_may_lie_in_a_reduced_folder_alone(tmp_path):
    data = write(tmp_path / "data")
    for name in NAMES:
        (data / name).unlink()
    parsed_by_nerfstudio(data, downscale_factor=2)
    check_training(Transforms.read(data), downscale_factor=2)
    with pytest.raises(FileNotFoundError):
        parsed_by_nerfstudio(data)
    with pytest.raises(InputError, match=r"images/0.png does not exist; put the photo there"):
        check_training(Transforms.read(data))


def pose(row: list | None) -> Callable[[dict], object]:
    return lambda meta: meta["frames"][3].update(transform_matrix=[row, *np.eye(4)[1:].tolist()] if row else row)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda meta: meta.pop("frames"), "has no list 'frames' of objects with a file_path"),
        (lambda meta: meta.update(frames={}), "has no list 'frames'"),
        (lambda meta: meta["frames"][2].pop("file_path"), r"the frame \{'transform_matrix.* is no such object"),
        (lambda meta: meta.update(camera_model="FISHEYE"), "camera_model 'FISHEYE' is none of EQUIRECTANGULAR"),
        (lambda meta: meta.update(camera_model=["OPENCV"]), "camera_model .* is none of"),
        (lambda meta: meta.pop("fl_x"), "camera of images/0.png: fl_x is missing"),
        (in_frames("fl_y", [14, 14, 0, 14, 14]), "images/2.png: focal lengths must be positive, got 14 and 0"),
        (lambda meta: meta.update(fl_x=-14), "focal lengths must be positive"),
        (lambda meta: meta.update(k1=float("nan")), "intrinsics must be finite, distortion is nan"),
        (lambda meta: meta.update(cx=1e300), r"intrinsics must be finite, cx is 1e\+300"),
        (lambda meta: meta.update(w=0), "frame must be at least 1 x 1 pixels, got 0 x 12"),
        (lambda meta: meta.update(w=None), "camera of images/0.png"),
        (lambda meta: meta.update(train_filenames="images"), "train_filenames must be a list of file paths"),
        (lambda meta: meta.update(val_filenames=["images/9.png"]), "val_filenames has images/9.png, which no frame is"),
        (lambda meta: meta.update(train_filenames=NAMES), "states a split without val_filenames"),
        (lambda meta: meta.update(frames=meta["frames"][:1]), "lists 1 photo; at least 2 are needed"),
        (pose(None), "the pose of images/3.png is no 4 x 4 matrix"),
        (pose([1, 0, 0, "x"]), "the pose of images/3.png"),
        (pose([1, 0, 0, float("nan")]), "the pose of images/3.png"),
        (pose([1, 0, 0, 1e39]), "the pose of images/3.png"),
        (pose([1, 0, 0]), "the pose of images/3.png"),
        (lambda meta: [f.update(transform_matrix=np.eye(4).tolist()) for f in meta["frames"]], "in one place"),
        (lambda meta: [f.update(transform_matrix=f["transform_matrix"][:3]) for f in meta["frames"]], "the pose of"),
        (lambda meta: meta.update(applied_transform=np.eye(4).tolist()), "applied_transform is no 3 x 4 matrix"),
        (lambda meta: meta.update(applied_scale="large"), "applied_scale is no finite number"),
        (lambda meta: meta.update(orientation_override="down"), "orientation_override must be one of none, pca, up"),
        (lambda meta: meta.update(ply_file_path=3), "ply_file_path 3 is no file path"),
        (lambda meta: meta.update(k1=0.01, k4=0.01), "nerfstudio undistorts no perspective camera with k4"),
        (lambda meta: meta.update(camera_model="VR180_L", k1=0.01), "splatfacto draws no camera_model VR180_L"),
        (lambda meta: meta["frames"][4].update(file_path="images/9.png"), "images/9.png does not exist; put the photo"),
        (lambda meta: meta["frames"][4].update(file_path="x" * 300), "does not exist"),
        (lambda meta: meta["frames"][4].update(mask_path=NAMES[0]), "mask_path is stated in 1 of 5 frames; state it"),
        (in_frames("mask_path", ["masks/9.png"] * 5), "masks/9.png does not exist; put the mask there"),
        (in_frames("mask_path", [3] * 5), "mask_path 3 is no file path"),
    ],
)  # fmt: skip
def test_what_training_cannot_use_is_named(edit, message, tmp_path):
    data = write(tmp_path / "data", edit)
    with pytest.raises(InputError, match=message) as caught:
        check_training(Transforms.read(data))
    assert str(data) in str(caught.value)


def test_detection_and_simulation_need_no_poses_and_complete_the_split(tmp_path):
    def edit(meta: dict) -> None:
        for frame in meta["frames"]:
            del frame["transform_matrix"]
        meta["test_filenames"] = NAMES[:2]

    dataset = Dataset.read(write(tmp_path / "data", edit), eval_interval=8)
    assert dataset.split == (NAMES[2:], NAMES[:2], NAMES[:2])
    assert [view.role for view in dataset.views] == ["test"] * 2 + ["train"] * 3


def test_absolute_paths_inside_the_dataset_are_as_relative_ones(tmp_path):
    """nerfstudio takes both, and some programs write them; everything else here goes on with relative ones."""
    data = write(tmp_path / "capture")
    path = data / "transforms.json"
    relative = json.loads(path.read_text())
    absolute = {**relative, "ply_file_path": str(data / "points.ply"), "test_filenames": [str(data / NAMES[0])]}
    absolute["frames"] = [{**frame, "file_path": str(data / frame["file_path"])} for frame in relative["frames"]]
    path.write_text(json.dumps(absolute))
    read = Transforms.read(data)
    read.check_copyable([read.meta["ply_file_path"]])
    assert [frame["file_path"] for frame in read.frames] == [frame["file_path"] for frame in relative["frames"]]
    assert read.stated_split("test") == [NAMES[0]]
    read.check_exist(frame["file_path"] for frame in read.frames)


def test_absolute_paths_elsewhere_stay_refused(tmp_path):
    data = write(tmp_path / "capture", lambda meta: meta["frames"][0].update(file_path=str(tmp_path / "other.png")))
    with pytest.raises(InputError, match="lies outside the dataset"):
        Transforms.read(data).check_copyable()
