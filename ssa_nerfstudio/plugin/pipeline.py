"""Before training: look at the photos, and put an artifact in front of the model. After: nothing of its own."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from rich.progress import track
from torch.cuda.amp.grad_scaler import GradScaler

from ssa_nerfstudio.errors import refuse
from ssa_nerfstudio.overlay.layer import GivenOverlay, ScreenSpaceOverlay
from ssa_nerfstudio.overlay.statistics import accumulate
from ssa_nerfstudio.plugin.camera_groups import describe_lenses, group_cameras
from ssa_nerfstudio.plugin.datamanager import SSADatamanager, SSADatamanagerConfig
from ssa_nerfstudio.plugin.inputs import check_device, check_settings, check_transforms, check_views
from ssa_nerfstudio.plugin.model import SSASplatfactoModel, SSASplatfactoModelConfig


@dataclass
class SSAPipelineConfig(VanillaPipelineConfig):
    """Configuration of `SSAPipeline`."""

    _target: type = field(default_factory=lambda: SSAPipeline)
    datamanager: SSADatamanagerConfig = field(default_factory=SSADatamanagerConfig)
    """The photos and cameras."""
    model: SSASplatfactoModelConfig = field(default_factory=SSASplatfactoModelConfig)
    """The scene and the artifact."""


class SSAPipeline(VanillaPipeline):
    """`VanillaPipeline` whose model has its overlays before the optimisers are built, which is right after this."""

    config: SSAPipelineConfig
    datamanager: SSADatamanager
    model: SSASplatfactoModel
    loss: torch.Tensor

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
            check_transforms(source)
        super().__init__(config, device, test_mode, world_size, local_rank, grad_scaler)
        check_views(self.datamanager.train_dataparser_outputs, source)
        if test_mode == "val":
            cameras = self.datamanager.train_dataset.cameras
            positions = cameras.camera_to_worlds[:, :3, 3]
            self.model.set_scene_extent(_extent(positions))
            self.model.start_outside_cameras(positions)
            if config.model.overlay != "off":
                self._set_overlays()

    def get_train_loss_dict(self, step: int):
        """Upstream's, with the whole loss kept for the guard that reads it before the optimisers step."""
        outputs, losses, metrics = super().get_train_loss_dict(step)
        self.loss = torch.stack([loss.detach() for loss in losses.values()]).sum()
        return outputs, losses, metrics

    def _set_overlays(self) -> None:
        lenses = describe_lenses(self.datamanager.train_dataset.cameras)
        # Undistorts and crops the photos and rewrites the cameras: the overlay lives in what comes out.
        photos = self.datamanager.cached_train
        keys, groups = group_cameras(self.datamanager.train_dataset.cameras)
        sizes = [(int(key[1]), int(key[0])) for key in keys]
        if self.config.model.overlay == "given":
            overlays = _load_given(self.config.model.overlay_given, sizes)
        else:
            overlays = [ScreenSpaceOverlay(*size, self.config.model.overlay_downscale) for size in sizes]
            if self.config.model.overlay_start == "statistics":
                for g, overlay in enumerate(overlays):
                    members = [photo for photo, group in zip(photos, groups, strict=True) if group == g]
                    views = ((photo["image"], photo.get("mask")) for photo in members)
                    label = f"Statistics of camera {g + 1} of {len(overlays)}"
                    overlay.start_from(accumulate(track(views, label, total=len(members), transient=True)))
        first = [groups.index(g) for g in range(len(keys))]
        self.model.artifacts.put(overlays, keys, groups, lenses[first])


def _source(config: SSAPipelineConfig) -> Path:
    data = config.datamanager.data or config.datamanager.dataparser.data
    return Path(data)


def _extent(positions: torch.Tensor) -> float:
    """Radius of the cameras around their centre, times 1.1 (3DGS's `nerf_normalization`; at least 1e-6)."""
    return max(1e-6, 1.1 * float((positions - positions.mean(dim=0)).norm(dim=1).max()))


def _load_given(path: Path | None, sizes: list[tuple[int, int]]) -> list[GivenOverlay]:
    """The true layers of every camera group from an .npz file."""
    if path is None:
        raise refuse(
            "overlay 'given' needs the layers; add --pipeline.model.overlay-given FILE.npz with arrays T and B"
        )
    try:
        arrays = np.load(path)
        names = [("T", "B")] if len(sizes) == 1 and "T" in arrays else [(f"T{g}", f"B{g}") for g in range(len(sizes))]
        overlays = [GivenOverlay(torch.from_numpy(arrays[t]), torch.from_numpy(arrays[b])) for t, b in names]
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise refuse(f"{path} holds no usable layers ({error}); give an .npz with T and B [H, W, 3]") from error
    for overlay, size in zip(overlays, sizes, strict=True):
        if (overlay.height, overlay.width) != size:
            raise refuse(
                f"{path} has layers of {overlay.height} x {overlay.width} pixels, the undistorted photos have "
                f"{size[0]} x {size[1]}; give the layers in the undistorted frame at the training resolution"
            )
    return overlays
