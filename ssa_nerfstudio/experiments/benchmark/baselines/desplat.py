"""DeSplat (Wang et al., CVPR 2025): Gaussians of its own before every camera explain what only that photo shows.

Photo = D + (1 - alpha_D) S, with D of the photo's own Gaussians and S of the scene's. The number of a photo's Gaussians
is fixed here (docs/baselines.md). Source: the paper and its code (MIT), written anew.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ssa_nerfstudio.experiments.benchmark.baselines.baseline import Baseline, BaselineModel, Count
from ssa_nerfstudio.plugin.datamanager import SSADatamanager
from ssa_nerfstudio.plugin.model import SSASplatfactoModelConfig
from ssa_nerfstudio.plugin.view_geometry import frame, intrinsics, metadata
from ssa_nerfstudio.rasterization import rasterizer

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras

DISTANCE = 0.02
"""Of a photo's Gaussians before its camera, in units of the normalized scene."""
SPREAD = 0.01
"""They start within this distance of the optical axis, in each direction."""
OPACITY = 0.1
"""That they start with."""
SPLIT = 1.6
"""By which both halves of a Gaussian that is split are smaller, as in 3DGS."""
RATES = {"means": 1.6e-4, "colors": 0.025, "opacities": 0.05, "scales": 0.05, "quats": 0.01}


def start(count: int, neighbors: int = 3) -> dict[str, Tensor]:
    """Gaussians before a camera, in its coordinates (OpenCV): means, colors, opacities, scales, quats, `count` each."""
    means = torch.rand(count, 3) * 2 * SPREAD - SPREAD
    means[:, 2] = DISTANCE
    distances = torch.cdist(means, means).topk(min(neighbors + 1, count), largest=False).values[:, 1:]
    return {
        "means": means,
        "colors": torch.rand(count, 3),
        "opacities": torch.full((count,), OPACITY).logit(),
        "scales": distances.mean(dim=1, keepdim=True).clamp_min(1e-7).log().repeat(1, 3),
        "quats": nn.functional.normalize(torch.randn(count, 4), dim=1),
    }


@dataclass
class DesplatConfig(SSASplatfactoModelConfig):
    """Configuration of `DesplatModel`."""

    _target: type = field(default_factory=lambda: DesplatModel)
    distractors: Count = 1000
    """Gaussians of each photo."""
    distractor_weight: float = 0.01
    """Weight of mean alpha_D, which keeps them off the scene."""
    emptiness_weight: float = 0.01
    """Weight of mean (1 - alpha_S), which fills the scene behind them."""
    distractor_refine_epochs: Count = 10
    """Passes over the photos between two moves of transparent Gaussians to where the photo is explained worst."""


class DesplatModel(BaselineModel):
    """splatfacto behind the Gaussians of each photo while training; `rgb` is the scene alone."""

    config: DesplatConfig

    def examine(self, datamanager: SSADatamanager) -> None:
        """Make the Gaussians of every photo."""
        views = [start(self.config.distractors) for _ in datamanager.train_dataset.image_filenames]
        for name in RATES:
            values = nn.ParameterList([nn.Parameter(view[name]) for view in views])
            self.beside[f"distractor_{name}"] = values.to(self.device)
        self._pull = torch.zeros(len(views), self.config.distractors, device=self.device)

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor | None]:
        """splatfacto's outputs; while training also `composite` and `distractor_alpha` [H, W, 1]."""
        drawn = super().get_outputs(camera)
        if self.training and drawn["rgb"] is not None:
            color, alpha = self._draw_distractors(camera)
            drawn["composite"] = color + (1.0 - alpha) * drawn["rgb"]
            drawn["distractor_alpha"] = alpha
        return drawn

    def get_loss_dict(self, outputs: dict, batch: dict, metrics_dict: dict | None = None) -> dict[str, Tensor]:
        """splatfacto's loss of the composite, and the two regularizers."""
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        if self.training:
            losses["distractors"] = self.config.distractor_weight * outputs["distractor_alpha"].mean()
            losses["emptiness"] = self.config.emptiness_weight * (1.0 - outputs["accumulation"]).mean()
        return losses

    def step_post_backward(self, step: int) -> None:
        """Densify the scene as splatfacto does; note where distractors are pulled, and move those of no use."""
        super().step_post_backward(step)
        if self._centers.grad is not None:
            self._pull[self._view] += self._centers.grad.reshape(-1, 2).norm(dim=1)
        epochs = self.config.distractor_refine_epochs * len(self._pull)
        if self.config.warmup_length < step < self.config.stop_split_at and step % epochs == 0:
            for view in range(len(self._pull)):
                self._move_transparent(view)
            self._pull.zero_()

    def _draw_distractors(self, camera: Cameras) -> tuple[Tensor, Tensor]:
        """Premultiplied color [H, W, 3] and alpha [H, W, 1] of the Gaussians of a camera's photo."""
        self._view, reduction = metadata(camera)["cam_idx"], self._get_downscale_factor()
        width, height = frame(camera)
        render, alpha, info = rasterizer(self.config.rasterizer, self.device)(
            means=self._of("means"),
            quats=self._of("quats"),
            scales=torch.exp(self._of("scales")),
            opacities=torch.sigmoid(self._of("opacities")),
            colors=self._of("colors"),
            viewmats=torch.eye(4, device=self.device)[None],
            Ks=intrinsics(camera, reduction),
            width=width // reduction,
            height=height // reduction,
            packed=False,
            rasterize_mode=self.config.rasterize_mode,
        )
        self._centers = info["means2d"]
        self._centers.retain_grad()
        return render[0], alpha[0]

    @torch.no_grad()
    def _move_transparent(self, view: int) -> None:
        """Put each transparent Gaussian of a photo onto one that is pulled much, and make both smaller."""
        self._view = view
        dead = (torch.sigmoid(self._of("opacities")) < self.config.cull_alpha_thresh).nonzero()[:, 0]
        dead = dead[: self._pull.shape[1] // 2]
        pulled = self._pull[view].index_fill(0, dead, -1.0).argsort(descending=True)[: len(dead)]
        self._of("scales")[pulled] -= math.log(SPLIT)
        for name in RATES:
            parameter = self._of(name)
            parameter[dead] = parameter[pulled]
            for moment in self.optimizers[f"distractor_{name}"].state.get(parameter, {}).values():
                if moment.dim():
                    moment[dead] = 0.0
        self._of("means")[dead] += torch.randn(len(dead), 3, device=self.device) * torch.exp(self._of("scales")[dead])

    def _of(self, name: str) -> nn.Parameter:
        """A parameter of the current photo's Gaussians."""
        values = self.beside[f"distractor_{name}"]
        assert isinstance(values, nn.ParameterList)
        return values[self._view]


BASELINE = Baseline(
    DesplatConfig,
    learning_rates={f"distractor_{name}": rate for name, rate in RATES.items()},
    per_photo=True,
)
