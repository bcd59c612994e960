"""From splatfacto's parameters to a render.

On CUDA, the projection is one CUDA graph while training: the activations of the parameters, the projection and the
colors. Sorting and blending are launched one by one, because the number of tiles that the Gaussians cover differs from
view to view. A refinement makes other Gaussians, and with them new recordings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ssa_nerfstudio._system.cuda_graphs import CapturedPrograms, RecordedCalls, graphs_are_usable
from ssa_nerfstudio.rasterization import RasterizerName, rasterizer
from ssa_nerfstudio.rasterization.constants import EPS2D, FAR_PLANE
from ssa_nerfstudio.rasterization.interface import Cameras, Gaussians, RenderOptions, info_of

PARAMETERS = ("means", "quats", "scales", "opacities", "features_dc", "features_rest")
"""Of the Gaussians, by the names that splatfacto gives them."""
MOST_RECORDED = 250_000
"""Gaussians up to which a projection is recorded: the more there are, the less a step waits for its host, and a
recording keeps copies of their gradients. Source: docs/results.md, "Large scenes"."""


class SplatRenderer:
    """Renders Gaussians of which the parameters are given as they are learned."""

    def __init__(self, name: RasterizerName) -> None:
        self._name: RasterizerName = name
        self.projections = RecordedCalls(CapturedPrograms)

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
        learning = torch.is_grad_enabled() and options["render_mode"] == "RGB"
        if len(parameters["means"]) > MOST_RECORDED:
            # Those of fewer, before the last refinement.
            self.projections.forget()
        if learning and device.type == "cuda" and self._name in ("auto", "gsplat"):
            antialiased = options.pop("rasterize_mode") == "antialiased"
            settings = RenderOptions(
                far_plane=FAR_PLANE, radius_clip=0.0, eps2d=EPS2D, antialiased=antialiased, **options
            )
            cameras = Cameras(viewmats, Ks, width, height, None)
            recorded = graphs_are_usable() and len(parameters["means"]) <= MOST_RECORDED
            return render_learned(self.projections if recorded else None, parameters, cameras, settings)
        gaussians = activated(parameters, options["sh_degree"] is not None)
        draw = rasterizer(self._name, device)
        return draw(**gaussians._asdict(), viewmats=viewmats, Ks=Ks, width=width, height=height, **options)


def activated(parameters: Mapping[str, Tensor], with_harmonics: bool) -> Gaussians:
    """Gaussians of splatfacto's parameters, of which `features_rest` counts only with harmonics."""
    means, quats, scales, opacities, constant, rest = (parameters[name] for name in PARAMETERS)
    colors = torch.cat([constant[:, None], rest], dim=1) if with_harmonics else torch.sigmoid(constant)
    return Gaussians(means, quats, torch.exp(scales), torch.sigmoid(opacities).squeeze(-1), colors)


def render_learned(
    calls: RecordedCalls | None,
    parameters: Mapping[str, Tensor],
    cameras: Cameras,
    options: RenderOptions,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render for a training step with gsplat's kernels, and one of ours for the harmonics.

    Args:
        calls: records the projection; None: its kernels are launched one by one.
        parameters: of N Gaussians, `PARAMETERS`.
        cameras: one, without a background.
        options: with `render_mode` RGB.

    Returns:
        As of `interface.make_rasterization`.
    """
    from ssa_nerfstudio.rasterization import cuda, harmonics

    degree = options.sh_degree

    def colors_of(viewmats: Tensor, radii: Tensor, values: Sequence[Tensor]) -> Tensor:
        means, *_, constant, rest = values
        if degree is None:
            return torch.sigmoid(constant)[None]
        return harmonics.shade(means, cuda.centers(viewmats)[0], constant, rest, radii[0], degree)[None]

    def compute(viewmats: Tensor, Ks: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
        means, quats, scales, opacities, constant, _ = values
        gaussians = Gaussians(means, quats, torch.exp(scales), torch.sigmoid(opacities).squeeze(-1), constant)
        projected = cuda.project(gaussians, cameras._replace(viewmats=viewmats, Ks=Ks), options)
        # Depths sort, and are no part of the picture.
        projected = projected._replace(depths=projected.depths.detach())
        return (*projected, *([colors_of(viewmats, projected.radii, values)] if with_colors else ()))

    learned = [parameters[name] for name in PARAMETERS]
    with_colors = degree is None or harmonics.runs_on_current_stream(learned[0].device, degree)
    views, kind = [cameras.viewmats, cameras.Ks], (cameras.width, cameras.height, *vars(options).values())
    # A training does not go back to a degree.
    found = calls(compute, views, learned, kind, epoch=degree) if calls else compute(*views, *learned)
    projected = cuda.Projected(*found[: len(cuda.Projected._fields)])
    channels = found[-1] if with_colors else colors_of(cameras.viewmats, projected.radii, learned)
    image, alpha = cuda.blend(projected, channels, cameras, options)
    return image, alpha, info_of(projected.radii, projected.means2d, cameras.width, cameras.height)
