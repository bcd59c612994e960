"""Structure from motion goes on where it was interrupted, and survives mud that covers the whole frame."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_captures import HEIGHT, WIDTH, poses, write

from benchmarks.sfm_accuracy import center_errors, similarity
from ssa_nerfstudio.data.sources import read_source
from ssa_nerfstudio.sfm.photos_to_dataset import process
from ssa_nerfstudio.sfm.reconstruction import MODEL, Pass, SfmSettings

VIEWS = 12


class Interrupted(Exception):
    """As a signal would."""


def test_features_and_matches_are_made_once(tmp_path, photos):
    """Interrupted within features and within matches, the next run starts with what is done and finds the same."""
    import PIL.Image  # noqa: F401 - before pycolmap
    import pycolmap

    from ssa_nerfstudio.sfm.colmap import StructureFromMotion

    images = write(tmp_path / "images", photos(VIEWS))
    names = sorted(path.name for path in images.iterdir())
    # 66 pairs: more than are matched at once.
    one_pass = [Pass(names, str(images))]

    def interrupt(at: str, done: int):
        def report(stage: str, so_far: int, total: int) -> None:
            seen.append((stage, so_far))
            if stage == at and so_far >= done:
                raise Interrupted

        return report

    def never(stage: str, so_far: int, total: int) -> None:
        seen.append((stage, so_far))

    models = []
    for folder, stops in (("whole", ()), ("stopped", (("features", 4), ("matches", 60)))):
        (tmp_path / folder).mkdir()
        structure = StructureFromMotion(images, one_pass, tmp_path / folder, SfmSettings(threads=1))
        seen: list[tuple[str, int]] = []
        for stage, done in stops:
            with pytest.raises(Interrupted):  # noqa: PT012 - whichever of the two is interrupted
                structure.extract(interrupt(stage, done))
                structure.match(interrupt(stage, done))
            seen.clear()
        structure.extract(never)
        structure.match(never)
        assert seen[0] == (("features", VIEWS) if stops else ("features", 0))
        structure.map(never, {})
        models.append(pycolmap.Reconstruction(tmp_path / folder / MODEL))
    whole, stopped = models
    assert whole.num_reg_images() == stopped.num_reg_images() == VIEWS
    assert whole.num_points3D() == pytest.approx(stopped.num_points3D(), rel=0.02)


def test_mud_all_over_the_frame(tmp_path, draw_effect, photos):
    """COLMAP alone finds the mud, which does not move, and few photos; without the mud in them it finds the scene."""
    layers = draw_effect("mud", HEIGHT, WIDTH)
    folder = write(tmp_path / "photos", [layers.apply(photo) for photo in photos(24)])
    true = poses(24)[:, :3, 3]
    source = read_source(folder, "frame", min_photos=3)
    outcome = process([source], tmp_path / "out", settings=SfmSettings(threads=1))
    assert outcome.passes[0].count >= 0.9 * 24
    assert _error(tmp_path / "out", true) < 0.03


def _error(dataset: Path, true: np.ndarray) -> float:
    frames = json.loads((dataset / "transforms.json").read_text())["frames"]
    found = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    numbers = [int(Path(frame["source_name"]).stem.removeprefix("photo_")) for frame in frames]
    extent = np.linalg.norm(true - true.mean(axis=0), axis=1).mean()
    return float(center_errors(found, true[numbers]).max() / extent)


def test_similarities_are_recovered():
    rng = np.random.default_rng(0)
    for _ in range(20):
        points = rng.normal(size=(6, 3))
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        rotation *= np.sign(np.linalg.det(rotation))
        moved = 2.5 * points @ rotation.T + [1, 2, 3]
        found, scale, translation = similarity(points, moved)
        np.testing.assert_allclose(found, rotation, atol=1e-12)
        np.testing.assert_allclose(scale, 2.5)
        np.testing.assert_allclose(translation, [1, 2, 3], atol=1e-12)
        assert center_errors(points, moved).max() < 1e-12
        # A mirrored shape is another: no rotation hides it.
        assert center_errors(points * [1, 1, -1], points).max() > 0.1
