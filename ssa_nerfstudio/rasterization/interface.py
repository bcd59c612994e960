"""The interface of all rasterizers here: arguments, checks and results of gsplat's `rasterization`.

An implementation is a `Render`. `make_rasterization` wraps it in the signature, the argument checks and the `info`
dictionary.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from torch import Tensor

from ssa_nerfstudio.rasterization import constants

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]


class Gaussians(NamedTuple):
    """N Gaussians in world space."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4], w x y z, not necessarily normalized
    scales: Tensor  # [N, 3], standard deviations
    opacities: Tensor  # [N], in [0, 1]
    colors: Tensor  # [N, 3], or [N, K, 3] with sh_degree


class Cameras(NamedTuple):
    """C pinhole cameras with one image size."""

    viewmats: Tensor  # [C, 4, 4], world to camera, rigid, OpenCV axes
    Ks: Tensor  # [C, 3, 3], pixels
    width: int
    height: int
    backgrounds: Tensor | None  # [C, 3]


@dataclass
class RenderOptions:
    """Options of a render, as `rasterization` in `make_rasterization` describes them."""

    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    sh_degree: int | None
    render_mode: RenderMode
    absgrad: bool
    antialiased: bool


Render = Callable[[Gaussians, Cameras, RenderOptions], tuple[Tensor, Tensor, Tensor, Tensor]]
"""Returns render [C, H, W, X], alpha [C, H, W, 1], radii [C, N] int32 and means2d [C, N, 2].

Gradients of the projected centers flow through means2d, because densification reads them there; with `absgrad`, the
implementation leaves their summed magnitudes in `means2d.absgrad`.
"""
Rasterization = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]


def info_of(radii: Tensor, means2d: Tensor, width: int, height: int) -> dict[str, Any]:
    """What gsplat's densification strategies read, as `rasterization` in `make_rasterization` describes it."""
    return {
        "camera_ids": None,
        "gaussian_ids": None,
        "radii": radii,
        "means2d": means2d,
        "width": width,
        "height": height,
        "tile_size": constants.TILE,
        "n_cameras": len(means2d),
    }


def make_rasterization(render: Render) -> Rasterization:
    """Wrap an implementation in gsplat's interface; its signature, documentation and checks are in this one place."""

    def rasterization(
        means: Tensor,  # [N, 3]
        quats: Tensor,  # [N, 4]
        scales: Tensor,  # [N, 3]
        opacities: Tensor,  # [N]
        colors: Tensor,  # [N, 3] or [N, K, 3]
        viewmats: Tensor,  # [C, 4, 4]
        Ks: Tensor,  # [C, 3, 3]
        width: int,
        height: int,
        near_plane: float = constants.NEAR_PLANE,
        far_plane: float = constants.FAR_PLANE,
        radius_clip: float = 0.0,
        eps2d: float = constants.EPS2D,
        sh_degree: int | None = None,
        packed: bool = False,
        tile_size: int = constants.TILE,
        backgrounds: Tensor | None = None,  # [C, 3]
        render_mode: RenderMode = "RGB",
        sparse_grad: bool = False,
        absgrad: bool = False,
        rasterize_mode: Literal["classic", "antialiased"] = "classic",
    ) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Rasterize N Gaussians into C pinhole cameras: `gsplat.rasterization` 1.4.0 with three color channels.

        Args:
            means, quats, scales, opacities: as in `Gaussians`.
            colors: RGB [N, 3], or coefficients of spherical harmonics [N, K, 3] with `sh_degree`.
            viewmats, Ks, width, height: as in `Cameras`.
            near_plane, far_plane: depths, in world units, between which the centers of drawn Gaussians lie.
            radius_clip: Gaussians with a projected radius of at most this many pixels are not drawn.
            eps2d: added to the diagonal of the projected covariance, square pixels.
            sh_degree: degree up to which the coefficients are evaluated, (sh_degree + 1)^2 <= K; None for RGB.
            packed, tile_size, sparse_grad: as in gsplat; only their defaults are supported.
            backgrounds: color behind the Gaussians; black where None.
            render_mode: RGB is the color, D the alpha-weighted depth, ED the expected depth, in world units.
            absgrad: leave the summed magnitudes of the centers' gradients in `info["means2d"].absgrad`.
            rasterize_mode: "antialiased" scales opacities by sqrt(det / det with eps2d).

        Returns:
            render [C, H, W, X] with X channels by `render_mode`; alpha [C, H, W, 1]; and `info` with what gsplat's
            densification strategies read: `radii` [C, N] int32, 0 where not drawn, `means2d` [C, N, 2] in pixels,
            `width`, `height`, `n_cameras`, `tile_size`, `gaussian_ids` and `camera_ids` (None: not packed).

        Raises:
            ValueError: an unsupported option, or colors of another shape.
        """
        if packed or sparse_grad or tile_size != constants.TILE:
            raise ValueError("packed, sparse_grad and tile sizes other than 16 are not supported; leave them out")
        if colors.shape[-1] != 3 or colors.dim() != (2 if sh_degree is None else 3):
            raise ValueError(
                f"colors have shape {tuple(colors.shape)}; give [N, 3], or [N, K, 3] together with sh_degree"
            )
        image, alpha, radii, means2d = render(
            Gaussians(means, quats, scales, opacities, colors),
            Cameras(viewmats, Ks, width, height, backgrounds),
            RenderOptions(
                near_plane,
                far_plane,
                radius_clip,
                eps2d,
                sh_degree,
                render_mode,
                absgrad,
                antialiased=rasterize_mode == "antialiased",
            ),
        )
        return image, alpha, info_of(radii, means2d, width, height)

    return rasterization
