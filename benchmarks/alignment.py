"""How far camera centers are from where they should be, when only their shape is known."""

from __future__ import annotations

import numpy as np


def center_errors(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Distances of camera centers after the similarity that fits them best in the least-squares sense.

    Args:
        found: [N, 3], in any frame and scale; N at least 3, not all on one line.
        true: [N, 3].

    Returns:
        [N], in units of `true`.
    """
    rotation, scale, translation = similarity(found, true)
    return np.linalg.norm(scale * found @ rotation.T + translation - true, axis=1)


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """The similarity x -> scale R x + t that brings points nearest to others.

    Umeyama 1991, Least-squares estimation of transformation parameters between two point patterns.

    Args:
        source, target: [N, 3].

    Returns:
        Rotation R [3, 3], scale, translation t [3].
    """
    from_middle, to_middle = source - source.mean(axis=0), target - target.mean(axis=0)
    u, stretch, v = np.linalg.svd(to_middle.T @ from_middle)
    # A reflection fits no better than its rotation: the least significant axis is turned back.
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    rotation = (u * signs) @ v
    scale = float((stretch * signs).sum() / np.square(from_middle).sum())
    return rotation, scale, target.mean(axis=0) - scale * rotation @ source.mean(axis=0)
