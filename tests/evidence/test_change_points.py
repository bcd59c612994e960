"""Change points on synthetic captures: found to the view where an artifact changes, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ssa_nerfstudio.evidence.brightness import MAX_FINE_BLOCKS
from ssa_nerfstudio.evidence.change_points import change_points
from ssa_nerfstudio.evidence.detection import MIN_VIEWS
from ssa_nerfstudio.evidence.interval_detection import detect_in_intervals
from ssa_nerfstudio.evidence.statistics import accumulate

HEIGHT, WIDTH = 72, 96


def capture(views: int, seed: int = 0) -> list[np.ndarray]:
    """Photos of a textured wall, uint8, from a camera that walks along it."""
    rng = np.random.default_rng(seed)
    noise = [np.kron(rng.random((n, n, 3)), np.ones((512 // n, 512 // n, 1))) for n in (4, 16, 64, 512)]
    wall = np.mean(noise, axis=0)
    angles = np.linspace(0, 2 * np.pi, views) + rng.normal(0, 0.05, views)
    corners = np.stack([200 + 150 * np.sin(angles), 200 + 150 * np.cos(3 * angles)], axis=1).astype(int)
    return [(wall[y : y + HEIGHT, x : x + WIDTH] * 255).round().astype(np.uint8) for y, x in corners]


def logo(photo: np.ndarray, row: int = 20) -> np.ndarray:
    """Bright bars, half transparent."""
    photo = photo.copy()
    for x in range(12, 84, 10):
        bar = photo[row : row + 16, x : x + 5]
        bar[:] = (bar * 0.4 + 255 * 0.6).astype(np.uint8)
    return photo


def found(photos: list[np.ndarray], seed: int = 0) -> list[int]:
    """With the fewest draws that can be significant."""
    return change_points(accumulate((torch.from_numpy(photo), None) for photo in photos), draws=100, seed=seed)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("views", [12, 30, 100])
def test_nothing_changes_without_an_artifact_or_behind_one(views, seed):
    photos = capture(views, seed)
    assert found(photos, seed=seed) == []
    assert found([logo(photo) for photo in photos], seed=seed) == []


@pytest.mark.parametrize(("views", "at"), [(24, 12), (50, 17), (100, 61), (200, 83)])
def test_an_artifact_that_appears_is_located(views, at):
    photos = capture(views)
    (cut,) = found(photos[:at] + [logo(photo) for photo in photos[at:]])
    assert abs(cut - at) <= max(0, views // MAX_FINE_BLOCKS - 1)


@pytest.mark.parametrize("first", [True, False])
def test_an_artifact_that_passes_is_located_be_there_another_before_or_not(first):
    photos = capture(60)
    before = [logo(photo) for photo in photos[:20]] if first else photos[:20]
    assert found(before + [logo(photo, row=45) for photo in photos[20:40]] + photos[40:]) == [20, 40]


def test_a_camera_that_rests_is_no_interval():
    photos = capture(48)
    rng = np.random.default_rng(0)
    for number in range(32, 48):
        photos[number] = (photos[32] + rng.normal(0, 2, photos[32].shape)).clip(0, 255).astype(np.uint8)
    assert found(photos) == []


def test_a_darker_scene_behind_an_artifact_is_no_change():
    """The edges of what hides lose contrast with the scene."""
    photos = capture(40)
    for number, photo in enumerate(photos):
        photo[:] = photo * (1.0 if number < 20 else 0.6)
        photo[40:, 30:60] //= 8
    assert found(photos) == []


def test_grain_that_a_video_encodes_anew_at_a_keyframe_is_no_change():
    """A textured strip stands still; its weakest details differ before and after, and vary in neither."""
    photos, rng = capture(60), np.random.default_rng(1)
    strip = np.kron(rng.integers(40, 200, (12, 48, 1)), np.ones((2, 2, 1)))
    grain = rng.integers(-9, 10, (2, 24, WIDTH, 1))
    for number, photo in enumerate(photos):
        photo[48:] = strip + grain[int(number >= 12)]
    assert found(photos) == []
    for number, photo in enumerate(photos):  # the same strip, mirrored: another artifact
        photo[48:] = (strip if number < 12 else strip[:, ::-1]) + grain[0]
    assert found(photos) == [12]


def test_short_captures_and_short_flashes_have_no_change_points():
    photos = capture(2 * MIN_VIEWS - 1)
    assert found(photos[:6] + [logo(photo) for photo in photos[6:]]) == []
    photos = capture(60)
    flash = photos[:30] + [logo(p) for p in photos[30:34]] + photos[34:]
    assert found(flash) == []


def test_the_scan_is_reproducible_and_leaves_global_random_state_alone():
    photos = capture(30)
    shown = photos[:15] + [logo(photo) for photo in photos[15:]]
    before = torch.get_rng_state()
    assert found(shown) == found(shown) == [15]
    assert torch.equal(before, torch.get_rng_state())


def test_masked_pixels_are_no_change():
    """What a mask hides in the second half is unknown there, not gone."""
    photos = [logo(photo) for photo in capture(40)]
    seen = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    hidden = seen.clone()
    hidden[15:40] = False
    views = ((torch.from_numpy(p), seen if number < 20 else hidden) for number, p in enumerate(photos))
    assert change_points(accumulate(views)) == []


def test_each_interval_has_its_own_verdict_and_photos_are_read_again_only_where_something_changes():
    photos = capture(40)
    reads = []

    def stream(shown):
        reads.append(len(shown))
        return (torch.from_numpy(photo) for photo in shown)

    assert detect_in_intervals(lambda: stream(photos), draws=100).intervals == ()
    assert reads == [40]
    half = photos[:20] + [logo(photo) for photo in photos[20:]]
    detection = detect_in_intervals(lambda: stream(half), draws=100)
    assert reads == [40, 40, 40]
    assert [(part.first, part.end, part.verdict) for part in detection.intervals] == [
        (0, 20, "none"),
        (20, 40, "faint"),
    ]
    assert detection.verdict == "faint"
    assert detection.views == 40
    assert detection.mask[20:36, 12:84].float().mean() > 0.5
    assert not detection.mask[45:].any()


@pytest.mark.parametrize("values", [1, 10_000])
def test_intervals_are_compared_in_groups_of_any_size(monkeypatch, values):
    """One by one, and a few at a time; all of this small capture are one group otherwise."""
    photos = capture(28)
    shown = photos[:18] + [logo(photo) for photo in photos[18:]]
    monkeypatch.setattr("ssa_nerfstudio.evidence.change_points.VALUES_AT_ONCE", values)
    assert found(shown) == [18]
