"""The static factor of photos: found where there is one, and only there."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from small_captures import HEIGHT, WIDTH, write

from ssa_nerfstudio.sfm.flat_field import flattened, static_factor

VIEWS = 24


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
    assert np.corrcoef(factor.ravel(), true.ravel())[0, 1] > 0.8

    def speckle(photo: np.ndarray, clean: np.ndarray) -> float:
        ratio = np.log((photo.mean(axis=-1) + 8) / (clean.mean(axis=-1) + 8)).astype(np.float32)
        return float(high_pass(ratio).std())

    for before, clean in list(zip(muddy, photos(VIEWS), strict=True))[:5]:
        assert speckle(flattened(before, factor), clean) < 0.75 * speckle(before, clean)


def test_clean_photos_have_none(tmp_path, photos):
    folder = write(tmp_path / "clean", photos(VIEWS))
    assert static_factor(sorted(folder.iterdir()), 1600) is None


def test_one_photo_over_and_over_is_static_altogether(tmp_path, photos):
    """The limit of the method: where nothing moves, everything is static, and flat when it is taken out."""
    folder = write(tmp_path / "same", photos(VIEWS)[:1] * 8)
    factor = static_factor(sorted(folder.iterdir()), 1600)
    assert factor is not None
    (before, after) = (photos(VIEWS)[0], flattened(photos(VIEWS)[0], factor))
    detail = [high_pass(np.log(photo.mean(axis=-1).astype(np.float32) + 8)).std() for photo in (before, after)]
    assert detail[1] < 0.2 * detail[0]


def test_the_factor_of_large_photos_is_found_at_a_smaller_size(tmp_path, draw_effect, photos):
    layers = draw_effect("mud", HEIGHT, WIDTH)
    folder = write(tmp_path / "muddy", [layers.apply(photo) for photo in photos(VIEWS)])
    factor = static_factor(sorted(folder.iterdir()), 112)
    assert factor is not None
    assert factor.shape == (84, 112)
    assert flattened(photos(VIEWS)[0], factor).shape == (HEIGHT, WIDTH, 3)
