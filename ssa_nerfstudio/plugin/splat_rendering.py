"""From splatfacto's parameters to a render.

On CUDA, the projection is one CUDA graph while training. What is recorded are the activations of the
parameters and the projection. Spherical harmonics cannot be (`cuda.shade`). Sorting and blending are launched one by
one, because the number of tiles that the Gaussians cover differs from view to view; with SSA_CUDA_GRAPHS=blending they
are another CUDA graph, in lists with room to spare (`RecordedBlending`). A refinement makes other Gaussians, and with
them new recordings.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ssa_nerfstudio._system.cuda_graphs import CapturedPrograms, RecordedCalls, graphs_are_usable
from ssa_nerfstudio.rasterization import RasterizerName, rasterizer
from ssa_nerfstudio.rasterization.constants import EPS2D, FAR_PLANE
from ssa_nerfstudio.rasterization.interface import Cameras, Gaussians, RenderOptions, info_of

if TYPE_CHECKING:
    from ssa_nerfstudio.rasterization.recorded_blending import RecordedBlending

PARAMETERS = ("means", "quats", "scales", "opacities", "features_dc", "features_rest")
"""Of the Gaussians, by the names that splatfacto gives them."""
MOST_RECORDED = 250_000
"""Gaussians up to which a projection is recorded: the more there are, the less a step waits for its host, and a
recording keeps copies of their gradients. Source: docs/results.md, "Large scenes"."""


class SplatRenderer:
    """Renders Gaussians of which the parameters are given as they are learned."""

    def __init__(self, name: RasterizerName, guarded: bool = True) -> None:
        """Render with a rasterizer; `guarded`: steps that are not finite are skipped, as `RecordedBlending` wants."""
        self._name: RasterizerName = name
        self._guarded = guarded
        self.projections = RecordedCalls(CapturedPrograms)
        self._blending: RecordedBlending | None = None

    def __call__(
        self,
        parameters: Mapping[str, Tensor],
        viewmats: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
        **options: Any,
    ) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Render as `interface.make_rasterization` describes.

        Args:
            parameters: of N Gaussians, at least `PARAMETERS`.
            viewmats, Ks, width, height: cameras.
            options: near_plane, sh_degree, render_mode, absgrad and rasterize_mode.
        """
        device = parameters["means"].device
        gsplat = device.type == "cuda" and self._name in ("auto", "gsplat")
        few = len(parameters["means"]) <= MOST_RECORDED
        if not few:
            # Those of fewer, before the last refinement.
            self.projections.forget()
            self._blending = None
        if gsplat and few and torch.is_grad_enabled() and options["render_mode"] == "RGB" and graphs_are_usable():
            antialiased = options.pop("rasterize_mode") == "antialiased"
            settings = RenderOptions(
                far_plane=FAR_PLANE, radius_clip=0.0, eps2d=EPS2D, antialiased=antialiased, **options
            )
            cameras = Cameras(viewmats, Ks, width, height, None)
            return render_recorded(self.projections, self._recorded_blending(), parameters, cameras, settings)
        gaussians = activated(parameters, options["sh_degree"] is not None)
        draw = rasterizer(self._name, device)
        return draw(**gaussians._asdict(), viewmats=viewmats, Ks=Ks, width=width, height=height, **options)

    def _recorded_blending(self) -> RecordedBlending | None:
        """What blends in one launch; None where kernels are launched one by one."""
        if not self._guarded or os.environ.get("SSA_CUDA_GRAPHS") != "blending":
            return None
        if self._blending is None:
            from ssa_nerfstudio.rasterization.recorded_blending import RecordedBlending

            self._blending = RecordedBlending()
        return self._blending


def activated(parameters: Mapping[str, Tensor], with_harmonics: bool) -> Gaussians:
    """Gaussians of splatfacto's parameters, of which `features_rest` counts only with harmonics."""
    means, quats, scales, opacities, constant, rest = (parameters[name] for name in PARAMETERS)
    colors = torch.cat([constant[:, None], rest], dim=1) if with_harmonics else torch.sigmoid(constant)
    return Gaussians(means, quats, torch.exp(scales), torch.sigmoid(opacities).squeeze(-1), colors)


def render_recorded(
    calls: RecordedCalls,
    blending: RecordedBlending | None,
    parameters: Mapping[str, Tensor],
    cameras: Cameras,
    options: RenderOptions,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render with gsplat's kernels, the projection as a recording.

    Args:
        calls: of this training.
        blending: of this training; None: kernels are launched one by one.
        parameters: of N Gaussians, `PARAMETERS`.
        cameras: without a background.
        options: with `render_mode` RGB.

    Returns:
        As of `interface.make_rasterization`.
    """
    from ssa_nerfstudio.rasterization import cuda

    def compute(viewmats: Tensor, Ks: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
        gaussians = activated(dict(zip(PARAMETERS, values, strict=True)), options.sh_degree is not None)
        projected = cuda.project(gaussians, cameras._replace(viewmats=viewmats, Ks=Ks), options)
        # Depths sort, and are no part of the picture.
        projected = projected._replace(depths=projected.depths.detach())
        return gaussians.colors, *(each for each in projected if each is not None)

    kind, degree = (cameras.width, cameras.height, *vars(options).values()), options.sh_degree
    views, learned = [cameras.viewmats, cameras.Ks], [parameters[name] for name in PARAMETERS]
    colors, *rest = calls(compute, views, learned, kind, epoch=degree)  # a training does not go back to one
    means2d, conics, alphas, depths, radii, *directions = rest
    projected = cuda.Projected(means2d, conics, alphas, depths, radii, directions[0] if directions else None)
    blend = blending or cuda.blend
    image, alpha = blend(projected, cuda.shade(projected, colors, options), cameras, options)
    return image, alpha, info_of(projected.radii, projected.means2d, cameras.width, cameras.height)
