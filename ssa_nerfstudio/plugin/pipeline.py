"""Validates the input and assigns overlays to the model before training; otherwise nerfstudio's pipeline."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from torch.cuda.amp.grad_scaler import GradScaler

from ssa_nerfstudio.data.training_requirements import check_training
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.plugin.camera_matching import describe_lenses, group_cameras
from ssa_nerfstudio.plugin.datamanager import SSADatamanager, SSADatamanagerConfig
from ssa_nerfstudio.plugin.model import SSASplatfactoModel, SSASplatfactoModelConfig
from ssa_nerfstudio.plugin.overlay_setup import given_overlays, learned_overlays
from ssa_nerfstudio.plugin.training.checkpoints import load_pipeline_state
from ssa_nerfstudio.plugin.validation import check_device, check_settings, check_views


@dataclass
class SSAPipelineConfig(VanillaPipelineConfig):
    """Configuration of `SSAPipeline`."""

    _target: type = field(default_factory=lambda: SSAPipeline)
    datamanager: SSADatamanagerConfig = field(default_factory=SSADatamanagerConfig)
    """The photos and cameras."""
    model: SSASplatfactoModelConfig = field(default_factory=SSASplatfactoModelConfig)
    """The scene and the artifact."""
    artifacts_of: Path | None = None
    """A checkpoint whose overlays, or lack of them, replace detection. The trainer sets it when it resumes."""


class SSAPipeline(VanillaPipeline):
    """`VanillaPipeline` whose model has its overlays before the optimizers are built."""

    config: SSAPipelineConfig
    datamanager: SSADatamanager
    model: SSASplatfactoModel

    def __init__(
        self,
        config: SSAPipelineConfig,
        device: str,
        test_mode: Literal["test", "val", "inference"] = "val",
        world_size: int = 1,
        local_rank: int = 0,
        grad_scaler: GradScaler | None = None,
    ) -> None:
        check_device(device)
        check_settings(config.model, device)
        source = _source(config)
        if isinstance(config.datamanager.dataparser, NerfstudioDataParserConfig):
            splits = ("train", "val" if test_mode == "val" else "test")
            check_training(Transforms.read(source), config.datamanager.dataparser.downscale_factor, splits)
        super().__init__(config, device, test_mode, world_size, local_rank, grad_scaler)
        check_views(self.datamanager.train_dataparser_outputs, source)
        if test_mode == "val":
            cameras = self.datamanager.train_dataset.cameras
            positions = cameras.camera_to_worlds[:, :3, 3]
            self.model.set_scene_extent(_extent(positions))
            self.model.start_outside_cameras(positions)
            self._set_overlays()

    def _set_overlays(self) -> None:
        setting = self.config.model.overlay
        resumed = load_pipeline_state(self.config.artifacts_of) if self.config.artifacts_of else None
        if setting == "off" or (resumed is None and self.config.artifacts_of):
            return  # loading the checkpoint will say what is wrong with it
        lenses = describe_lenses(self.datamanager.train_dataset.cameras)
        # Undistorts and crops the photos and rewrites the cameras: overlays are in undistorted pixels.
        photos = self.datamanager.cached_train
        keys, groups = group_cameras(self.datamanager.train_dataset.cameras)
        sizes = [(int(key[1]), int(key[0])) for key in keys]
        artifacts = self.model.artifacts
        if resumed is not None:
            artifacts.resume_from(resumed, "_model.artifacts.", keys, groups, setting)
            return
        if setting == "given":
            overlays = given_overlays(self.config.model.overlay_given, sizes)
        else:
            overlays = learned_overlays(self.config.model, photos, groups, sizes)
        first = [groups.index(g) for g in range(len(keys))]
        artifacts.assign(overlays, keys, groups, lenses[first])


def _source(config: SSAPipelineConfig) -> Path:
    data = config.datamanager.data or config.datamanager.dataparser.data
    return Path(data)


def _extent(positions: torch.Tensor) -> float:
    """Radius of the cameras around their center, times 1.1 (3DGS's `nerf_normalization`; at least 1e-6)."""
    return max(1e-6, 1.1 * float((positions - positions.mean(dim=0)).norm(dim=1).max()))
