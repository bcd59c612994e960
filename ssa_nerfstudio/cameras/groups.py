"""Camera groups: photos with one frame size and one set of intrinsics share an artifact."""

from __future__ import annotations

import numpy as np

INTRINSICS_TOLERANCE = 1e-3
"""Focal lengths and principal points within this, relative to the frame's width, belong to one camera."""


def group_frames(frames: np.ndarray) -> list[int]:
    """Group frames by camera; each group has its own overlay.

    A rig's cameras differ in their intrinsics. Where structure from motion estimated intrinsics per photo (more than
    half of the groups would have a single view), intrinsics are ignored, and photos of one size form one group.

    Args:
        frames: width, height, fx, fy, cx, cy of each undistorted frame, [N, 6], pixels.

    Returns:
        Each frame's group, numbered from 0 in order of first appearance.
    """
    groups = _group(frames, by_intrinsics=True)
    count = max(groups, default=0) + 1
    if count > 1 and sum(groups.count(group) == 1 for group in range(count)) > count / 2:
        groups = _group(frames, by_intrinsics=False)
    return groups


def _group(frames: np.ndarray, by_intrinsics: bool) -> list[int]:
    keys: list[np.ndarray] = []
    groups: list[int] = []
    for frame in frames:
        for group, key in enumerate(keys):
            if (frame[:2] == key[:2]).all() and (not by_intrinsics or same_intrinsics(frame, key)):
                groups.append(group)
                break
        else:
            groups.append(len(keys))
            keys.append(frame)
    return groups


def same_intrinsics(frame: np.ndarray, other: np.ndarray) -> bool:
    """Whether two frames [6], as in `group_frames`, have the same focal lengths and principal point."""
    return bool(np.abs(frame[2:] - other[2:]).max() <= INTRINSICS_TOLERANCE * frame[0])
