"""Checks of what the user hands over, before anything is built: each failure is one line and exit code 2."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs

from ssa_nerfstudio.errors import InputError

if TYPE_CHECKING:
    from ssa_nerfstudio.plugin.settings import ModelSettings

MIN_VIEWS = 2
"""An artifact is what does not change from view to view: one view cannot show it."""


def check_device(device: torch.device | str) -> None:
    """Refuse CUDA where there is none."""
    if torch.device(device).type == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "CUDA was asked for and this machine has none that torch can use",
            "add --machine.device-type cpu, or install a torch build for your driver",
        )


def check_checkpoint(load_dir: Path | None, load_step: int | None, load_checkpoint: Path | None) -> None:
    """Refuse to resume from a folder without checkpoints or a file that does not exist."""
    if load_dir is None:
        if load_checkpoint is not None and not load_checkpoint.exists():
            raise InputError(
                f"--load-checkpoint {load_checkpoint} does not exist", "give a step-*.ckpt of an earlier run"
            )
        return
    pattern = "step-*.ckpt" if load_step is None else f"step-{load_step:09d}.ckpt"
    if not list(load_dir.glob(pattern)):
        raise InputError(
            f"--load-dir {load_dir} holds no {pattern}", "give the nerfstudio_models folder of an earlier run"
        )


def check_settings(model: ModelSettings, device: torch.device | str) -> None:
    """Refuse settings of the model that contradict each other or the machine."""
    if not model.sparsity_weight >= 0:
        raise InputError(
            f"--pipeline.model.sparsity-weight {model.sparsity_weight} must not be negative", "0.02 is the default"
        )
    if model.rasterizer == "reference" and model.use_absgrad and model.strategy == "adc":
        raise InputError(
            "--pipeline.model.rasterizer reference has no absgrad", "add --pipeline.model.use-absgrad False"
        )
    needed = {"gsplat": "cuda", "cpu": "cpu"}.get(model.rasterizer)
    if needed is not None and torch.device(device).type != needed:
        raise InputError(f"--pipeline.model.rasterizer {model.rasterizer} does not run on {device}", "use auto")


def check_transforms(data: Path) -> None:
    """Refuse a nerfstudio dataset whose transforms.json is missing, unreadable, empty, or holds broken poses.

    Has to run before the dataparser does: it averages the poses, after which one bad frame has spoilt all of them.

    Args:
        data: the dataset's folder, or its .json file.
    """
    path = data if data.suffix == ".json" else data / "transforms.json"
    if not data.exists():
        raise InputError(f"{data} does not exist", "give --data a folder that holds transforms.json and the photos")
    if not path.exists():
        raise InputError(f"{path} does not exist", "give --data a folder that ns-process-data or ssa process made")
    try:
        frames = json.loads(path.read_text())["frames"]
        if not isinstance(frames, list):
            raise TypeError
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is no valid JSON ({error})", "write it again with ns-process-data") from error
    except (KeyError, TypeError) as error:
        raise InputError(f"{path} has no list 'frames'", "write it again with ns-process-data") from error
    if len(frames) < MIN_VIEWS:
        raise InputError(
            f"{path} lists {len(frames)} photos", f"at least {MIN_VIEWS} are needed, 30 and more work well"
        )
    for frame in frames:
        if not isinstance(frame, dict):
            raise InputError(f"{path}: the frame {frame!r} is no object with file_path and transform_matrix")
        name = frame.get("file_path", "a frame without file_path")
        matrix = np.array(frame.get("transform_matrix", []), dtype=object)
        try:
            finite = matrix.shape in ((4, 4), (3, 4)) and all(math.isfinite(float(v)) for v in matrix.flat)
        except (TypeError, ValueError):
            finite = False
        if not finite:
            raise InputError(
                f"{path}: the pose of {name} is no 4 x 4 matrix of finite numbers",
                "remove that frame or register it again",
            )
        if not _found(path.parent / str(name)):
            raise InputError(f"{path} names {name}, which does not exist", "put the photo there or remove the frame")
    positions = np.array([np.array(frame["transform_matrix"], dtype=float)[:3, 3] for frame in frames])
    if (positions == positions[0]).all():
        raise InputError(
            f"{path}: all cameras are in one place, from which no depth can be seen",
            "move the camera between photos, or register them again",
        )


def _found(photo: Path) -> bool:
    """Whether there is a photo, in its folder or in a reduced copy beside it (images_4)."""
    try:
        return photo.exists() or bool(list(photo.parent.parent.glob(f"{photo.parent.name}_*/{photo.name}")))
    except OSError:  # no path: too long
        return False


def check_views(outputs: DataparserOutputs, source: Path) -> None:
    """Refuse training splits of fewer than two views and poses that are not finite."""
    views = len(outputs.image_filenames)
    if views < MIN_VIEWS:
        raise InputError(
            f"{source} leaves {views} photos to train on",
            f"at least {MIN_VIEWS} are needed: add photos, or hold fewer back for evaluation",
        )
    cameras = outputs.cameras
    intrinsics = torch.cat([t.reshape(views, -1) for t in (cameras.fx, cameras.fy, cameras.cx, cameras.cy)], dim=1)
    for what, values in (("pose", cameras.camera_to_worlds), ("intrinsics", intrinsics)):
        finite = torch.isfinite(values).flatten(1).all(dim=1)
        if not finite.all():
            name = outputs.image_filenames[int((~finite).nonzero()[0])]
            raise InputError(
                f"{source}: the {what} of {name} are not finite numbers", "correct them or remove that photo"
            )
