"""Equirectangular photos and videos are recognized, and 2:1 photos of other cameras are not taken for such."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_captures import poses
from wide_captures import panorama, panorama_poses, with_operator, write_clip

from ssa_nerfstudio.cameras.panorama import FACE_NAMES
from ssa_nerfstudio.data.equirectangular import cut_into_faces, with_faces, wraps_around
from ssa_nerfstudio.data.sources import Source, read_sources
from ssa_nerfstudio.errors import InputError

WIDTH = 256


@pytest.fixture(scope="module")
def round_photos(trace_built_in_scene) -> list[np.ndarray]:
    return [panorama(trace_built_in_scene, pose, WIDTH) for pose in panorama_poses(5)]


def source(folder: Path, pictures: list[np.ndarray], suffix: str = ".png") -> Source:
    folder.mkdir()
    for number, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"{number}{suffix}")
    (found,) = read_sources(folder, "frame", min_photos=3)
    return found


def test_360_photos_are_recognized_with_an_operator_and_without(round_photos, tmp_path):
    assert wraps_around(source(tmp_path / "clean", round_photos))
    assert wraps_around(source(tmp_path / "operator", [with_operator(photo) for photo in round_photos], ".jpg"))


def test_writing_over_one_pole_leaves_360_photos_recognized(round_photos, tmp_path):
    written = [photo.copy() for photo in round_photos]
    for photo in written:
        photo[-10:, 30:130:3] = 255 - photo[-10:, 30:130:3]
    assert wraps_around(source(tmp_path / "written", written))


def test_a_360_video_is_recognized(round_photos, tmp_path):
    clip = write_clip(tmp_path / "clip.mp4", round_photos)
    assert with_faces(read_sources(clip, "frame", min_photos=3))[0].faces


def test_2_to_1_photos_of_other_cameras_are_not_360(photos, captures, tmp_path):
    cut_photos = [photo[: photo.shape[1] // 2] for photo in photos(len(poses(4)))]
    assert not wraps_around(source(tmp_path / "room", cut_photos))
    for name in ("fox", "plush", "gopro_walk"):
        real = [np.asarray(Image.open(file)) for file in sorted((captures / name / "images").glob("*"))[:5]]
        halves = [photo[: photo.shape[1] // 2, : photo.shape[0] * 2] for photo in real]
        halves = [photo[: photo.shape[1] // 2] for photo in halves]
        assert not wraps_around(source(tmp_path / name, halves)), name


def test_a_letterboxed_photo_has_constant_poles_but_does_not_wrap(photos, tmp_path):
    framed = [np.pad(photo[40:-40], ((12, 12), (0, 0), (0, 0))) for photo in photos(4)]
    assert framed[0].shape[1] == 2 * framed[0].shape[0]
    assert not wraps_around(source(tmp_path / "film", framed))


def test_photos_through_a_dark_visor_do_not_wrap(photos, tmp_path):
    framed = [np.pad(photo[44:-44, 16:-16], ((8, 8), (16, 16), (0, 0)), constant_values=20) for photo in photos(4)]
    framed = [photo[:, : 2 * photo.shape[0]] for photo in framed]
    for photo in framed:
        photo[:, -16:] = 20
    assert framed[0].shape[1] == 2 * framed[0].shape[0]
    assert not wraps_around(source(tmp_path / "visor", framed))


def test_the_option_overrides_and_the_line_says_so(round_photos, photos, tmp_path):
    found = source(tmp_path / "round", round_photos)
    assert with_faces([found], "perspective")[0].faces == ()
    (faced,) = with_faces([found], left_out=("down", "up"))
    assert [camera.name for camera in faced.cameras] == ["frame_front", "frame_right", "frame_back", "frame_left"]
    assert "(front, right, back, left). (--projection perspective" in cut_into_faces(faced)
    flat = source(tmp_path / "flat", [photo[:112] for photo in photos(4)])
    assert with_faces([flat])[0].faces == ()
    assert len(with_faces([flat], "equirectangular")[0].faces) == 6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("equirectangular", ()), "224 x 168, equirectangular ones are 2:1; export them"),
        (("auto", ("down",)), "not taken for such; leave it out, or add --projection equirectangular"),
        (("equirectangular", FACE_NAMES), "leaves no face; keep at least one"),
    ],
)
def test_options_that_do_not_fit_are_refused(photos, tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        with_faces([source(tmp_path / "photos", photos(4))], *options)
