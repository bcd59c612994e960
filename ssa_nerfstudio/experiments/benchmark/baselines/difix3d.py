"""Difix3D+ (Wu et al., CVPR 2025) as the paper uses it: one step of a diffusion model enhances every render of 3DGS.

Training is splatfacto's. A render is enhanced with the training photo taken nearest to it as reference, at prompt, time
step and resolution of the authors' example. Source: their model card and code.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from ssa_nerfstudio.experiments.benchmark.baselines.baseline import Baseline, BaselineModel, Count
from ssa_nerfstudio.experiments.benchmark.baselines.diffusion_weights import (
    enough_memory,
    fitted,
    load,
    require,
    resized_back,
)
from ssa_nerfstudio.plugin.datamanager import SSADatamanager
from ssa_nerfstudio.plugin.model import SSASplatfactoModelConfig

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras

WEIGHTS = "nvidia/difix_ref, NVIDIA's licence for non-commercial use"
PROMPT = "remove degradation"
TIMESTEP = 199
AREA = 576 * 1024
"""Of the pictures that it was trained on, pixels."""


@dataclass
class DifixConfig(SSASplatfactoModelConfig):
    """Configuration of `DifixModel`."""

    _target: type = field(default_factory=lambda: DifixModel)
    weights: str = ""
    """Folder of the weights of nvidia/difix_ref or nvidia/difix, or that id."""
    reference: bool = True
    """Show the nearest training photo to the model, as nvidia/difix_ref wants; nvidia/difix wants none."""
    area: Count = AREA
    """Pixels of the resolution at which renders are enhanced."""
    generator_seed: int = 0
    """Of its noise; the same for every render."""
    offload: bool = False
    """Keep only the part of the model that is at work on the GPU."""


class DifixModel(BaselineModel):
    """splatfacto whose test renders are enhanced. Viewers, which have no training photos, show them as they are."""

    config: DifixConfig
    _pipeline: Any = None

    def examine(self, datamanager: SSADatamanager) -> None:
        """Load the weights, which is known to work before hours of training, and keep the training photos."""
        self._pipeline = load(self.config.weights, WEIGHTS, self.device, self.config.offload, torch.float32)
        self._photos = [view["image"] for view in datamanager.cached_train]
        self._poses = datamanager.train_dataset.cameras.camera_to_worlds.to(self.device)

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor | None]:
        """splatfacto's outputs; outside training `rgb` is enhanced, and `rendered` is what it was made of."""
        drawn = super().get_outputs(camera)
        if not self.training and self._pipeline is not None and drawn["rgb"] is not None:
            nearest = int(pose_distances(self._poses, camera.camera_to_worlds[0].to(self.device)).argmin())
            drawn["rendered"], drawn["rgb"] = drawn["rgb"], self.enhance(drawn["rgb"], nearest)
        return drawn

    @torch.no_grad()
    def enhance(self, render: Tensor, reference: int) -> Tensor:
        """Enhance a render [H, W, 3] in [0, 1] with a training photo, by its number, as reference."""
        height, width = render.shape[:2]
        size = fitted(width, height, self.config.area, 8)
        photo = self.get_gt_img(self._photos[reference])[..., :3]
        image, nearest = (_picture(each).resize(size, Image.Resampling.LANCZOS) for each in (render, photo))
        with enough_memory(self.config.weights):
            enhanced = self._pipeline(
                PROMPT,
                image=image,
                ref_image=nearest if self.config.reference else None,
                num_inference_steps=1,
                timesteps=[TIMESTEP],
                guidance_scale=0.0,
                generator=torch.Generator().manual_seed(self.config.generator_seed),
            ).images[0]
        pixels = np.asarray(resized_back(enhanced, width, height), np.float32) / 255.0
        return torch.from_numpy(pixels).to(render)


def pose_distances(poses: Tensor, pose: Tensor) -> Tensor:
    """Distance of positions plus angle between orientations (radians), as the authors choose a reference.

    Args:
        poses: camera to world [N, 3, 4].
        pose: one more [3, 4].

    Returns:
        [N].
    """
    cosines = ((poses[:, :, :3] * pose[:, :3]).sum(dim=(1, 2)) - 1.0) / 2.0
    return (poses[:, :, 3] - pose[:, 3]).norm(dim=1) + torch.acos(cosines.clamp(-1.0, 1.0))


def _picture(image: Tensor) -> Image.Image:
    return Image.fromarray((image.clamp(0, 1) * 255).round().byte().cpu().numpy())


BASELINE = Baseline(DifixConfig, check=lambda settings: require(settings.get("weights", ""), WEIGHTS))
