"""Which cameras share an artifact: those of one frame size and one set of intrinsics."""

from __future__ import annotations

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

SAME_INTRINSICS = 1e-3
"""Focal lengths and principal points closer than this (relative to the frame's width) are one camera's."""


def group_cameras(cameras: Cameras) -> tuple[Tensor, list[int]]:
    """Sort cameras into groups that each get an overlay of their own, in order of first appearance.

    A rig's cameras differ in their intrinsics and are kept apart. Where structure-from-motion gave every photo
    intrinsics of its own (more than half of the groups would hold a single view), they tell nothing, and photos of one
    size form one group.

    Returns:
        keys [G, 6] float64 (width, height, fx, fy, cx, cy of each group's first camera), and each camera's group.
    """
    described = describe(cameras)
    keys, groups = _group(described, by_intrinsics=True)
    if len(keys) > 1 and sum(groups.count(g) == 1 for g in range(len(keys))) > len(keys) / 2:
        keys, groups = _group(described, by_intrinsics=False)
    return torch.stack(keys), groups


def match_camera(camera: Cameras, keys: list[list[float]]) -> int | None:
    """The group whose frame a camera has: same size and intrinsics, else same size, else None (a free viewpoint)."""
    described = describe(camera)[0]
    candidates = [g for g, key in enumerate(keys) if key[:2] == described[:2].tolist()]
    for g in candidates:
        if _same_intrinsics(described, torch.tensor(keys[g], dtype=torch.float64)):
            return g
    return candidates[0] if candidates else None


def nearest_aspect(camera: Cameras, keys: list[list[float]]) -> int:
    """The group whose aspect is that of a free viewpoint (within 1 %), or the first."""
    width, height = describe(camera)[0, :2].tolist()
    for g, key in enumerate(keys):
        if abs(width / height - key[0] / key[1]) < 0.01 * width / height:
            return g
    return 0


def describe(cameras: Cameras) -> Tensor:
    """width, height, fx, fy, cx, cy of each camera: [N, 6] float64 on the CPU."""
    fields = (cameras.width, cameras.height, cameras.fx, cameras.fy, cameras.cx, cameras.cy)
    return torch.stack([f.reshape(-1).to("cpu", torch.float64) for f in fields], dim=-1)


def _group(described: Tensor, by_intrinsics: bool) -> tuple[list[Tensor], list[int]]:
    keys: list[Tensor] = []
    groups: list[int] = []
    for camera in described:
        for g, key in enumerate(keys):
            if torch.equal(camera[:2], key[:2]) and (not by_intrinsics or _same_intrinsics(camera, key)):
                groups.append(g)
                break
        else:
            groups.append(len(keys))
            keys.append(camera)
    return keys, groups


def _same_intrinsics(a: Tensor, b: Tensor) -> bool:
    return bool((a[2:] - b[2:]).abs().max() <= SAME_INTRINSICS * a[0])
