"""The warp between raw and undistorted frame, against nerfstudio's own."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from nerfstudio.cameras.camera_utils import get_distortion_params
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image
from PIL import Image

from ssa_nerfstudio.cameras.lens import Lens, distort, undistort, undistorted_lens

GOPRO_LIKE = Lens(212, 120, 110.0, 103.0, 106.0, 60.0, (-0.18, 0.024, 0, 0, 0.0005, 0.0008))


def by_nerfstudio(image: np.ndarray, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """nerfstudio's K [3, 3] (its own convention) and undistorted image."""
    kind = CameraType.FISHEYE if lens.model == "fisheye" else CameraType.PERSPECTIVE
    distortion = get_distortion_params(**dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), lens.distortion, strict=True)))
    camera = Cameras(
        torch.eye(4)[None, :3],
        *(lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height),
        distortion_params=distortion,
        camera_type=kind,
    )[0].reshape(())
    intrinsics = camera.get_intrinsics_matrices().numpy()
    matrix, warped, _ = _undistort_image(camera, distortion.numpy(), {}, image, intrinsics)
    return matrix, warped


def narrowest(lens: Lens) -> float:
    """Focal length of a frame whose longer side is 120 degrees wide."""
    return max(lens.width, lens.height) / 2 / np.tan(np.radians(60))


def check_against_nerfstudio(image: np.ndarray, lens: Lens) -> None:
    matrix, warped = by_nerfstudio(image, lens)
    if not np.isfinite(matrix).all() or not warped.size:
        with pytest.raises(ValueError, match=r"folds its frame|leaves no pixel"):
            undistort(image, lens)
        return
    if lens.model == "fisheye" and matrix[0, 0] < narrowest(lens):
        assert undistorted_lens(lens).fx == pytest.approx(narrowest(lens))
        return
    ours, target = undistort(image, lens), undistorted_lens(lens)
    assert np.array_equal(ours, warped)
    assert ours.shape[:2] == (target.height, target.width)
    stated = (target.fx, target.fy, target.cx, target.cy)
    assert stated == pytest.approx((matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]), rel=1e-6)


def gopro_walk(captures: Path) -> tuple[np.ndarray, Lens]:
    """Its first photo and its lens."""
    meta = json.loads((captures / "gopro_walk/transforms.json").read_text())
    distortion = tuple(meta.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    lens = Lens(*(meta[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")), distortion=distortion)
    return np.asarray(Image.open(captures / "gopro_walk" / meta["frames"][0]["file_path"])), lens


def test_real_photos_are_undistorted_as_by_nerfstudio(captures):
    photo, lens = gopro_walk(captures)
    check_against_nerfstudio(photo, lens)
    check_against_nerfstudio(photo.astype(np.float32) / 255, lens)


@settings(max_examples=30, deadline=None)
@given(
    size=st.tuples(st.integers(30, 120), st.integers(30, 120)),
    focal=st.floats(0.5, 2),
    center=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    coefficients=st.tuples(*[st.floats(-0.2, 0.2)] * 2, *[st.floats(-0.01, 0.01)] * 2),
    fisheye=st.booleans(),
)
def test_any_lens_undistorts_as_in_nerfstudio(size, focal, center, coefficients, fisheye):
    k1, k2, p1, p2 = coefficients
    (width, height), (x, y) = size, center
    middle = (width / 2 + x, height / 2 + y)
    focals = (focal * width, focal * width * 0.97)
    if fisheye:
        lens = Lens(width, height, *focals, *middle, (k1, k2, p1, p2, 0, 0), "fisheye")
    else:
        lens = Lens(width, height, *focals, *middle, (k1, k2, 0, 0, p1, p2))
    if lens.distorted:
        check_against_nerfstudio(np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8), lens)


def test_a_fisheye_that_folds_its_frame_is_refused():
    lens = Lens(30, 30, 15.0, 14.55, 15.0, 15.0, (0.0, -0.125, 0.0, 0.0, 0.0, 0.0), "fisheye")
    with pytest.raises(ValueError, match="folds its frame"):
        undistorted_lens(lens)


FISHEYES = {
    "ideal, 180 degrees": (64 / (np.pi / 2), 0.0),
    "ideal, 90 degrees": (64 / (np.pi / 4), 0.0),
    "195 degrees": (34.0, 0.02),
    "200 degrees, compressed at the rim": (42.0, -0.05),
}


def directions(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Angle from the axis, and direction [H, W, 3], of each pixel of a fisheye with k1 alone, from its definition."""
    y, x = np.mgrid[: lens.height, : lens.width] + 0.5
    x, y = (x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy
    radius, k1 = np.hypot(x, y), lens.distortion[0]
    grid = np.linspace(0, np.pi, 20001)
    grid = grid[: int(np.argmax(np.diff(grid + k1 * grid**3) <= 0)) or len(grid)]
    theta = np.interp(radius, grid + k1 * grid**3, grid, right=np.pi)
    scale = np.sin(theta) / radius
    return theta, np.stack([x * scale, y * scale, np.cos(theta)], axis=-1).astype(np.float32)


@pytest.mark.parametrize("name", FISHEYES)
def test_undistorted_fisheyes_are_perspective_photos_of_at_most_120_degrees(name):
    """Photos whose colors are their directions; nerfstudio takes ideal ones for perspective photos as they are."""
    focal, k1 = FISHEYES[name]
    lens = Lens(128, 128, focal, focal, 64, 64, (k1, 0, 0, 0, 0, 0), "fisheye")
    target = undistorted_lens(lens)
    seen = undistort(directions(lens)[1], lens)
    y, x = np.mgrid[: target.height, : target.width] + 0.5
    rays = np.stack([(x - target.cx) / target.fx, (y - target.cy) / target.fy, np.ones_like(x)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    assert np.abs(seen - rays)[2:-2, 2:-2].max() < 0.02
    assert target.fx >= narrowest(lens) * (1 - 1e-9)
    assert target.model == "perspective"
    assert not target.distorted


@pytest.mark.parametrize("name", FISHEYES)
def test_what_lies_beyond_the_undistorted_frame_is_not_known(name):
    """Beyond 90 degrees as well, where OpenCV mirrors positions."""
    focal, k1 = FISHEYES[name]
    lens = Lens(128, 128, focal, focal, 64, 64, (k1, 0, 0, 0, 0, 0), "fisheye")
    target = undistorted_lens(lens)
    known = distort(np.ones((target.height, target.width), np.float32), lens, 0.0) > 0.999
    x, y, z = np.moveaxis(directions(lens)[1], -1, 0)
    with np.errstate(divide="ignore"):
        across, down = np.abs(x / z) * target.fx, np.abs(y / z) * target.fy
    inside = (z > 0) & (across < 61) & (down < 61)
    outside = (z <= 0) | (across > 66) | (down > 66)
    assert known[inside].all()
    assert not known[outside].any()


def test_without_distortion_the_image_is_returned():
    lens = Lens(20, 10, 30, 30, 9, 4)
    image = np.random.default_rng(0).random((10, 20, 3), dtype=np.float32)
    assert undistorted_lens(lens) == lens
    assert undistort(image, lens) is image
    assert distort(image, lens, fill=0.0) is image


@pytest.mark.parametrize("model", ["perspective", "fisheye"])
def test_distort_is_the_inverse_of_undistort(model):
    lens = Lens(212, 120, 110.0, 103.0, 106.0, 60.0, (-0.1, 0.01, 0, 0, 0, 0), model)
    y, x = np.mgrid[:120, :212].astype(np.float32)
    smooth = np.stack([np.sin(x / 20), np.cos(y / 15), np.ones_like(x)], axis=-1)
    back = distort(undistort(smooth, lens), lens, fill=np.nan)
    # Where both warps had four pixels to interpolate between.
    known = back[..., 2] > 0.999
    assert known.mean() > 0.7
    assert np.abs(back - smooth)[known].max() < 0.01


@pytest.mark.parametrize("channels", [(), (1,), (2,), (3,), (4,)])
@pytest.mark.parametrize("model", ["perspective", "fisheye"])
def test_both_warps_keep_the_channels(channels, model):
    lens = Lens(53, 30, 28.0, 26.0, 26.0, 15.0, (-0.1, 0.01, 0, 0, 0, 0), model)
    target = undistorted_lens(lens)
    raw = np.random.default_rng(0).random((30, 53, *channels), dtype=np.float32)
    straight = undistort(raw, lens)
    assert straight.shape == (target.height, target.width, *channels)
    assert distort(straight, lens, fill=0.0).shape == raw.shape


def test_a_cropped_corner_is_filled():
    target = undistorted_lens(GOPRO_LIKE)
    ones = np.ones((target.height, target.width, 3), np.float32)
    raw = distort(ones, GOPRO_LIKE, fill=0.5)
    assert raw[60, 106] == pytest.approx([1, 1, 1])
    assert raw[0, 0] == pytest.approx([0.5, 0.5, 0.5])


def test_premultiplied_layers_warp_correctly_and_straight_color_does_not():
    """Why the layers are premultiplied: a white disc on black ground keeps its edge white."""
    y, x = np.mgrid[:120, :212]
    matte = (np.hypot(x - 40, y - 40) < 20).astype(np.float32)[..., None]
    addition = np.repeat(matte, 3, axis=2)
    warped_matte, warped = undistort(1 - addition, GOPRO_LIKE), undistort(addition, GOPRO_LIKE)
    edge = (warped_matte > 0.1) & (warped_matte < 0.9)
    assert edge.any()
    assert np.allclose(warped[edge] / (1 - warped_matte[edge]), 1, atol=1e-5)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"width": 0}, "at least 1 x 1"),
        ({"fx": float("nan")}, "finite"),
        ({"distortion": (0.1,)}, "k1, k2, k3, k4, p1, p2"),
        ({"distortion": (0.1, 0, 0, 0.2, 0, 0)}, "no perspective camera with k4"),
    ],
)
def test_invalid_lenses_are_refused(fields, message):
    stated = {"width": 20, "height": 10, "fx": 30.0, "fy": 30.0, "cx": 9.0, "cy": 4.0} | fields
    with pytest.raises(ValueError, match=message):
        Lens(**stated)


def test_images_of_another_size_are_refused():
    with pytest.raises(ValueError, match="image is 5 x 4, the lens' frame 212 x 120"):
        undistort(np.zeros((4, 5, 3), np.uint8), GOPRO_LIKE)
    with pytest.raises(ValueError, match="image is 212 x 120, the lens' frame"):
        distort(np.zeros((120, 212, 3), np.uint8), GOPRO_LIKE, fill=0.0)
