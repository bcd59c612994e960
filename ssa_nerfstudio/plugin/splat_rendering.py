"""From splatfacto's parameters to a render.

On CUDA, the projection is one CUDA graph in training steps whose losses are one, too: the activations of the
parameters, the projection and the colors. Sorting and blending are launched one by one, because the number of tiles
that the Gaussians cover differs from view to view. A refinement makes other Gaussians, and with them new recordings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from ssa_nerfstudio._system.cuda_graphs import CapturedPrograms, RecordedCalls, graphs_are_usable
from ssa_nerfstudio._system.gradients_by_hand import Evaluation
from ssa_nerfstudio.rasterization import RasterizerName, rasterizer
from ssa_nerfstudio.rasterization.constants import EPS2D, FAR_PLANE
from ssa_nerfstudio.rasterization.interface import Cameras, Gaussians, RenderOptions, info_of

if TYPE_CHECKING:
    from ssa_nerfstudio.rasterization.cuda import Blending

PARAMETERS = ("means", "quats", "scales", "opacities", "features_dc", "features_rest")
"""Of the Gaussians, by the names that splatfacto gives them."""
MOST_RECORDED = 250_000
"""Gaussians up to which a projection is recorded: the more there are, the less a step waits for its host, and a
recording keeps copies of their gradients. Source: docs/results.md, "Large scenes"."""


class LearnedRender(NamedTuple):
    """A render of a training view, from where its gradient goes back to the parameters of the Gaussians."""

    image: Tensor  # [1, H, W, 3], over nothing
    alpha: Tensor  # [1, H, W, 1]
    info: dict[str, Any]  # see `interface.make_rasterization`
    parts: RenderParts | None = None  # None: autograd knows of it

    def backpropagate(self, of_image: Tensor | None, of_alpha: Tensor | None) -> None:
        """Add to the gradients of all that is learned, given those of the image and of alpha (None: 0); once."""
        picture = (self.image, of_image), (self.alpha, of_alpha)
        slopes = [torch.zeros_like(value) if slope is None else slope for value, slope in picture]
        if self.parts is None:
            torch.autograd.backward([self.image, self.alpha], slopes)
            return
        views, projection, blending = self.parts
        of_views = projection.backpropagate(blending.backpropagate(*slopes))
        for view, gradient in zip(views, of_views, strict=True):
            if gradient is not None:  # of a camera that is learned
                view.backward(gradient)


class RenderParts(NamedTuple):
    """What a render is made of where its gradient is taken by hand."""

    views: tuple[Tensor, ...]  # the projection's inputs
    projection: Evaluation
    blending: Blending


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
        if torch.is_grad_enabled() and options["render_mode"] == "RGB" and self._is_gsplat(device):
            cameras = Cameras(viewmats, Ks, width, height, None)
            return render_learned(None, parameters, cameras, _settings(options))[:3]
        gaussians = activated(parameters, options["sh_degree"] is not None)
        draw = rasterizer(self._name, device)
        return draw(**gaussians._asdict(), viewmats=viewmats, Ks=Ks, width=width, height=height, **options)

    def learned(
        self,
        parameters: Mapping[str, Tensor],
        viewmats: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
        **options: Any,
    ) -> LearnedRender:
        """Render a training view, on CUDA with a recorded projection; arguments as of a call, with render_mode RGB."""
        count, device = len(parameters["means"]), parameters["means"].device
        if count > MOST_RECORDED:
            self.projections.forget()  # those of fewer, before the last refinement
        if count > MOST_RECORDED or not self._is_gsplat(device) or not graphs_are_usable():
            return LearnedRender(*self(parameters, viewmats, Ks, width, height, **options))
        cameras = Cameras(viewmats, Ks, width, height, None)
        return render_learned(self.projections, parameters, cameras, _settings(options))

    def _is_gsplat(self, device: torch.device) -> bool:
        return device.type == "cuda" and self._name in ("auto", "gsplat")


def _settings(options: Mapping[str, Any]) -> RenderOptions:
    given = {name: value for name, value in options.items() if name != "rasterize_mode"}
    antialiased = options["rasterize_mode"] == "antialiased"
    return RenderOptions(far_plane=FAR_PLANE, radius_clip=0.0, eps2d=EPS2D, antialiased=antialiased, **given)


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
) -> LearnedRender:
    """Render for a training step with gsplat's kernels, and one of ours for the harmonics.

    Args:
        calls: records the projection; None: its kernels are launched one by one, and autograd takes the gradient. So
            it is without Triton, whose kernel for the colors a recording needs.
        parameters: of N Gaussians, `PARAMETERS`.
        cameras: one, without a background.
        options: with `render_mode` RGB.
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
        return *projected, colors_of(viewmats, projected.radii, values)

    learned, views = [parameters[name] for name in PARAMETERS], (cameras.viewmats, cameras.Ks)
    if calls is None or not (degree is None or harmonics.runs_on_current_stream(learned[0].device, degree)):
        *found, channels = compute(*views, *learned)
        projected = cuda.Projected(*found)
        image, alpha = cuda.blend(projected, channels, cameras, options)
        return LearnedRender(image, alpha, info_of(projected.radii, projected.means2d, cameras.width, cameras.height))
    kind = (cameras.width, cameras.height, *vars(options).values())
    # A training does not go back to a degree.
    projection = calls(compute, views, learned, kind, epoch=degree)
    *found, channels = projection.values
    projected = cuda.Projected(*found)
    blending = cuda.Blending(projected, channels, cameras, options)
    info = info_of(projected.radii, projected.means2d, cameras.width, cameras.height)
    return LearnedRender(blending.image, blending.alpha, info, RenderParts(views, projection, blending))
