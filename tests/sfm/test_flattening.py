"""The static factor of photos: found where there is one, and only there."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from small_captures import HEIGHT, WIDTH, write

from ssa_nerfstudio.sfm.flat_field import flattened, static_factor, write_flattened

VIEWS = 24


def gray(photo: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)


def high_pass(picture: np.ndarray) -> np.ndarray:
    return picture - cv2.GaussianBlur(picture, (0, 0), min(picture.shape) / 12)


@pytest.mark.parametrize("seed", range(3))
def test_mud_is_found_and_taken_out(seed, tmp_path, draw_effect, photos):
    layers = draw_effect("mud", HEIGHT, WIDTH, seed)
    muddy = [layers.apply(photo) for photo in photos(VIEWS)]
    folder = write(tmp_path / "muddy", muddy)
    factor = static_factor(sorted(folder.iterdir()), 1600)
    assert factor is not None
    true = high_pass(np.log(layers.transmittance.mean(axis=-1)))
    assert np.corrcoef(factor.log.ravel(), true.ravel())[0, 1] > 0.8

    def speckle(photo: np.ndarray, clean: np.ndarray) -> float:
        ratio = np.log((photo + 8.0) / (clean + 8.0)).astype(np.float32)
        return float(high_pass(ratio).std())

    for before, clean in list(zip(map(gray, muddy), map(gray, photos(VIEWS)), strict=True))[:5]:
        assert speckle(flattened(before, factor), clean) < 0.75 * speckle(before, clean)


def test_clean_photos_have_none(tmp_path, photos):
    folder = write(tmp_path / "clean", photos(VIEWS))
    assert static_factor(sorted(folder.iterdir()), 1600) is None


def test_one_photo_over_and_over_is_static_altogether(tmp_path, photos):
    """The limit of the method: where nothing moves, everything is static, and flat when it is taken out."""
    folder = write(tmp_path / "same", photos(VIEWS)[:1] * 8)
    factor = static_factor(sorted(folder.iterdir()), 1600)
    assert factor is not None
    (before, after) = (gray(photos(VIEWS)[0]), flattened(gray(photos(VIEWS)[0]), factor))
    detail = [high_pass(np.log(photo.astype(np.float32) + 8)).std() for photo in (before, after)]
    assert detail[1] < 0.2 * detail[0]


def test_the_factor_of_large_photos_is_found_at_a_smaller_size(tmp_path, draw_effect, photos):
    layers = draw_effect("mud", HEIGHT, WIDTH)
    folder = write(tmp_path / "muddy", [layers.apply(photo) for photo in photos(VIEWS)])
    factor = static_factor(sorted(folder.iterdir()), 112)
    assert factor is not None
    assert factor.log.shape == (84, 112)
    assert flattened(gray(photos(VIEWS)[0]), factor).shape == (HEIGHT, WIDTH)


def test_the_artifacts_own_light_is_found(tmp_path, draw_effect, photos):
    """Mud of gray value 46 brightens what is darker; a factor of the photos themselves would leave it there."""
    layers = draw_effect("mud", HEIGHT, WIDTH)
    folder = write(tmp_path / "muddy", [layers.apply(photo) for photo in photos(VIEWS)])
    factor = static_factor(sorted(folder.iterdir()), 1600)
    assert factor is not None
    assert abs(factor.level - 46) <= 16


def test_photos_without_the_artifact_are_copied(tmp_path, draw_effect, photos):
    layers = draw_effect("mud", HEIGHT, WIDTH)
    clean, muddy = photos(VIEWS)[:8], [layers.apply(photo) for photo in photos(VIEWS)[8:]]
    files = [write(tmp_path / "photos", [*clean, *muddy]) / f"photo_{number}.png" for number in range(VIEWS)]
    done: list[int] = []
    assert write_flattened(files, [slice(8, VIEWS)], tmp_path / "flat", 1600, done.append)
    assert done == [*range(1, VIEWS + 1)]
    same = [file.read_bytes() == (tmp_path / "flat" / file.name).read_bytes() for file in files]
    assert same == [True] * 8 + [False] * (VIEWS - 8)
    # With too few photos nothing can be called static.
    assert not write_flattened(files, [slice(8, 15)], tmp_path / "short", 1600, done.append)
    assert not (tmp_path / "short").exists()
