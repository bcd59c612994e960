"""DC-Gaussian (Wang et al., NeurIPS 2024): reflections on the windscreen of a dashcam, learned beside the scene.

The variant `win`: an opacity and a reflection for every pixel, shared by all photos of a camera. The full model lets
reflections depend on the camera's position, too. Source: the paper and its code (CC0), written anew.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ssa_nerfstudio.experiments.benchmark.baselines.baseline import Baseline, BaselineModel
from ssa_nerfstudio.overlay.resampling import to_training_scale
from ssa_nerfstudio.plugin.camera_matching import group_cameras
from ssa_nerfstudio.plugin.datamanager import SSADatamanager
from ssa_nerfstudio.plugin.model import SSASplatfactoModelConfig
from ssa_nerfstudio.plugin.view_geometry import metadata

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras

START = 0.05
"""Opacity and reflection start uniformly between 0 and this."""


class Windscreen(nn.Module):
    """What one camera sees the scene through: I = (1 - relu(a)) C + O."""

    def __init__(self, height: int, width: int) -> None:
        super().__init__()
        self.opacity = nn.Parameter(START * torch.rand(height, width, 1))
        """a [H, W, 1]; below 0 it counts as 0."""
        self.reflection = nn.Parameter(START * torch.rand(height, width, 3))
        """O [H, W, 3]."""

    def forward(self, clean: Tensor, reduction: int) -> Tensor:
        """I [H // reduction, W // reduction, 3] of a render C of that size."""
        pair = torch.cat([1.0 - torch.relu(self.opacity), self.reflection], dim=-1)
        pair = to_training_scale(pair, 1, reduction, *self.opacity.shape[:2])
        return pair[..., :1] * clean + pair[..., 1:]


@dataclass
class WindscreenConfig(SSASplatfactoModelConfig):
    """Configuration of `WindscreenModel`."""

    _target: type = field(default_factory=lambda: WindscreenModel)
    windscreen_opacity_weight: float = 0.01
    """Weight of mean relu(a) in the loss."""


class WindscreenModel(BaselineModel):
    """splatfacto seen through a windscreen for each camera group while training; `rgb` is the scene alone."""

    config: WindscreenConfig

    def examine(self, datamanager: SSADatamanager) -> None:
        """Make the windscreens, of the size of the undistorted frames."""
        _ = datamanager.cached_train  # undistorts the photos, and with them the cameras
        keys, self._groups = group_cameras(datamanager.train_dataset.cameras)
        frames = [Windscreen(int(key[1]), int(key[0])) for key in keys]
        self.beside["windscreen"] = nn.ModuleList(frames).to(self.device)

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor | None]:
        """splatfacto's outputs; while training also `composite`, the prediction of the photo."""
        drawn = super().get_outputs(camera)
        if self.training and drawn["rgb"] is not None:
            screen = self._windscreens()[self._groups[metadata(camera)["cam_idx"]]]
            drawn["composite"] = screen(drawn["rgb"], self._get_downscale_factor())
        return drawn

    def get_loss_dict(self, outputs: dict, batch: dict, metrics_dict: dict | None = None) -> dict[str, Tensor]:
        """splatfacto's loss of the composite, and the mean opacity of the windscreens."""
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        if self.training:
            opacity = torch.stack([torch.relu(screen.opacity).mean() for screen in self._windscreens()]).mean()
            losses["windscreen_opacity"] = self.config.windscreen_opacity_weight * opacity
        return losses

    def _windscreens(self) -> list[Windscreen]:
        return [screen for screen in self.beside["windscreen"].children() if isinstance(screen, Windscreen)]


BASELINE = Baseline(WindscreenConfig, learning_rates={"windscreen": 1e-3})
