"""A dataset as another program reads it: photos, original or without the artifact, their masks, poses, and a README."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from PIL import Image

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio.cameras.lens import undistort, undistorted_lens
from ssa_nerfstudio.data.dataset import Dataset, View
from ssa_nerfstudio.data.photos import check_mask, read_gray
from ssa_nerfstudio.data.training_requirements import check_poses, check_seed_points
from ssa_nerfstudio.data.transforms import OTHER_MODELS
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.export.capture_artifact import CaptureArtifact, Frame
from ssa_nerfstudio.export.colmap_model import PosedPhoto, write_colmap_model
from ssa_nerfstudio.export.trainer_presets import PRESETS, Preset, Program

Masks = Literal["auto", "artifact", "holes", "none"]
_POINTS = "sparse_pc.ply"


@dataclass(frozen=True)
class ExportedPhoto:
    """One photo of the folder."""

    posed: PosedPhoto
    left: float
    """Share of its pixels that its mask leaves, in [0, 1]."""
    source: View


class DatasetExport:
    """A dataset on its way to one program."""

    def __init__(
        self,
        dataset: Dataset,
        artifact: CaptureArtifact,
        program: Program,
        photos: Literal["original", "cleaned"] = "original",
        masks: Masks = "auto",
        frame: Literal["auto", "raw", "undistorted"] = "auto",
    ) -> None:
        """Store the choices.

        Args:
            dataset: the capture.
            artifact: what is in front of its photos.
            program: who is to read it.
            photos: with the artifact, or restored.
            masks: artifact: all that it changes is masked; holes: what could not be restored; auto: artifact for
                original photos, holes for cleaned ones.
            frame: of photos and masks; auto: the program's own.

        Raises:
            InputError: the program cannot read photos in that frame or of that camera, poses or points are broken, or
                holes are asked for in original photos.
        """
        if masks == "holes" and photos == "original":
            raise InputError(
                "--masks holes: nothing is missing in original photos", "add --photos cleaned, or choose other masks"
            )
        if dataset.transforms.camera_model in OTHER_MODELS:
            raise InputError(
                f"{dataset.transforms.path}: camera_model {dataset.transforms.camera_model} cannot be exported",
                "cut perspective photos out of these",
            )
        check_poses(dataset.transforms)
        check_seed_points(dataset.transforms)
        self._dataset, self._artifact, self.program, self._photos = dataset, artifact, program, photos
        self.preset: Preset = PRESETS[program]
        self.frame: Frame = self.preset.frame if frame == "auto" else frame
        self.masks = ("holes" if photos == "cleaned" else "artifact") if masks == "auto" else masks
        unread = any(v.lens.distorted and v.lens.model not in self.preset.lenses for v in dataset.views)
        if self.frame == "raw" and unread:
            raise InputError(f"{self.preset.title} does not read this lens", "leave out --frame raw")
        clean = not dataset.split_by_interval
        self._clean_views = {v.path for v in dataset.views if v.role == "test"} if clean else set()
        wanted = (
            dataset.views if program == "nerfstudio" else [v for v in dataset.views if v.path not in self._clean_views]
        )
        self.views = [view for view in wanted if view.role != "unused"]
        self._poses = {
            frame["file_path"]: np.array(frame["transform_matrix"], dtype=np.float64)
            for frame in dataset.transforms.frames
        }

    def write_photos(self, folder: Path) -> Iterator[ExportedPhoto]:
        """Write photos and masks, one after the other.

        Raises:
            InputError: a photo or mask cannot be read.
        """
        for view in self.views:
            yield self._write_photo(view, folder)

    def write_poses(self, folder: Path, photos: list[ExportedPhoto]) -> None:
        """Write what the program reads the poses from, and README.md.

        Args:
            folder: of the photos.
            photos: what `write_photos` yielded.
        """
        stated = self._dataset.meta.get("ply_file_path")
        points = self._dataset.root / stated if stated else None
        if self.program == "nerfstudio":
            if points is not None:
                shutil.copyfile(points, folder / _POINTS)
            (folder / "transforms.json").write_text(json.dumps(self._transforms(photos), indent=1), encoding="utf-8")
        else:
            write_colmap_model(folder / "sparse/0", [p.posed for p in photos], self._dataset.meta, points)
        (folder / "README.md").write_text(self._readme(photos), encoding="utf-8")

    def _write_photo(self, view: View, folder: Path) -> ExportedPhoto:
        lens = undistorted_lens(view.lens) if self.frame == "undistorted" else view.lens
        path = PurePosixPath(view.path)
        below = path.relative_to("images") if path.parts[0] == "images" else path
        photo, mask = self._photo_and_mask(view)
        if mask is not None and self.preset.mask is None:
            pixels = self._dataset.read_photo(view) if photo is None else photo
            photo = np.concatenate([pixels, mask[..., None].astype(np.uint8) * 255], axis=-1)
        if photo is None:
            target = folder / "images" / below
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(self._dataset.source(view.path), target)
        else:
            below = below.with_suffix(".png")
            _save(folder / "images" / below, photo)
        if mask is not None and (place := self.preset.mask_path(below)) is not None:
            _save(folder / place, mask.astype(np.uint8) * 255)
        left = 1.0 if mask is None else float(mask.mean())
        return ExportedPhoto(PosedPhoto(str(below), lens, self._poses[view.path]), left, view)

    def _photo_and_mask(self, view: View) -> tuple[np.ndarray | None, np.ndarray | None]:
        """A photo uint8 [H, W, 3], None where the file is taken as it is, and its mask, bool [H, W], True: to use."""
        photo, holes = None, None
        carries = view.path not in self._clean_views
        warped = self.frame == "undistorted" and view.lens.distorted
        if warped or (carries and self._photos == "cleaned"):
            photo = self._dataset.read_photo(view)
            photo = undistort(photo, view.lens) if warped else photo
        if carries and self._photos == "cleaned":
            assert photo is not None
            photo, seen = self._artifact.restored(photo, view.path, view.lens, self.frame)
            holes = ~seen
        if self.masks == "none":
            return photo, None
        lens = undistorted_lens(view.lens) if self.frame == "undistorted" else view.lens
        mask = np.ones((lens.height, lens.width), bool)
        if carries and self.masks == "artifact":
            mask &= ~self._artifact.covered(view.path, view.lens, self.frame)
        if holes is not None:
            mask &= ~holes
        for kind, name in view.companions:
            if kind == "masks":
                file = self._dataset.source(name, "masks")
                check_mask(file, (view.lens.width, view.lens.height))
                given = read_gray(file)
                given = undistort(given.astype(np.float32), view.lens) if warped else given
                mask &= given > 0
        return photo, mask

    def _transforms(self, photos: list[ExportedPhoto]) -> dict[str, Any]:
        """Contents of nerfstudio's transforms.json."""
        meta = self._dataset.meta
        paths = {photo.source.path: f"images/{photo.posed.name}" for photo in photos}
        frames = []
        for photo in photos:
            lens = photo.posed.lens
            intrinsics = {
                "w": lens.width,
                "h": lens.height,
                "fl_x": lens.fx,
                "fl_y": lens.fy,
                "cx": lens.cx,
                "cy": lens.cy,
            }
            names = ("k1", "k2", "k3", "k4", "p1", "p2")
            frame = {"file_path": paths[photo.source.path], "transform_matrix": photo.posed.pose.tolist(), **intrinsics}
            frame |= dict(zip(names, lens.distortion, strict=True))
            if self.masks != "none":
                frame["mask_path"] = str(self.preset.mask_path(PurePosixPath(photo.posed.name)))
            frames.append(frame)
        fisheye = any(photo.posed.lens.model == "fisheye" for photo in photos)
        kept = {key: meta[key] for key in ("applied_transform", "applied_scale", "orientation_override") if key in meta}
        splits = {
            key: [paths[name] for name in self._dataset.transforms.stated_split(split) or () if name in paths]
            for split in ("train", "val", "test")
            if (key := f"{split}_filenames") in meta
        }
        points = {"ply_file_path": _POINTS} if "ply_file_path" in meta else {}
        return {"camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV", **kept, **points, **splits, "frames": frames}

    def _readme(self, photos: list[ExportedPhoto]) -> str:
        left = [photo.left for photo in photos]
        kind = {"original": "the photos as they are", "cleaned": "the photos without the artifact"}[self._photos]
        masked = {
            "artifact": "Masked (black): what the artifact changes.",
            "holes": "Masked (black): what the artifact hides. Nothing was guessed there.",
            "none": "Nothing is masked.",
        }[self.masks]
        rows = "\n".join(f"| {photo.posed.name} | {photo.left:.1%} |" for photo in photos)
        sources = "\n".join(f"- {source}" for source in self.preset.sources)
        without = (
            ""
            if self.program == "nerfstudio" or not self._clean_views
            else f"\nLeft out: {counted(len(self._clean_views), 'test photo')} of the dataset.\n"
        )
        return (
            f"# {counted(len(photos), 'photo')} for {self.preset.title}\n\n    {self.preset.start}\n\n"
            f"{self.preset.note}\n\n"
            f"Here are {kind}, in the {self.frame} frame. {masked} White is used, black is ignored.\n{without}\n"
            f"On average {np.mean(left):.1%} of a photo is not masked, of the one with the largest mask "
            f"{min(left):.1%}.\n\n"
            f"| photo | not masked |\n|---|---|\n{rows}\n\nThe layout follows:\n\n{sources}\n"
        )


def _save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, format="PNG", compress_level=1)
