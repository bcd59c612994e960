"""The image decoder: which pixels it gives, and what it refuses."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import ExifTags, Image

from ssa_nerfstudio.data.photos import check_mask, load_photo, open_photo, read_gray, read_photo, write_photo
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.datamanager import PhotoDataset

WIDTH, HEIGHT = 37, 23


def save(path: Path, mode: str = "RGB", **options) -> Path:
    rng = np.random.default_rng(0)
    noise = cv2.resize(rng.integers(0, 256, (6, 9, 4), dtype=np.uint8), (WIDTH, HEIGHT))
    shape = {"RGB": noise[..., :3], "L": noise[..., 0], "RGBA": noise}
    image = Image.fromarray(shape[mode]) if mode in shape else Image.fromarray(noise[..., :3]).convert(mode)
    image.save(path, **options)
    return path


@pytest.mark.parametrize("mode", ["RGB", "L"])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_pixels_are_opencvs(mode, suffix, tmp_path):
    """Another decoder of the same formats; gray is the JPEG's stored luma."""
    path = save(tmp_path / f"a{suffix}", mode)
    np.testing.assert_array_equal(read_photo(path), cv2.imread(str(path), cv2.IMREAD_COLOR)[..., ::-1])
    gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    rounding = 1 if (mode, suffix) == ("RGB", ".png") else 0
    assert np.abs(read_gray(path).astype(int) - gray).max() <= rounding


def test_arrays_can_be_written_to(tmp_path):
    for mode in ("RGB", "L", "RGBA"):
        read_photo(save(tmp_path / "a.png", mode), alpha=True)[:] = 0


def test_the_orientation_is_followed_only_where_it_is_asked_for(tmp_path):
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    path = save(tmp_path / "a.png", exif=exif)
    raw = read_photo(path, size=(WIDTH, HEIGHT))
    np.testing.assert_array_equal(read_photo(path, size=(HEIGHT, WIDTH), upright=True), np.rot90(raw, -1))


def test_exif_data_are_kept(tmp_path):
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "maker"
    for suffix in (".png", ".jpg", ".tiff"):
        assert load_photo(save(tmp_path / f"a{suffix}", exif=exif)).getexif()[ExifTags.Base.Make] == "maker"


def test_opaque_alpha_is_dropped_and_transparent_pixels_are_refused(tmp_path):
    write_photo(tmp_path / "new" / "a.png", np.full((4, 5, 3), 7, np.uint8))
    Image.open(tmp_path / "new" / "a.png").convert("RGBA").save(tmp_path / "opaque.png")
    np.testing.assert_array_equal(read_photo(tmp_path / "opaque.png"), np.full((4, 5, 3), 7))
    path = save(tmp_path / "transparent.png", "RGBA")
    with pytest.raises(InputError, match=r"transparent.png has transparent pixels; convert it to 8-bit RGB"):
        read_photo(path)
    assert read_photo(path, alpha=True).shape == (HEIGHT, WIDTH, 4)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "a.png does not exist"),
        (lambda path: path.write_text("text"), "a.png cannot be read as a photo"),
        (lambda path: path.mkdir(), "a.png cannot be read as a photo"),
        (lambda path: path.write_bytes(save(path).read_bytes()[:-40]), "a.png cannot be read as a photo"),
        (lambda path: save(path, "P"), "a.png is of mode P; convert it to 8-bit RGB"),
        (lambda path: save(path, "LA"), "a.png is of mode LA"),
        (lambda path: save(path, "1"), "a.png is of mode 1"),
        (lambda path: save(path, "CMYK", format="TIFF"), "a.png is of mode CMYK"),
        (lambda path: Image.new("I;16", (WIDTH, HEIGHT)).save(path), "a.png is of mode I;16"),
        (save, "a.png is 37 x 23, expected 5 x 4"),
    ],
)
def test_what_is_wrong_with_a_photo_is_named(make, message, tmp_path):
    path = tmp_path / "a.png"
    make(path)
    with pytest.raises(InputError, match=message):
        read_photo(path, size=(5, 4))


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.3])
@pytest.mark.parametrize(
    ("mode", "suffix"), [("RGB", ".png"), ("L", ".png"), ("RGBA", ".png"), ("RGB", ".jpg"), ("L", ".jpg")]
)
def test_nerfstudios_dataset_gives_the_same_pixels(mode, scale, suffix, tmp_path):
    path = save(tmp_path / f"a{suffix}", mode)
    cameras = Cameras(torch.eye(4)[None, :3], 30.0, 30.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    outputs = SimpleNamespace(image_filenames=[path], cameras=cameras, scene_box=None, metadata={}, alpha_color=None)
    ours, theirs = (dataset(outputs, scale) for dataset in (PhotoDataset, InputDataset))  # pyright: ignore[reportArgumentType]
    np.testing.assert_array_equal(ours.get_numpy_image(0), theirs.get_numpy_image(0))


def stated_as(path: Path, width: int, height: int) -> Path:
    """A PNG whose header states another size than its pixels have."""
    content = bytearray(save(path).read_bytes())
    content[16:24] = struct.pack(">II", width, height)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    path.write_bytes(content)
    return path


def test_the_largest_photos_of_real_cameras_are_photos(tmp_path, recwarn):
    with open_photo(stated_as(tmp_path / "a.png", 20_000, 12_000)) as image:
        assert image.size == (20_000, 12_000)
    assert not recwarn.list


@pytest.mark.parametrize(("width", "height"), [(25_000, 20_001), (100_000, 100_000), (2**31 - 1, 1), (2**31 - 1,) * 2])
def test_photos_beyond_every_camera_are_refused_before_they_are_decoded(width, height, tmp_path):
    path = stated_as(tmp_path / "a.png", width, height)
    with pytest.raises(InputError, match=r"more than 500 megapixels|exceeds limit"):
        read_photo(path)


@pytest.mark.parametrize(("mode", "complaint"), [("RGB", "mode RGB"), ("P", "mode P"), ("RGBA", "mode RGBA")])
def test_masks_of_several_channels_are_named(mode, complaint, tmp_path):
    with pytest.raises(InputError, match=rf"a.png is of {complaint}; convert it to 8-bit gray"):
        check_mask(save(tmp_path / "a.png", mode), (WIDTH, HEIGHT))


def test_masks_of_one_channel_and_the_photos_size_are_taken(tmp_path):
    for mode in ("L", "1"):
        check_mask(save(tmp_path / "a.png", mode), (WIDTH, HEIGHT))
    with pytest.raises(InputError, match=r"a\.png is 37 x 23, expected 5 x 4"):
        check_mask(tmp_path / "a.png", (5, 4))
