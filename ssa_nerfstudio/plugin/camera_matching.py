"""nerfstudio's cameras and the camera groups they belong to (`cameras.groups`)."""

from __future__ import annotations

import logging

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from ssa_nerfstudio.cameras.groups import group_frames, same_intrinsics
from ssa_nerfstudio.cameras.lens import Lens, distort, undistorted_lens

_LOG = logging.getLogger(__name__)

LENS_VALUES = 13
"""width, height, fx, fy, cx, cy, k1, k2, k3, k4, p1, p2, and the number of nerfstudio's camera type."""


def group_cameras(cameras: Cameras) -> tuple[Tensor, list[int]]:
    """Sort cameras into groups with an overlay each, in order of first appearance.

    Returns:
        keys [G, 6] float64 (width, height, fx, fy, cx, cy of each group's first camera), and each camera's group.
    """
    described = describe(cameras)
    groups = group_frames(described.numpy())
    return torch.stack([described[groups.index(g)] for g in range(max(groups) + 1)]), groups


def match_camera(camera: Cameras, keys: list[list[float]]) -> int | None:
    """The group whose frame a camera has: same size and intrinsics, else same size, else None (a free viewpoint)."""
    described = describe(camera)[0]
    candidates = [g for g, key in enumerate(keys) if key[:2] == described[:2].tolist()]
    for g in candidates:
        if same_intrinsics(described.numpy(), np.array(keys[g])):
            return g
    return candidates[0] if candidates else None


def find_frame(key: Tensor, keys: Tensor) -> int | None:
    """Row of keys [G, 6] with a camera's [6] frame size and the nearest intrinsics; None without one of its size."""
    same_size = (keys[:, :2] == key[:2]).all(dim=1)
    if not same_size.any():
        return None
    return int(torch.where(same_size, (keys - key).abs().amax(dim=1), torch.inf).argmin())


def nearest_aspect(camera: Cameras, keys: list[list[float]]) -> int:
    """The group whose aspect is that of a free viewpoint (within 1 %), or the first."""
    width, height = describe(camera)[0, :2].tolist()
    for g, key in enumerate(keys):
        if abs(width / height - key[0] / key[1]) < 0.01 * width / height:
            return g
    return 0


def describe_lenses(cameras: Cameras) -> Tensor:
    """Raw cameras, before nerfstudio undistorts their photos, for a checkpoint: [N, LENS_VALUES] float64 on the CPU."""
    frames = describe(cameras)
    distortion = cameras.distortion_params
    if distortion is None:
        distortion = torch.zeros(len(frames), 6)
    kinds = cameras.camera_type.reshape(-1, 1)
    return torch.cat([frames, distortion.reshape(-1, 6).to("cpu", torch.float64), kinds.to("cpu", torch.float64)], 1)


def lens(described: list[float]) -> Lens:
    """The lens of one row of `describe_lenses`.

    Raises:
        ValueError: the camera's type is neither perspective nor fisheye, and it has distortion.
    """
    width, height, fx, fy, cx, cy, *distortion, kind = described
    if kind == CameraType.FISHEYE.value:
        return Lens(int(width), int(height), fx, fy, cx, cy, tuple(distortion), "fisheye")
    if kind != CameraType.PERSPECTIVE.value and any(distortion):
        raise ValueError(f"photos of camera type {CameraType(int(kind)).name} cannot be mapped back to their raw frame")
    return Lens(int(width), int(height), fx, fy, cx, cy, tuple(distortion))


def fisheye_lenses(cameras: Cameras) -> dict[int, Lens]:
    """The lenses of those cameras that are fisheye ones, by the camera's number."""
    described = describe_lenses(cameras).tolist()
    return {number: lens(row) for number, row in enumerate(described) if row[-1] == CameraType.FISHEYE.value}


def describe(cameras: Cameras) -> Tensor:
    """width, height, fx, fy, cx, cy of each camera: [N, 6] float64 on the CPU."""
    fields = (cameras.width, cameras.height, cameras.fx, cameras.fy, cameras.cx, cameras.cy)
    return torch.stack([f.reshape(-1).to("cpu", torch.float64) for f in fields], dim=-1)


def tell_of_fisheyes(cameras: Cameras) -> None:
    """Warn of what the undistortion of fisheye photos leaves out."""
    for raw in list(fisheye_lenses(cameras).values())[:1]:
        target = undistorted_lens(raw)
        angle = 2 * np.degrees(np.arctan(target.width / 2 / target.fx))
        left = distort(np.ones((target.height, target.width), np.float32), raw, 0.0).mean()
        _LOG.warning(
            f"fisheye photos are undistorted: training sees {angle:.0f} degrees across, {left:.0%} of their pixels. "
            "gsplat 1.4.0 draws fisheye lenses without distortion alone"
        )
