"""SpotLessSplats (Sabour et al., TOG 2025): outliers by residual, grouped by what they look like.

`mlp`: a small network learns from features and position of a pixel how likely it is an inlier, between two bounds that
residuals set. `agg`: photos are segmented by their features, and a segment is an inlier if more than half of it is.
Source: the paper and its code (Apache-2.0), written anew.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ssa_nerfstudio.experiments.benchmark.baselines.baseline import Baseline, Count, Share
from ssa_nerfstudio.experiments.benchmark.baselines.dense_features import WEIGHTS, diffusion, hand_made, ward_clusters
from ssa_nerfstudio.experiments.benchmark.baselines.diffusion_weights import require
from ssa_nerfstudio.experiments.benchmark.baselines.robustnerf import BASELINE as ROBUST
from ssa_nerfstudio.experiments.benchmark.baselines.robustnerf import RobustConfig, RobustModel, inliers
from ssa_nerfstudio.plugin.datamanager import SSADatamanager

FREQUENCIES = 20
"""Of the encoding of a position: sine and cosine of each, for row and column."""
HIDDEN = 16
LIPSCHITZ_WEIGHT = 0.5
"""Weight of max |W0| max |W1|, which keeps the network smooth."""


class InlierNetwork(nn.Module):
    """Probability that a pixel is an inlier: features and position, a hidden layer of 16, a sigmoid."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.by_feature = nn.Linear(features, HIDDEN)
        self.by_row = nn.Linear(2 * FREQUENCIES, HIDDEN, bias=False)
        self.by_column = nn.Linear(2 * FREQUENCIES, HIDDEN, bias=False)
        self.last = nn.Linear(HIDDEN, 1)
        start = (features + 4 * FREQUENCIES) ** -0.5  # of one layer that reads all of these
        for parameter in (self.by_feature.weight, self.by_feature.bias, self.by_row.weight, self.by_column.weight):
            nn.init.uniform_(parameter, -start, start)

    def forward(self, features: Tensor, height: int, width: int) -> Tensor:
        """[height, width, 1] in (0, 1), of features [C, h, w].

        The first layer is linear, as the upsampling of the features is: it is applied to the grid's cells, and to the
        rows and columns apart. The result is that of the original, which upsamples hundreds of channels first.
        """
        grid = self.by_feature(features.permute(1, 2, 0)).permute(2, 0, 1)[None]
        hidden = F.interpolate(grid, size=(height, width), mode="bilinear")[0].permute(1, 2, 0)
        rows = self.by_row(_encoded(height, features.device))[:, None]
        columns = self.by_column(_encoded(width, features.device))
        return torch.sigmoid(self.last(torch.relu(hidden + rows + columns)))

    def regularizer(self) -> Tensor:
        """max |W0| max |W1|."""
        first = torch.cat([layer.weight.flatten() for layer in (self.by_feature, self.by_row, self.by_column)])
        return first.abs().max() * self.last.weight.abs().max()


def _encoded(length: int, device: torch.device) -> Tensor:
    """Positions x in [0, 1] as sines and cosines of pi 2^k x for k < FREQUENCIES: [length, 2 FREQUENCIES]."""
    octaves = torch.pi * 2.0 ** torch.arange(FREQUENCIES, device=device)
    phase = torch.linspace(0, 1, length, device=device)[:, None] * octaves
    return torch.cat([torch.sin(phase), torch.cos(phase)], dim=-1)


def bounds_loss(probability: Tensor, least: Tensor, most: Tensor) -> Tensor:
    """mean(relu(m - U) + relu(L - m)) of probabilities m and bounds L and U, all of one shape."""
    return (torch.relu(probability - most) + torch.relu(least - probability)).mean()


def segment_votes(inlier: Tensor, labels: Tensor) -> Tensor:
    """1 where more than half of a pixel's segment is inlier, both [H, W, 1]; labels [h, w] are of a coarser grid."""
    enlarged = F.interpolate(labels[None, None].float(), size=inlier.shape[:2], mode="nearest")[0, 0].long()
    count = int(labels.max()) + 1
    size = torch.bincount(enlarged.flatten(), minlength=count)
    votes = torch.bincount(enlarged.flatten(), weights=inlier.flatten(), minlength=count)
    return (votes > 0.5 * size)[enlarged][..., None].to(inlier.dtype)


@dataclass
class SpotlessConfig(RobustConfig):
    """Configuration of `SpotlessModel`."""

    _target: type = field(default_factory=lambda: SpotlessModel)
    grouping: Literal["mlp", "agg"] = "mlp"
    """How residuals are spread to what looks alike."""
    features: str = "hand-made"
    """hand-made: DAISY and color, no weights; otherwise a folder with the weights of Stable Diffusion 2.1."""
    least_quantile: Share = 0.5
    """mlp: pixels with residuals below it are inliers."""
    most_quantile: Share = 0.9
    """mlp: pixels with residuals above it are outliers."""
    segments: Count = 100
    """agg: segments of a photo."""


class SpotlessModel(RobustModel):
    """RobustNeRF's loss with a mask that follows the photos' features."""

    config: SpotlessConfig

    def examine(self, datamanager: SSADatamanager) -> None:
        """Compute the features of all photos; segment them, or make the network that reads them."""
        found = self._features(view["image"] for view in datamanager.cached_train)
        if self.config.grouping == "agg":
            self._grids = [ward_clusters(grid, self.config.segments).to(self.device) for grid in found]
        else:
            self._grids = [grid.to(self.device) for grid in found]
            self.beside["inlier_network"] = InlierNetwork(self._grids[0].shape[0]).to(self.device)

    def _features(self, photos: Iterable[Tensor]) -> Iterator[Tensor]:
        """Grids of features of cached photos [H, W, 3 or 4]."""
        if self.config.features == "hand-made":
            # At the resolution that training starts with: 50 cells along a side need no more.
            return hand_made(self.get_gt_img(photo)[..., :3] for photo in photos)
        whole = (photo[..., :3].float() / (255.0 if photo.dtype == torch.uint8 else 1.0) for photo in photos)
        return diffusion(Path(self.config.features), whole, self.device)

    def inlier_weights(self, residuals: Tensor, batch: dict) -> Tensor:
        """The share of a segment's inliers, or the network's output; its bounds are kept for the loss."""
        histogram, grid = self.residuals, self._grids[batch["image_idx"]]
        quantiles = (self.config.least_quantile, self.config.most_quantile)
        least, most = (inliers(residuals, histogram.quantile(share)) for share in quantiles)
        inlier = super().inlier_weights(residuals, batch)
        if self.config.grouping == "agg":
            return segment_votes(inlier, grid)
        self._predicted = self._network()(grid, *residuals.shape[:2])
        self._bounds = least, most
        return self._predicted.detach()

    def get_loss_dict(self, outputs: dict, batch: dict, metrics_dict: dict | None = None) -> dict[str, Tensor]:
        """The masked loss of the scene, and the loss of the network, which share no parameters."""
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        if self.training and self.config.grouping == "mlp":
            losses["inlier_network"] = bounds_loss(self._predicted, *self._bounds)
            losses["inlier_network"] += LIPSCHITZ_WEIGHT * self._network().regularizer()
        return losses

    def _network(self) -> InlierNetwork:
        network = self.beside["inlier_network"]
        assert isinstance(network, InlierNetwork)
        return network


def _require_features(settings: dict[str, Any]) -> None:
    """Refuse features whose weights are not there."""
    if (features := settings.get("features", "hand-made")) != "hand-made":
        require(features, WEIGHTS)


BASELINE = Baseline(SpotlessConfig, ROBUST.settings, learning_rates={"inlier_network": 1e-3}, check=_require_features)
