"""The simulator's transforms.json, with its split, and scene.yaml."""

from __future__ import annotations

import copy
import importlib.metadata
import platform
from contextlib import suppress
from typing import Any

import cv2
import numpy as np
import PIL
import yaml

from ssa_nerfstudio import __version__
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.experiments.simulation.scene import Scene


def transforms(dataset: Dataset, names: dict[str, str]) -> dict[str, Any]:
    """Return the output's transforms.json: the input's, with split, the photos' new names and the size that was read.

    Args:
        dataset: the input.
        names: each photo's path in the output.
    """
    meta = copy.deepcopy(dataset.meta)
    for frame in meta["frames"]:
        frame["file_path"] = names[frame["file_path"]]
    for split, paths in zip(("train", "val", "test"), dataset.split, strict=True):
        meta[f"{split}_filenames"] = [names[path] for path in paths]
    if dataset.downscale_factor > 1:
        for holder in (meta, *meta["frames"]):
            # Numbers may be strings: nerfstudio takes them.
            reduced = {
                key: float(holder[key]) / dataset.downscale_factor
                for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")
                if key in holder
            }
            holder |= {key: int(value) if key in ("w", "h") else value for key, value in reduced.items()}
    return meta


def scene_record(dataset: Dataset, scene: Scene, name: str) -> str:
    """Return YAML of the effects and their provenance; it is a scene file that repeats the run.

    Args:
        dataset: the input.
        scene: effects that were put in front.
        name: of the input.
    """
    train, val, test = dataset.split
    versions = {
        "python": platform.python_version(),
        "ssa-nerfstudio": __version__,
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "Pillow": PIL.__version__,
    }
    if any(name in ("rain", "mud") for name, _ in scene.effects):
        with suppress(importlib.metadata.PackageNotFoundError):
            versions["albumentations"] = importlib.metadata.version("albumentations")
    record = {
        "effects": scene.describe(),
        "seed": scene.seed,
        **({"exposure": scene.exposure} if scene.exposure else {}),
        "provenance": {
            "data": name,
            "downscale_factor": dataset.downscale_factor,
            "split": f"every {dataset.eval_interval}th view tests" if dataset.split_by_interval else "transforms.json",
            "views": {"train": len(train), "val": len(val), "test": len(test)},
            "formation": "I = clip(T C + B, 0, 1) in the raw frame, rounded to 8 bits; several effects are composed "
            "in order, T = T2 T1 and B = T2 B1 + B2, and clipped once",
            "versions": versions,
        },
    }
    return yaml.safe_dump(record, sort_keys=False, allow_unicode=True, width=120)
