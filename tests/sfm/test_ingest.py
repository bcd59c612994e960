"""Photos and videos on their way into a dataset: order, orientation, formats, sizes, frames."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image
from small_captures import write

from ssa_nerfstudio.data.sources import read_source
from ssa_nerfstudio.sfm.ingest import expected_count, ingest


def gradient(width: int = 64, height: int = 48) -> np.ndarray:
    """Brighter to the right, redder to the bottom: tells how a photo is turned."""
    y, x = np.mgrid[:height, :width]
    return np.stack([255 * y / height, 255 * x / width, 0 * x], axis=-1).astype(np.uint8)


def brought_in(folder: Path, frames: int = 10) -> tuple[Path, list[str]]:
    dataset = folder.parent / "dataset"
    dataset.mkdir()
    source = read_source(folder, "frame", min_photos=1)
    calls: list[int] = []
    (photos,) = ingest(source, dataset, frames, lambda: calls.append(1))
    assert len(calls) == len(photos)
    assert len(photos) == expected_count(source, frames)
    return dataset, [photo.source for photo in photos]


def test_numbers_in_names_count_as_numbers(tmp_path):
    write(tmp_path / "photos", [gradient() + np.uint8(number) for number in range(12)])
    (tmp_path / "photos/.hidden.png").write_text("a file that a system put there")
    (tmp_path / "photos/notes.txt").write_text("not a photo")
    dataset, names = brought_in(tmp_path / "photos")
    assert names == [f"photo_{number}.png" for number in range(12)]
    for number, path in enumerate(sorted((dataset / "images").iterdir())):
        assert path.name == f"frame_{number + 1:05d}.png"
        assert path.read_bytes() == (tmp_path / f"photos/photo_{number}.png").read_bytes()


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_photos_are_stored_as_they_are_to_be_looked_at(suffix, orientation, tmp_path):
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    exif[ExifTags.Base.Make] = "maker"
    write(tmp_path / "photos", [gradient()] * 2, suffix, exif=exif)
    source = read_source(tmp_path / "photos", "frame", min_photos=1)
    dataset, _ = brought_in(tmp_path / "photos")
    stored = Image.open(dataset / f"images/frame_00001{suffix}")
    assert stored.getexif().get(ExifTags.Base.Orientation, 1) == 1
    assert stored.getexif()[ExifTags.Base.Make] == "maker"
    assert stored.size == (source.width, source.height) == ((48, 64) if orientation > 4 else (64, 48))
    # EXIF 2.3, table 6: change of red and green to the right, then downwards.
    picture = np.asarray(stored).astype(float)
    across = picture[:, -8:].mean(axis=(0, 1)) - picture[:, :8].mean(axis=(0, 1))
    down = picture[-8:].mean(axis=(0, 1)) - picture[:8].mean(axis=(0, 1))
    expected_signs = {1: (0, 1, 1, 0), 2: (0, -1, 1, 0), 3: (0, -1, -1, 0), 4: (0, 1, -1, 0)} | {
        5: (1, 0, 0, 1), 6: (-1, 0, 0, 1), 7: (-1, 0, 0, -1), 8: (1, 0, 0, -1)
    }  # fmt: skip
    found = np.sign(np.round(np.array([across[0], across[1], down[0], down[1]]) / 100))
    assert tuple(found) == expected_signs[orientation]


def test_photos_beyond_what_nerfstudio_trains_on_get_smaller_copies(tmp_path):
    write(tmp_path / "photos", [gradient(3300, 30)] * 1, ".jpg")
    dataset, _ = brought_in(tmp_path / "photos")
    sizes = {path.parent.name: Image.open(path).size for path in dataset.glob("images*/*.jpg")}
    assert sizes == {"images": (3300, 30), "images_2": (1650, 15), "images_4": (825, 7)}


def test_other_formats_are_converted(tmp_path):
    write(tmp_path / "photos", [gradient()], ".webp")
    write(tmp_path / "photos", [gradient()] * 2, ".tiff")
    dataset, names = brought_in(tmp_path / "photos")
    assert names == ["photo_0.tiff", "photo_0.webp", "photo_1.tiff"]
    assert sorted(path.suffix for path in (dataset / "images").iterdir()) == [".jpg", ".png", ".png"]
    np.testing.assert_array_equal(np.asarray(Image.open(dataset / "images/frame_00001.png")), gradient())


def write_video(path: Path, frames: int, sharp: set[int]) -> None:
    """Frame n of noise is n brighter; only the sharp ones are not blurred."""
    rng = np.random.default_rng(0)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (160, 96))
    assert writer.isOpened()
    for number in range(frames):
        picture = rng.integers(0, 120, (96, 160, 3), dtype=np.uint8) + np.uint8(number)
        writer.write(picture if number in sharp else cv2.GaussianBlur(picture, (0, 0), 3))
    writer.release()


def test_frames_are_evenly_spaced_and_sharp(tmp_path):
    (tmp_path / "videos").mkdir()
    write_video(tmp_path / "videos/a.avi", 100, {13, 34, 48, 78, 88})
    _, names = brought_in(tmp_path / "videos", frames=5)
    # 78 is in the fourth part of 20 frames but in its last quarter, which is too near to the next part's.
    numbers = [int(name.removeprefix("a.avi, frame ")) for name in names]
    assert numbers[:3] == [13, 34, 48]
    assert numbers[4] == 88
    assert np.diff(numbers).min() >= 10


def test_a_folder_of_videos_is_one_sequence_and_a_short_one_gives_all_its_frames(tmp_path):
    (tmp_path / "videos").mkdir()
    write_video(tmp_path / "videos/take_2.avi", 6, set())
    write_video(tmp_path / "videos/take_10.avi", 3, set())
    _, names = brought_in(tmp_path / "videos", frames=200)
    takes = [("take_2", number) for number in range(6)] + [("take_10", number) for number in range(3)]
    assert names == [f"{take}.avi, frame {number}" for take, number in takes]
