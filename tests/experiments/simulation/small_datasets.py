"""Small nerfstudio datasets for the simulator's tests."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

_PROPERTIES = [
    f"property {kind}" for kind in ("float x", "float y", "float z", "uchar red", "uchar green", "uchar blue")
]
PLY = "\n".join(["ply", "format ascii 1.0", "element vertex 1", *_PROPERTIES, "end_header", "0 0 1 9 9 9", ""])


def write_dataset(
    folder: Path, views: int = 10, width: int = 48, height: int = 36, suffix: str = ".jpg", **meta: Any
) -> Path:
    """A dataset of random photos, in an order in transforms.json that is not that of their names."""
    rng = np.random.default_rng(0)
    (folder / "images").mkdir(parents=True)
    frames = []
    for number in reversed(range(views)):
        coarse = rng.integers(0, 256, (4, 5, 3), dtype=np.uint8)
        photo = Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC)
        photo.save(folder / f"images/frame_{number:03d}{suffix}", quality=95)
        pose = np.eye(4)
        pose[:3, 3] = rng.normal(size=3)
        frames.append({"file_path": f"images/frame_{number:03d}{suffix}", "transform_matrix": pose.tolist()})
    (folder / "sparse_pc.ply").write_text(PLY)
    intrinsics = {"w": width, "h": height, "fl_x": 1.1 * width, "fl_y": 1.1 * width, "cx": width / 2, "cy": height / 2}
    stated = {"camera_model": "OPENCV", **intrinsics, "ply_file_path": "sparse_pc.ply", "frames": frames} | meta
    (folder / "transforms.json").write_text(json.dumps(stated))
    return folder


def edit(folder: Path, **changes: Any) -> dict[str, Any]:
    """Replaces entries of transforms.json; None removes one."""
    path = folder / "transforms.json"
    meta = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in meta.items() if value is not None}))
    return meta


def contents(folder: Path) -> dict[str, str]:
    """Hash of every file, by path."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def pixels(path: Path) -> np.ndarray:
    """A stored photo, uint8 [H, W, 3]."""
    return np.asarray(Image.open(path).convert("RGB"))
