"""Which photos share an artifact: those of one frame size and one set of intrinsics."""

from __future__ import annotations

import numpy as np

SAME_INTRINSICS = 1e-3
"""Focal lengths and principal points closer than this (relative to the frame's width) are one camera's."""


def group_frames(described: np.ndarray) -> list[int]:
    """Sorts frames into groups that each get an overlay of their own, numbered in order of first appearance.

    A rig's cameras differ in their intrinsics and are kept apart. Where structure from motion gave every photo
    intrinsics of its own (more than half of the groups would hold a single view), they tell nothing, and photos of one
    size form one group.

    Args:
        described: width, height, fx, fy, cx, cy of each undistorted frame, [N, 6], pixels.

    Returns:
        Each frame's group.
    """
    groups = _group(described, by_intrinsics=True)
    count = max(groups, default=0) + 1
    if count > 1 and sum(groups.count(group) == 1 for group in range(count)) > count / 2:
        groups = _group(described, by_intrinsics=False)
    return groups


def _group(described: np.ndarray, by_intrinsics: bool) -> list[int]:
    keys: list[np.ndarray] = []
    groups: list[int] = []
    for frame in described:
        for group, key in enumerate(keys):
            if (frame[:2] == key[:2]).all() and (not by_intrinsics or same_intrinsics(frame, key)):
                groups.append(group)
                break
        else:
            groups.append(len(keys))
            keys.append(frame)
    return groups


def same_intrinsics(frame: np.ndarray, key: np.ndarray) -> bool:
    """Whether two described frames [6] have one camera's focal lengths and principal point."""
    return bool(np.abs(frame[2:] - key[2:]).max() <= SAME_INTRINSICS * frame[0])
