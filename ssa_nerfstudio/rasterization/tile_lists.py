"""Which Gaussians are blended in which tiles of 16 x 16 pixels.

gsplat lists a Gaussian in all tiles of a square of three standard deviations of its longest axis. In most of them an
elongated or transparent one has no pixel. The kernels here leave these tiles out; what is blended is the same, in the
same order.
"""

from __future__ import annotations

import importlib.util
import math

import torch
from gsplat import isect_offset_encode, isect_tiles
from torch import Tensor

from ssa_nerfstudio.rasterization.constants import TILE

_TRITON = importlib.util.find_spec("triton") is not None


@torch.no_grad()
def tile_lists(
    means2d: Tensor, conics: Tensor, alphas: Tensor, depths: Tensor, radii: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """List the Gaussians of each tile. It reads the device once.

    On CUDA, for one camera, by two Triton kernels; else gsplat's lists.

    Args:
        means2d: centers [C, N, 2], pixels.
        conics: inverses of the covariances [C, N, 3]: xx, xy, yy.
        alphas: [C, N], at the centers.
        depths: [C, N], positive where anything is drawn.
        radii: [C, N] int32, pixels; 0: not drawn.
        width, height: of the image, pixels.

    Returns:
        Where each tile's Gaussians begin, int32 [C, rows, columns], and all of them, nearest first, int32 [M].
    """
    n_cameras = len(means2d)
    if _TRITON and means2d.is_cuda and n_cameras == 1 and radii.shape[1] > 0:
        from ssa_nerfstudio.rasterization._tile_lists_triton import listed

        offsets, ids = listed(means2d[0], conics[0], alphas[0], depths[0], radii[0], width, height)
        return offsets[None], ids
    size = math.ceil(width / TILE), math.ceil(height / TILE)
    _, isect_ids, ids = isect_tiles(means2d, radii, depths, TILE, *size, packed=False, n_cameras=n_cameras)
    return isect_offset_encode(isect_ids, n_cameras, *size), ids
