"""Photos of two places that look alike are joined where their strongest matches are."""

from __future__ import annotations

import json
from itertools import combinations
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401 - before pycolmap
import pycolmap
import pytest

from benchmarks.sfm_accuracy import center_errors
from ssa_nerfstudio.sfm.colmap import StructureFromMotion
from ssa_nerfstudio.sfm.false_joins import rejoin, torn_links
from ssa_nerfstudio.sfm.reconstruction import MODEL, TORN, Pass, SfmSettings
from ssa_nerfstudio.sfm.registration import warn_of_false_joins
from ssa_nerfstudio.sfm.square_pixels import free

VIEWS, HALF = 8, 4
CENTERS = np.stack([np.arange(VIEWS), 0.3 * np.arange(VIEWS) ** 0.5, 0.2 * np.sin(np.arange(VIEWS))], axis=1)


class Corridor:
    """Photos along a wall, whose second half partly looks like the first: those points match as if they were one."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        points = np.stack([rng.uniform(-2, HALF - 2, 300), rng.uniform(-1, 1, 300), rng.uniform(2, 4, 300)], axis=1)
        step = CENTERS[HALF] - CENTERS[0]
        # The points of both halves that look alike, and those that do not.
        own, others = points[100:], points[100:] + np.array([HALF, 0, 0.1])
        self.points = np.concatenate([points[:100], points[:100] + step, own, others])
        self.looks = np.concatenate([np.arange(100), np.arange(100), 100 + np.arange(400)])
        self.camera = pycolmap.Camera(
            camera_id=1, model="RADIAL", width=640, height=480, params=[400, 320, 240, 0.0, 0.0]
        )
        self.seen, self.pixels = [], []
        for center in CENTERS:
            rays = self.points - center
            pixels = np.array([self.camera.img_from_cam(ray) for ray in rays])
            inside = ((pixels > 0) & (pixels < [640, 480])).all(axis=1)
            self.seen.append(np.flatnonzero(inside))
            self.pixels.append(pixels[inside])

    def model(self, wrong: bool) -> pycolmap.Reconstruction:
        """With the true poses, or with the second half where the first is."""
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(self.camera)
        shift = CENTERS[0] - CENTERS[HALF] if wrong else np.zeros(3)
        for number, center in enumerate(CENTERS):
            name = f"{number}.png"
            image = pycolmap.Image(name=name, keypoints=self.pixels[number], camera_id=1, image_id=number + 1)
            moved = center + shift * (number >= HALF)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.column_stack([np.eye(3), -moved])))
        tracks: dict[tuple[int, bool], list[tuple[int, int]]] = {}
        for number, seen in enumerate(self.seen):
            for feature, point in enumerate(seen):
                # What does not look alike is seen at two places by the two halves.
                second = wrong and number >= HALF
                key = (-1 - int(self.looks[point]), False) if wrong and point < 200 else (int(point), second)
                tracks.setdefault(key, []).append((number, feature))
        for (point, second), features in tracks.items():
            track = pycolmap.Track()
            for number, feature in features:
                track.add_element(number + 1, feature)
            if len(features) > 1:
                at = self.points[-1 - point if point < 0 else point] + shift * second
                model.add_point3D(at, track, np.zeros(3, np.uint8))
        return model

    def write(self, path: Path, alone: int = -1) -> None:
        """A database of the features and of all matches, the true and the false ones, but for those of one photo."""
        model = self.model(wrong=False)
        with pycolmap.Database.open(path) as database:
            database.write_camera(self.camera, use_camera_id=True)
            for rig in model.rigs.values():
                database.write_rig(rig, use_rig_id=True)
            for frame in model.frames.values():
                database.write_frame(frame, use_frame_id=True)
            for image in model.images.values():
                database.write_image(image, use_image_id=True)
                database.write_keypoints(image.image_id, self.pixels[image.image_id - 1].astype(np.float32))
            for one, other in combinations(range(VIEWS), 2):
                looks = self.looks[self.seen[one]], self.looks[self.seen[other]]
                _, here, there = np.intersect1d(*looks, return_indices=True)
                if len(here) >= 15 and alone not in (one, other):
                    geometry = pycolmap.TwoViewGeometry()
                    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                    geometry.inlier_matches = np.column_stack([here, there]).astype(np.uint32)
                    database.write_matches(one + 1, other + 1, geometry.inlier_matches)
                    database.write_two_view_geometry(one + 1, other + 1, geometry)


@pytest.fixture
def corridor(tmp_path) -> Corridor:
    found = Corridor()
    found.write(tmp_path / "database.db")
    return found


def centers(model: pycolmap.Reconstruction) -> np.ndarray:
    return np.array([model.image(number + 1).projection_center() for number in range(VIEWS)])


def test_photos_that_were_joined_wrongly_are_put_where_their_neighbors_see_the_same(tmp_path, corridor):
    wrong = corridor.model(wrong=True)
    assert center_errors(centers(wrong), CENTERS).max() > 0.5
    torn = torn_links(tmp_path / "database.db", wrong)
    assert torn == [("3.png", "4.png")]
    assert rejoin(tmp_path / "database.db", tmp_path, wrong, tmp_path / "model")
    found = pycolmap.Reconstruction(tmp_path / "model")
    assert center_errors(centers(found), CENTERS).max() < 1e-3
    assert torn_links(tmp_path / "database.db", found) == []


@pytest.mark.parametrize("alone", [0, HALF, VIEWS - 1])
def test_a_photo_without_matches_stays_where_it_is(tmp_path, alone):
    corridor = Corridor()
    corridor.write(tmp_path / "database.db", alone)
    wrong = corridor.model(wrong=True)
    before = centers(wrong)[alone]
    assert rejoin(tmp_path / "database.db", tmp_path, wrong, tmp_path / "model")
    found = centers(pycolmap.Reconstruction(tmp_path / "model"))
    np.testing.assert_allclose(found[alone], before, atol=1e-9)
    assert center_errors(np.delete(found, alone, axis=0), np.delete(CENTERS, alone, axis=0)).max() < 1e-3


def test_a_model_that_its_matches_agree_with_is_left_alone(tmp_path, corridor):
    true = corridor.model(wrong=False)
    assert torn_links(tmp_path / "database.db", true) == []
    assert not rejoin(tmp_path / "database.db", tmp_path, true, tmp_path / "model")
    assert not (tmp_path / "model").exists()


def test_mapping_mends_what_it_has_joined_wrongly(tmp_path, corridor, monkeypatch):
    mapping = pycolmap.incremental_mapping

    def wrong_at_first(*args, **options):
        return mapping(*args, **options) if options.get("input_path") else {0: corridor.model(wrong=True)}

    monkeypatch.setattr(pycolmap, "incremental_mapping", wrong_at_first)
    free(tmp_path / "database.db")  # as features are extracted
    names = [f"{number}.png" for number in range(VIEWS)]
    structure = StructureFromMotion(tmp_path, [Pass(names, str(tmp_path))], tmp_path, SfmSettings(threads=1))
    structure.map(lambda *_: None, {})
    found = pycolmap.Reconstruction(tmp_path / MODEL)
    assert center_errors(centers(found), CENTERS).max() < 1e-2
    np.testing.assert_allclose(found.cameras[1].params[:2], 400, rtol=0.01)
    assert json.loads((tmp_path / TORN).read_text()) == []
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        assert database.read_camera(1).model.name == "OPENCV"


def test_joins_that_stay_wrong_are_named(caplog):
    warn_of_false_joins([("4.png", "5.png")], {"4.png": "c.jpg", "5.png": "d.jpg"})
    (record,) = caplog.records
    assert record.message.startswith("c.jpg and d.jpg show the same, and their poses contradict that")
