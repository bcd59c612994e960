"""The lens is found from all photos where the first two would not tell it."""

from __future__ import annotations

import numpy as np
import pytest
from small_captures import HEIGHT, WIDTH, poses, write

from benchmarks.sfm_accuracy import center_errors

VIEWS = 8


def test_the_lens_and_all_poses_are_found_from_guesses(tmp_path, photos):
    import PIL.Image  # noqa: F401 - before pycolmap
    import pycolmap

    from ssa_nerfstudio.sfm.colmap import StructureFromMotion
    from ssa_nerfstudio.sfm.held_lens import map_with_held_lens
    from ssa_nerfstudio.sfm.reconstruction import Pass, SfmSettings
    from ssa_nerfstudio.sfm.registration import aspect, better, has_real_lenses

    images = write(tmp_path / "images", photos(VIEWS))
    passes = [Pass(sorted(path.name for path in images.iterdir()), str(images))]
    structure = StructureFromMotion(images, passes, tmp_path, SfmSettings(threads=1))
    structure.extract(lambda *_: None)
    structure.match(lambda *_: None)
    before = (tmp_path / "database.db").read_bytes()

    held = set()

    def options() -> pycolmap.IncrementalPipelineOptions:
        with pycolmap.Database.open(tmp_path / "held/database.db") as opened:
            held.add(tuple(opened.read_camera(1).params))
        made = pycolmap.IncrementalPipelineOptions()
        made.num_threads, made.random_seed = 1, 0
        return made

    found = map_with_held_lens(tmp_path / "database.db", images, tmp_path / "held", options, [1], None, lambda: None)
    assert found is not None
    # Guesses are lenses without distortion, whose axis is the middle, from 45 to 100 degrees across.
    guesses = sorted(lens for lens in held if not any(lens[4:]))
    assert all(lens == (lens[0], lens[0], WIDTH / 2, HEIGHT / 2, 0, 0, 0, 0) for lens in guesses)
    angles = 2 * np.degrees(np.arctan(WIDTH / 2 / np.array([lens[0] for lens in guesses])))
    np.testing.assert_allclose(angles, [100, 80, 61, 45], atol=1)
    views = [image for image in found.images.values() if image.has_pose]
    assert len(views) == VIEWS
    focal = WIDTH / 2 / np.tan(np.radians(65 / 2))
    np.testing.assert_allclose(found.cameras[1].params[:2], focal, rtol=0.05)
    true = poses(VIEWS)[:, :3, 3]
    centers = np.array([image.projection_center() for image in views])
    numbers = [int(image.name.removeprefix("photo_").removesuffix(".png")) for image in views]
    extent = np.linalg.norm(true - true.mean(axis=0), axis=1).mean()
    assert center_errors(centers, true[numbers]).max() < 0.03 * extent
    assert (found.cameras[1].width, found.cameras[1].height) == (WIDTH, HEIGHT)
    assert not (tmp_path / "held").exists()
    assert (tmp_path / "database.db").read_bytes() == before

    # A lens that squeezes is none, however many photos fit.
    assert has_real_lenses(found)
    squeezed = pycolmap.Reconstruction(found)
    squeezed.cameras[1].params = [3 * focal, focal, *found.cameras[1].params[2:]]
    assert aspect(squeezed.cameras[1]) == pytest.approx(3)
    assert not has_real_lenses(squeezed)
    assert better(squeezed, found) is better(found, squeezed) is found
    assert better(squeezed, None) is squeezed
