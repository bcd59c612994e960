"""Photos and videos in a folder: which are taken, and in which order."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from ssa_nerfstudio.data.sources import read_source, read_sources
from ssa_nerfstudio.data.video import Video
from ssa_nerfstudio.errors import InputError


def touch_photos(folder: Path, *names: str) -> Path:
    folder.mkdir(exist_ok=True)
    for name in names:
        Image.new("RGB", (64, 48)).save(folder / name)
    return folder


def write_video(path: Path, frames: int, size: tuple[int, int] = (64, 48)) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, size)
    assert writer.isOpened()
    for _ in range(frames):
        writer.write(np.zeros((size[1], size[0], 3), np.uint8))
    writer.release()


def test_numbers_in_names_count_as_numbers_and_other_files_are_passed_over(tmp_path):
    touch_photos(tmp_path, "b.png", "a_10.png", "a_9.png", ".hidden.png")
    (tmp_path / "notes.txt").write_text("not a photo")
    source = read_source(tmp_path, "frame", min_photos=3)
    assert [path.name for path in source.photos] == ["a_9.png", "a_10.png", "b.png"]
    assert (source.width, source.height, source.orientation) == (64, 48, 1)


def test_videos_beside_photos_are_skipped(tmp_path):
    touch_photos(tmp_path, "0.png", "1.png", "2.png")
    write_video(tmp_path / "1.avi", 3)
    source = read_source(tmp_path, "frame", min_photos=3)
    assert [path.name for path in source.skipped_videos] == ["1.avi"]
    assert len(source.photos) == 3


def test_frames_that_cannot_be_decoded_are_passed_over(tmp_path, monkeypatch):
    write_video(tmp_path / "a.avi", 12)
    video = Video.read(tmp_path / "a.avi")

    class Broken:
        """Every third frame is damaged."""

        def __init__(self, path: str) -> None:
            self.number = -1

        def grab(self) -> bool:
            self.number += 1
            return self.number < 12

        def retrieve(self) -> tuple[bool, np.ndarray | None]:
            damaged = self.number % 3 == 0
            return not damaged, None if damaged else np.full((48, 64, 3), self.number, np.uint8)

        def release(self) -> None:
            pass

    monkeypatch.setattr(cv2, "VideoCapture", Broken)
    numbers = [number for number, _ in video.sharpest(12)]
    assert numbers == [1, 2, 4, 5, 7, 8, 10, 11]


def test_another_file_or_a_changed_one_has_another_fingerprint(tmp_path):
    def fingerprint() -> list:
        return read_source(tmp_path, "frame", min_photos=1).fingerprint()

    touch_photos(tmp_path, "0.png", "1.png")
    former = fingerprint()
    assert fingerprint() == former
    (tmp_path / "1.png").unlink()
    assert fingerprint() != former
    Image.new("L", (64, 48)).save(tmp_path / "1.png")
    assert fingerprint() != former


def test_frames_are_taken_from_videos_by_their_length(tmp_path):
    write_video(tmp_path / "a.avi", 30)
    write_video(tmp_path / "b.avi", 10)
    frames = list(read_source(tmp_path, "frame", min_photos=1).video_frames(8))
    assert [video.path.name for video, _, _ in frames] == ["a.avi"] * 6 + ["b.avi"] * 2
    assert all(picture.shape == (48, 64, 3) for _, _, picture in frames)


def test_what_one_camera_cannot_have_taken_is_refused(tmp_path):
    touch_photos(tmp_path, "0.png", "1.png")
    with pytest.raises(InputError, match=r"holds 2 photos, 3 are needed; add more"):
        read_source(tmp_path, "frame", min_photos=3)
    Image.new("RGB", (48, 64)).save(tmp_path / "2.png")
    with pytest.raises(InputError, match=r"2.png is 48 x 64, 0.png is 64 x 48; remove 2.png, or use one folder for"):
        read_source(tmp_path, "frame", min_photos=3)


def test_each_subfolder_of_a_rig_is_a_camera(tmp_path):
    for camera, count in (("side 2", 3), ("front", 4)):
        touch_photos(tmp_path / camera, *(f"{number}.png" for number in range(count)))
    (tmp_path / "notes").mkdir()
    (tmp_path / ".cache").mkdir()
    touch_photos(tmp_path / ".cache", "0.png")
    sources = read_sources(tmp_path, "frame", min_photos=3)
    assert [(source.name, len(source.photos)) for source in sources] == [("front", 4), ("side_2", 3)]
    touch_photos(tmp_path / "side_2", "0.png", "1.png", "2.png")
    with pytest.raises(InputError, match="has the name of another camera"):
        read_sources(tmp_path, "frame", min_photos=3)


def test_photos_in_portrait_and_landscape_are_two_cameras(tmp_path):
    touch_photos(tmp_path, *(f"{number}.png" for number in range(4)))
    exif = Image.Exif()
    exif[0x0112] = 6
    for number in range(4, 7):
        Image.new("RGB", (64, 48)).save(tmp_path / f"{number}.png", exif=exif)
    landscape, portrait = read_sources(tmp_path, "frame", min_photos=3)
    assert [path.name for path in portrait.photos] == ["4.png", "5.png", "6.png"]
    assert (landscape.name, landscape.width, landscape.height) == ("landscape", 64, 48)
    assert (portrait.name, portrait.width, portrait.height, portrait.orientation) == ("portrait", 48, 64, 6)
    (tmp_path / "6.png").unlink()
    with pytest.raises(InputError, match=r"4.png has EXIF orientation 6, 0.png has 1"):
        read_sources(tmp_path, "frame", min_photos=3)


def test_the_photos_that_do_not_belong_are_named_not_another_camera(tmp_path):
    touch_photos(tmp_path, *(f"{number}.png" for number in (1, 4, 5, 6)))
    sizes = {0: (30, 70), 2: (48, 64), 3: (48, 64), 7: (48, 64), 8: (31, 70)}
    for number, size in sizes.items():
        Image.new("RGB", size).save(tmp_path / f"{number}.png")
    with pytest.raises(InputError, match=r"0.png is 30 x 70, 1.png is 64 x 48; remove 0.png, 8.png, or"):
        read_sources(tmp_path, "frame", min_photos=3)
    for number in (0, 8):
        (tmp_path / f"{number}.png").unlink()
    assert len(read_sources(tmp_path, "frame", min_photos=3)) == 2
    with pytest.raises(
        InputError, match=r"2.png is 48 x 64, 1.png is 64 x 48; use one .*, or remove 2.png, 3.png, 7.png"
    ):
        read_source(tmp_path, "front", min_photos=3)


@pytest.mark.parametrize(
    ("frames", "names"),
    [
        ([(64, 48, 1), (80, 60, 1)], ["64x48", "80x60"]),
        ([(64, 48, 1), (80, 60, 1), (64, 48, 6)], ["64x48", "80x60", "48x64"]),
        ([(64, 48, 1), (64, 48, 3)], ["64x48_exif1", "64x48_exif3"]),
        ([(64, 64, 1), (64, 48, 1)], ["square", "landscape"]),
    ],
)
def test_cameras_of_one_folder_are_called_by_what_tells_their_photos_apart(tmp_path, frames, names):
    for number, (width, height, orientation) in enumerate(frames * 3):
        exif = Image.Exif()
        exif[0x0112] = orientation
        Image.new("RGB", (width, height)).save(tmp_path / f"{number}.png", exif=exif)
    assert [source.name for source in read_sources(tmp_path, "frame", min_photos=3)] == names


def test_the_photos_of_one_camera_are_one_source(tmp_path):
    touch_photos(tmp_path, "0.png", "1.png", "2.png")
    (tmp_path / "thumbnails").mkdir()
    touch_photos(tmp_path / "thumbnails", "0.png")
    assert read_sources(tmp_path, "frame", 3) == [read_source(tmp_path, "frame", 3)]


def test_photos_further_down_are_pointed_at(tmp_path):
    (tmp_path / "card/DCIM/100MEDIA").mkdir(parents=True)
    touch_photos(tmp_path / "card/DCIM/100MEDIA", "0.png", "1.png", "2.png")
    with pytest.raises(InputError, match=r"holds no photo and no video .* give .*100MEDIA, which does"):
        read_sources(tmp_path / "card", "frame", 3)
