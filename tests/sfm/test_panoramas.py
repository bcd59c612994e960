"""`ssa process` on 360 photos whose cameras are known, with an operator in front of the scene."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image
from small_captures import write
from wide_captures import operator, panorama, panorama_poses, with_operator

from benchmarks.sfm_accuracy import center_errors
from ssa_nerfstudio.cameras.panorama import FACE_NAMES, Face, cut, panorama_faces
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.plugin.camera_matching import group_cameras

pytestmark = pytest.mark.slow

VIEWS, WIDTH = 8, 512
FACES = FACE_NAMES[:4]


@pytest.fixture(scope="module")
def processed(tmp_path_factory, trace_built_in_scene) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    photos = [panorama(trace_built_in_scene, pose, WIDTH) for pose in panorama_poses(VIEWS)]
    write(folder / "photos", [with_operator(photo) for photo in photos])
    Image.fromarray(operator(WIDTH)[..., 0] == 0).save(folder / "mask.png")
    main([
        "process", "--train", str(folder / "photos"), "--output", str(folder / "dataset"), "--threads", "1",
        "--mask", str(folder / "mask.png"), "--leave-out", "up", "down",
    ])  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def meta(processed) -> dict:
    return json.loads((processed / "dataset/transforms.json").read_text())


def pose(meta: dict, face: str, number: int) -> np.ndarray:
    (found,) = (f for f in meta["frames"] if f["file_path"] == f"images/frame_{face}_{number + 1:05d}.png")
    return np.array(found["transform_matrix"])


def test_all_faces_of_a_photo_are_in_its_place_and_look_where_they_should(meta):
    true = panorama_poses(VIEWS)
    extent = np.linalg.norm(true[:, :3, 3] - true[:, :3, 3].mean(axis=0), axis=1).mean()
    for face in FACES:
        centers = np.array([pose(meta, face, number)[:3, 3] for number in range(VIEWS)])
        assert center_errors(centers, true[:, :3, 3]).max() < 0.01 * extent
    flip = np.diag([1, -1, -1])  # from OpenGL's axes to OpenCV's
    for number in range(VIEWS):
        front = pose(meta, "front", number)
        for face in FACES:
            other = pose(meta, face, number)
            np.testing.assert_allclose(other[:3, 3], front[:3, 3], atol=1e-6)
            turned = flip @ front[:3, :3].T @ other[:3, :3] @ flip
            np.testing.assert_allclose(turned, Face(face, 1).from_panorama.T, atol=1e-6)


def test_lenses_are_what_the_faces_were_cut_with(meta):
    (size,) = {frame["w"] for frame in meta["frames"]}
    assert {frame["k1"] for frame in meta["frames"]} == {0.0}
    for frame in meta["frames"]:
        (face,) = (Face(name, size) for name in FACES if f"_{name}_" in frame["file_path"])
        assert frame["fl_x"] == frame["fl_y"] == pytest.approx(face.focal)
    assert meta["panorama"] == {"w": WIDTH, "h": WIDTH // 2, "face_size": size, "faces": list(FACES)}


def test_photos_are_the_faces_of_the_panoramas(processed):
    panorama = np.asarray(Image.open(processed / "photos/photo_3.png"))
    for face in panorama_faces(WIDTH, ("up", "down")):
        stored = np.asarray(Image.open(processed / f"dataset/images/frame_{face.name}_00004.png"))
        assert np.array_equal(stored, cut(panorama, face))


def test_nerfstudio_reads_it_and_training_sees_a_camera_for_each_face(processed):
    outputs = NerfstudioDataParserConfig(data=processed / "dataset").setup().get_dataparser_outputs("train")
    _, groups = group_cameras(outputs.cameras)
    faces = [path.name.split("_")[1] for path in outputs.image_filenames]
    assert len({*zip(groups, faces, strict=True)}) == len({*groups}) == len(FACES)


def test_the_mask_of_the_panorama_is_cut_like_the_photos(processed):
    back = np.asarray(Image.open(processed / "dataset/mask_colmap_frame_back.png"))
    hidden = cut(operator(WIDTH), next(face for face in panorama_faces(WIDTH) if face.name == "back"))[..., 0] > 0.5
    assert not back[hidden].any()
    assert back.mean() > 0.5
    assert np.asarray(Image.open(processed / "dataset/mask_colmap_frame_front.png")).all()


def test_the_rig_is_in_colmaps_model(processed):
    model = pycolmap.Reconstruction(processed / "dataset/colmap/sparse/0")
    (rig,) = model.rigs.values()
    assert rig.num_sensors() == len(FACES)
    assert model.num_reg_frames() == VIEWS
