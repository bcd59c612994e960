"""Lenses: the undistortion of photos (warp, crop, intrinsics) and its inverse.

It is nerfstudio's, except for fisheye lenses. nerfstudio takes photos of ideal ones for perspective ones, and of those
wider than `WIDEST` it spends most of the frame on the rim, beyond 180 degrees all of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np

from ssa_nerfstudio.errors import InputError

WIDEST = 120.0
"""Angle of view, in degrees, that the longer side of an undistorted fisheye frame has at most."""
_AGREES = 0.5
"""Pixels within which a position has to come back when it is undistorted and distorted again."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics of one camera as in nerfstudio's transforms.json; (0, 0) is the outer corner of the first pixel.

    Raises:
        InputError: the size is not positive, a value is not finite, or nerfstudio cannot undistort such a lens.
    """

    width: int
    """Frame width, pixels."""
    height: int
    """Frame height, pixels."""
    fx: float
    """Focal length along x, pixels."""
    fy: float
    """Focal length along y, pixels."""
    cx: float
    """Principal point, pixels from the left edge."""
    cy: float
    """Principal point, pixels from the upper edge."""
    distortion: tuple[float, ...] = (0.0,) * 6
    """k1, k2, k3, k4, p1, p2; a perspective camera has k4 = 0, a fisheye uses k1 to k4."""
    model: Literal["perspective", "fisheye"] = "perspective"
    """OpenCV's pinhole model (transforms.json: OPENCV and simpler ones) or its fisheye (OPENCV_FISHEYE)."""

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise InputError(f"frame must be at least 1 x 1 pixels, got {self.width} x {self.height}")
        if not np.isfinite([self.fx, self.fy, self.cx, self.cy, *self.distortion]).all():
            raise InputError("intrinsics must be finite")
        if len(self.distortion) != 6:
            raise InputError(f"distortion must be k1, k2, k3, k4, p1, p2, got {len(self.distortion)} values")
        if self.model == "perspective" and self.distortion[3] != 0:
            raise InputError(f"nerfstudio undistorts no perspective camera with k4, got {self.distortion[3]}")

    @property
    def distorted(self) -> bool:
        """Whether photos of this lens are undistorted: all but those of a perspective lens without coefficients."""
        # In float32, as nerfstudio stores them.
        return self.model == "fisheye" or bool(np.any(np.asarray(self.distortion, dtype=np.float32)))

    @property
    def matrix(self) -> np.ndarray:
        """K [3, 3] float32 in OpenCV's convention, where (0, 0) is the center of the first pixel."""
        matrix = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float32)
        # In float32 like nerfstudio, so that the crop is the same to the pixel.
        matrix[:2, 2] = matrix[:2, 2] - 0.5
        return matrix

    @property
    def coefficients(self) -> np.ndarray:
        """Distortion in OpenCV's order: k1, k2, p1, p2, k3, k4, 0, 0 (perspective) or k1 to k4 (fisheye)."""
        k1, k2, k3, k4, p1, p2 = (float(np.float32(value)) for value in self.distortion)
        return np.array([k1, k2, k3, k4] if self.model == "fisheye" else [k1, k2, p1, p2, k3, k4, 0, 0])


def undistorted_lens(lens: Lens) -> Lens:
    """The lens of the undistorted and cropped frame, as nerfstudio 1.1.5 computes it (`_undistort_image`).

    Perspective: `cv2.getOptimalNewCameraMatrix` with alpha 0, cropped to its region of interest. Fisheye:
    `cv2.fisheye.estimateNewCameraMatrixForUndistortRectify` with balance 0, not cropped; where that is wider than
    `WIDEST`, so wide around the optical axis.
    """
    return _target(lens)[0]


def undistort(image: np.ndarray, lens: Lens) -> np.ndarray:
    """Warp an image from the raw to the undistorted frame, bilinearly.

    Warp an artifact's T and B = A W, not its straight color. Without distortion the image itself is returned.

    Args:
        image: uint8 or float32 [H, W, C] or [H, W] of the lens' size.
        lens: the raw frame's lens.

    Returns:
        [H', W', C] or [H', W'] of `undistorted_lens(lens)`'s size; 0 outside the raw frame, where photos are black too.

    Raises:
        InputError: the image is not of the lens' size.
    """
    _check_size(image, lens)
    if not lens.distorted:
        return image
    target, matrix, (x, y) = _target(lens)
    if lens.model == "fisheye":
        maps = cv2.fisheye.initUndistortRectifyMap(
            lens.matrix, lens.coefficients, np.eye(3), matrix, (lens.width, lens.height), cv2.CV_32FC1
        )
        return _with_channels(cv2.remap(image, *maps, interpolation=cv2.INTER_LINEAR), image)
    warped = _with_channels(cv2.undistort(image, lens.matrix, lens.coefficients, None, matrix), image)
    return np.ascontiguousarray(warped[y : y + target.height, x : x + target.width])


def distort(image: np.ndarray, lens: Lens, fill: float) -> np.ndarray:
    """Warp an image from the undistorted to the raw frame, bilinearly: the inverse of `undistort`.

    Args:
        image: uint8 or float32 [H', W', C] or [H', W'] of `undistorted_lens(lens)`'s size.
        lens: the raw frame's lens.
        fill: value outside the undistorted frame: 1 for T and 0 for B keep the photo there.

    Returns:
        [H, W, C] or [H, W], like the image, of the lens' size.

    Raises:
        InputError: the image is not of the undistorted size.
    """
    if not lens.distorted:
        _check_size(image, lens)
        return image
    target, matrix, (x, y) = _target(lens)
    _check_size(image, target)
    pixels = np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), axis=-1).reshape(-1, 1, 2)
    pixels = pixels.astype(np.float64)
    if lens.model == "fisheye":
        rays = cv2.fisheye.undistortPoints(pixels, lens.matrix, lens.coefficients, np.eye(3), matrix)
        rays[~_comes_back(rays, pixels, lens, matrix)] = -2  # outside
    else:
        precise = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-6)
        rays = cv2.undistortPointsIter(pixels, lens.matrix, lens.coefficients, np.eye(3), matrix, precise)
    positions = (rays.reshape(lens.height, lens.width, 2) - (x, y)).astype(np.float32)
    border = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": (fill,) * 4}
    warped = cv2.remap(image, positions, None, interpolation=cv2.INTER_LINEAR, **border)  # type: ignore[call-overload]
    return _with_channels(warped, image)


def _comes_back(rays: np.ndarray, pixels: np.ndarray, lens: Lens, matrix: np.ndarray) -> np.ndarray:
    """Whether undistorted positions [N, 1, 2] are those of the pixels [N, 1, 2]: OpenCV mirrors those beyond 90 degrees
    and stops short of some others. bool [N]."""
    ahead = (rays - matrix[:2, 2]) / np.diag(matrix)[:2]
    again = cv2.fisheye.distortPoints(ahead, lens.matrix, lens.coefficients)
    return (np.abs(again - pixels) < _AGREES).all(axis=(1, 2))


@lru_cache(maxsize=256)
def _target(lens: Lens) -> tuple[Lens, np.ndarray, tuple[int, int]]:
    """The undistorted camera, its K [3, 3] before the crop (OpenCV's convention), and the crop's corner (x, y)."""
    if not lens.distorted:
        return lens, lens.matrix, (0, 0)
    width, height, x, y = lens.width, lens.height, 0, 0
    if lens.model == "fisheye":
        matrix = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
            lens.matrix, lens.coefficients, (width, height), np.eye(3), balance=0
        )
        narrowest = max(width, height) / 2 / np.tan(np.radians(WIDEST) / 2)
        if matrix[0, 0] < narrowest:
            middle = [(width - 1) / 2, (height - 1) / 2, 1]
            matrix = np.array([[narrowest, 0, 0], [0, narrowest * lens.fy / lens.fx, 0], middle]).T
    else:
        matrix, (x, y, width, height) = cv2.getOptimalNewCameraMatrix(
            lens.matrix, lens.coefficients, (width, height), 0
        )
    if width < 1 or height < 1:
        raise InputError(f"undistorting with {lens.distortion} leaves no pixel of {lens.width} x {lens.height}")
    if not np.isfinite(matrix).all():
        # OpenCV returns NaN for a fisheye whose angle is not monotonic within the frame.
        raise InputError(f"a lens with distortion {lens.distortion} folds its frame and cannot be undistorted")
    target = Lens(
        width=width,
        height=height,
        fx=float(matrix[0, 0]),
        fy=float(matrix[1, 1]),
        cx=float(matrix[0, 2]) - x + 0.5,
        cy=float(matrix[1, 2]) - y + 0.5,
    )
    return target, matrix, (x, y)


def _with_channels(warped: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Restore the last dimension of [H, W, 1], which OpenCV drops."""
    return warped.reshape(*warped.shape[:2], *image.shape[2:])


def _check_size(image: np.ndarray, lens: Lens) -> None:
    if image.shape[:2] != (lens.height, lens.width):
        raise InputError(f"image is {image.shape[1]} x {image.shape[0]}, the lens' frame {lens.width} x {lens.height}")
