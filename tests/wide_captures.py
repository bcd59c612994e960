"""360 and fisheye photos of the built-in scene, given what traces its rays; and an operator below a 360 camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

Trace = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Rays from an origin [3] along directions [N, 3] to distances and colors: `DemoScene.trace`."""


def panorama_poses(count: int) -> np.ndarray:
    """Cameras to world [count, 4, 4] on half a circle in the room, upright, turning and bobbing; OpenCV's axes."""
    index = np.arange(count)
    azimuth = np.radians(-120 + 160 * index / count)
    forward = azimuth + np.pi / 2 + 0.15 * np.sin(2.1 * index)
    poses = np.tile(np.eye(4), (count, 1, 1))
    zero = np.zeros(count)
    poses[:, :3, 0] = np.stack([np.sin(forward), -np.cos(forward), zero], 1)
    poses[:, :3, 1] = [0, 0, -1]
    poses[:, :3, 2] = np.stack([np.cos(forward), np.sin(forward), zero], 1)
    poses[:, :3, 3] = np.stack([2.9 * np.cos(azimuth), 2.9 * np.sin(azimuth), 1.5 + 0.4 * np.sin(1.7 * index)], 1)
    return poses


def panorama(trace: Trace, pose: np.ndarray, width: int) -> np.ndarray:
    """An equirectangular photo, uint8 [width / 2, width, 3], 2 x 2 rays a pixel."""
    height = width // 2
    longitude = ((np.arange(2 * width) + 0.5) / (2 * width) - 0.5) * 2 * np.pi
    latitude = ((np.arange(2 * height) + 0.5) / (2 * height) - 0.5)[:, None] * np.pi
    around = np.cos(latitude)
    rays = np.stack(np.broadcast_arrays(around * np.sin(longitude), np.sin(latitude), around * np.cos(longitude)), -1)
    return _drawn(trace, pose, rays)


def fisheye(trace: Trace, pose: np.ndarray, size: int, focal: float, k1: float = 0.0, widest: float = 90) -> np.ndarray:
    """A circular fisheye photo, uint8 [size, size, 3], 2 x 2 rays a pixel: black outside of its image circle.

    Args:
        trace: of the scene.
        pose: camera to world [4, 4], OpenCV's axes.
        size: of the frame, pixels.
        focal: of OpenCV's model r = focal (theta + k1 theta^3), pixels.
        k1: the same.
        widest: angle at the edge of the image circle, degrees.
    """
    axis = (np.arange(2 * size) + 0.5) / 2 - size / 2
    x, y = np.meshgrid(axis, axis)
    radius = np.hypot(x, y) / focal
    theta = radius.copy()
    for _ in range(50):
        theta = theta - (theta + k1 * theta**3 - radius) / (1 + 3 * k1 * theta**2)
    scale = np.sin(theta) / np.maximum(radius * focal, 1e-9)
    photo = _drawn(trace, pose, np.stack([x * scale, y * scale, np.cos(theta)], -1))
    seen = theta.reshape(size, 2, size, 2).max(axis=(1, 3)) <= np.radians(widest)
    return photo * seen[..., None]


def operator(width: int) -> np.ndarray:
    """Matte of an operator below and behind a 360 camera: float32 [width / 2, width, 1], 1 where he is."""
    height = width // 2
    longitude = np.abs((np.arange(width) + 0.5) / width - 0.5) * 360  # 180 is behind
    latitude = (0.5 - (np.arange(height) + 0.5) / height)[:, None] * 180
    head = np.square((180 - longitude) / 14) + np.square((latitude + 28) / 16) < 1
    body = (longitude > 155) & (latitude < -35)
    pole = np.broadcast_to(latitude < -66, body.shape)
    return (head | body | pole)[..., None].astype(np.float32)


def with_operator(photo: np.ndarray) -> np.ndarray:
    """A 360 photo uint8 [H, W, 3] with the operator in striped clothes in front of the scene."""
    height, width = photo.shape[:2]
    matte = operator(width)
    stripes = np.where((np.arange(height) * 40 // height) % 2, 60, 150)[:, None, None] * np.array([1.0, 0.7, 0.5])
    return np.rint(photo * (1 - matte) + stripes * matte).astype(np.uint8)


def _drawn(trace: Trace, pose: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """A photo of twice as many rays [2 H, 2 W, 3] along each side, in the camera's axes."""
    height, width = rays.shape[0] // 2, rays.shape[1] // 2
    _, color = trace(pose[:3, 3], rays.reshape(-1, 3) @ pose[:3, :3].T)
    color = color.reshape(height, 2, width, 2, 3).mean(axis=(1, 3))
    return np.rint(color * 255).astype(np.uint8)


def write_clip(path: Path, frames: list[np.ndarray]) -> Path:
    """A video of photos uint8 [H, W, 3] of one size, at two frames a second."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 2, (width, height))
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()
    return path
