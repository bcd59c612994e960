"""What training needs of a transforms.json beyond what every reader does: enough views, poses, and files that exist."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio.cameras.lens import undistorted_lens
from ssa_nerfstudio.data.sparse_points import check_points
from ssa_nerfstudio.data.transforms import FILE_KEYS, OTHER_MODELS, SPLITS, Split, Transforms, is_file
from ssa_nerfstudio.errors import InputError

MIN_VIEWS = 2
"""A static artifact is what does not change between views, so one view cannot show it."""
_ROTATION_TOLERANCE = 0.01
"""Largest deviation of R R^T from the identity: poses of real captures have a few digits."""
_ORIENTATION_METHODS = ("none", "pca", "up", "vertical")


def check_training(
    transforms: Transforms, downscale_factor: int | None = None, splits: Iterable[Split] = ("train", "val")
) -> None:
    """Check that nerfstudio can train on a dataset.

    Has to run before nerfstudio's dataparser, which averages the poses: one bad pose spoils all of them.

    Args:
        transforms: of the dataset.
        downscale_factor: N > 1 reads images_N. None: nerfstudio chooses from the size of the first photo.
        splits: what nerfstudio will ask for. Where the file states any split, it has to state these.

    Raises:
        InputError: something is missing or wrong.
    """
    path, count = transforms.path, len(transforms.frames)
    if count < MIN_VIEWS:
        raise InputError(
            f"{path} lists {counted(count, 'photo')}; at least {MIN_VIEWS} are needed, 30 and more work well"
        )
    if downscale_factor is not None and downscale_factor < 1:
        raise InputError(f"the downscale factor must be at least 1, got {downscale_factor}", "2 reads images_2")
    check_poses(transforms)
    _check_lenses(transforms)
    _check_files(transforms, downscale_factor)
    _check_split(transforms, splits)


def check_split_options(transforms: Transforms, mode: str, fraction: float, interval: int) -> None:
    """Check nerfstudio's options of the split that it makes where the file states none.

    Args:
        transforms: of the dataset.
        mode: eval_mode of nerfstudio-data: fraction, filename, interval or all.
        fraction: train_split_fraction; share of the photos to train on, for that mode.
        interval: eval_interval; one photo in so many is for evaluation, for that mode.

    Raises:
        InputError: no split can be made with them.
    """
    if any(transforms.stated_split(split) is not None for split in SPLITS):
        return
    names = [Path(frame["file_path"]).name for frame in transforms.frames]
    if mode == "fraction" and not MIN_VIEWS / len(names) <= fraction <= 1:
        raise InputError(
            f"--train-split-fraction {fraction:g} leaves no two of {len(names)} photos to train on, or more than all",
            "give a share of the photos, such as 0.9",
        )
    if mode == "interval" and interval < 2:
        raise InputError(f"--eval-interval must be at least 2, got {interval}")
    other = [name for name in names if "train" not in name and "eval" not in name]
    if mode == "filename" and other:
        raise InputError(
            f"--eval-mode filename: {other[0]} has neither train nor eval in its name", "choose another --eval-mode"
        )


def _check_split(transforms: Transforms, needed: Iterable[Split]) -> None:
    stated = {split: transforms.stated_split(split) for split in SPLITS}
    if all(names is None for names in stated.values()):
        return
    for split in needed:
        if stated[split] is None:
            raise InputError(
                f"{transforms.path} states a split without {split}_filenames", "add that list, or remove the others"
            )
    if len(stated["train"] or ()) < MIN_VIEWS:
        raise InputError(
            f"{transforms.path}: train_filenames leaves {counted(len(stated['train'] or ()), 'photo')} to train on",
            f"list at least {MIN_VIEWS}",
        )


def check_poses(transforms: Transforms) -> None:
    """Check that all frames have poses, and what moves these into nerfstudio's world.

    Raises:
        InputError: a pose is missing or none, all cameras are in one place, or an entry that moves them is broken.
    """
    positions = []
    for frame in transforms.frames:
        pose = _finite(frame.get("transform_matrix"))
        if pose is None or pose.shape != (4, 4):
            raise InputError(
                f"{transforms.path}: the pose of {frame['file_path']} is no 4 x 4 matrix of finite numbers",
                "correct it, or remove that frame",
            )
        turn = pose[:3, :3]
        with np.errstate(over="ignore", invalid="ignore"):
            rigid = np.abs(turn @ turn.T - np.eye(3)).max() < _ROTATION_TOLERANCE and np.linalg.det(turn) > 0
        if not rigid:
            raise InputError(
                f"{transforms.path}: the pose of {frame['file_path']} is no rotation with a position: its axes are not "
                "three right-handed unit vectors",
                "correct it, or remove that frame",
            )
        positions.append(pose[:3, 3])
    if (np.array(positions) == positions[0]).all():
        raise InputError(
            f"{transforms.path}: all cameras are in one place, from which no depth can be seen",
            "move the camera between photos, or register them again",
        )
    _check_alignment(transforms)


def _check_alignment(transforms: Transforms) -> None:
    """Check the entries that move poses and points into nerfstudio's world."""
    path, meta = transforms.path, transforms.meta
    if "applied_transform" in meta:
        applied = _finite(meta["applied_transform"])
        if applied is None or applied.shape != (3, 4):
            raise InputError(f"{path}: applied_transform is no 3 x 4 matrix of finite numbers", "correct or remove it")
    scale = _finite(meta.get("applied_scale", 1.0))
    if scale is None or scale.shape != ():
        raise InputError(f"{path}: applied_scale is no finite number", "correct or remove it")
    if meta.get("orientation_override", "none") not in _ORIENTATION_METHODS:
        names = ", ".join(_ORIENTATION_METHODS)
        raise InputError(f"{path}: orientation_override must be one of {names}", "correct or remove it")


def _check_lenses(transforms: Transforms) -> None:
    if transforms.camera_model == "FISHEYE624":
        return  # nerfstudio undistorts it by itself
    if transforms.camera_model in OTHER_MODELS:
        raise InputError(
            f"{transforms.path}: splatfacto draws no camera_model {transforms.camera_model}",
            "cut perspective photos out of these",
        )
    for frame in transforms.frames:
        try:
            undistorted_lens(transforms.lens(frame))
        except ValueError as error:
            raise InputError(
                f"{transforms.path}: camera of {frame['file_path']}: {error}", "process the photos again"
            ) from error


def check_seed_points(transforms: Transforms) -> None:
    """Check the sparse points that a training starts from, where transforms.json states a file of them.

    Raises:
        InputError: see `sparse_points.check_points`.
    """
    if "ply_file_path" in transforms.meta:
        check_points(transforms.root / transforms.meta["ply_file_path"])


def _check_files(transforms: Transforms, downscale_factor: int | None) -> None:
    for key, kind in FILE_KEYS.items():
        names = [frame[key] for frame in transforms.frames if key in frame]
        if 0 < len(names) < len(transforms.frames):
            raise InputError(
                f"{transforms.path}: {key} is stated in {len(names)} of {len(transforms.frames)} frames",
                "state it in all frames or in none",
            )
        if kind == "depths":
            continue  # splatfacto does not open them
        if downscale_factor is not None:
            transforms.check_exist(names, kind, downscale_factor)
            continue
        if kind == "images":
            transforms.check_exist(names[:1])  # nerfstudio chooses by its size
        transforms.check_exist([name for name in names if not _in_a_smaller_size(transforms.root / name)], kind)


def _in_a_smaller_size(photo: Path) -> bool:
    """Whether a reduced copy lies beside the photo's folder, as in images_4."""
    try:
        return any(is_file(folder / photo.name) for folder in photo.parent.parent.glob(f"{photo.parent.name}_*"))
    except (OSError, ValueError, NotImplementedError):  # no folder can have that name
        return False


def _finite(value: object) -> np.ndarray | None:
    """Numbers as float32, which nerfstudio reads them as; None where one is no number or not finite."""
    with np.errstate(over="ignore"):
        try:
            array = np.array(value, dtype=object).astype(np.float32)
        except (TypeError, ValueError, OverflowError):
            return None
    return array if np.isfinite(array).all() else None
