"""What adaptive density control sums up of every training view, for its next refinement."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

import torch
from torch import Tensor

_TRITON = importlib.util.find_spec("triton") is not None


@dataclass(frozen=True, eq=False)
class GradientStatistics:
    """Sums over views of N Gaussians, as gsplat's `DefaultStrategy` keeps them."""

    gradients: Tensor
    """[N], of the norms of the centers' gradients, in units of half an image."""
    counts: Tensor
    """[N], of the views that showed a Gaussian."""
    largest: Tensor | None
    """[N], largest radius so far, as a share of the image's longer side; None: not wanted."""

    @torch.no_grad()
    def add(
        self, gradients: Tensor, radii: Tensor, width: int, height: int, n_cameras: int, taken: Tensor | None
    ) -> None:
        """Add one view, with zeros for invisible Gaussians: a list of the visible ones would wait for the device.

        One launch where Triton's kernels run; elsewhere ten on CUDA. Gradients that are not finite spoil a sum.

        Args:
            gradients: of the centers [N, 2], pixels.
            radii: [N], pixels; 0 where a Gaussian is invisible.
            width, height: of the image.
            n_cameras: over which the loss is a mean.
            taken: scalar; where it is 0, nothing changes. None: 1.
        """
        half, aspect, longer = 0.5 * n_cameras * width, height / width, float(max(width, height))
        if gradients.is_cuda and _TRITON:
            from ssa_nerfstudio.plugin.training._gradient_statistics_triton import add_view

            add_view(self.gradients, self.counts, self.largest, gradients, radii, taken, half, aspect, 1.0 / longer)
            return
        visible = radii > 0 if taken is None else radii * taken > 0
        # With respect to coordinates that run over [-1, 1] across the image.
        norms = torch.hypot(gradients[:, 0], gradients[:, 1] * aspect)
        self.gradients.add_(torch.where(visible, norms, 0.0), alpha=half)
        self.counts.add_(visible)
        if self.largest is not None:
            torch.maximum(self.largest, torch.where(visible, radii, 0) / longer, out=self.largest)
