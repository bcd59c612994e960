"""What is at the same place of all photos belongs to the artifact, and is no match."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from small_captures import write

from ssa_nerfstudio.sfm.reconstruction import Pass, SfmSettings


@pytest.mark.parametrize(
    ("settings", "matched"), [(SfmSettings(threads=1), False), (SfmSettings(threads=1, filter_stationary=False), True)]
)
def test_a_logo_that_photos_have_in_common_is_a_match_only_if_that_is_asked_for(tmp_path, settings, matched):
    """Two photos of different scenes behind one logo."""
    import PIL.Image  # noqa: F401 - before pycolmap
    import pycolmap

    from ssa_nerfstudio.sfm.colmap import StructureFromMotion

    rng = np.random.default_rng(0)

    def texture(height: int, width: int) -> np.ndarray:
        coarse = rng.integers(0, 256, (height // 4, width // 4, 3), dtype=np.uint8)
        return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)

    pictures, logo = [texture(160, 240) for _ in range(2)], texture(80, 120)
    for picture in pictures:
        picture[40:120, 60:180] = logo
    images = write(tmp_path / "images", pictures)
    names = sorted(path.name for path in images.iterdir())
    (tmp_path / "work").mkdir()
    structure = StructureFromMotion(images, [Pass(names, str(images))], tmp_path / "work", settings)
    structure.extract(lambda *_: None)
    structure.match(lambda *_: None)
    with pycolmap.Database.open(tmp_path / "work" / "database.db") as database:
        first, second = (image.image_id for image in database.read_all_images())
        found = len(database.read_two_view_geometry(first, second).inlier_matches)
    assert (found > 20) == matched
