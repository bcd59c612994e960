"""Which Gaussians are listed in which tiles: all that are blended there, in gsplat's order, and hardly any others."""

from __future__ import annotations

import pytest
import torch
from conftest import check_in_tritons_interpreter
from recordings import CUDA
from torch import Tensor

from ssa_nerfstudio.rasterization import tile_lists
from ssa_nerfstudio.rasterization.cuda import project, rasterize_to_pixels
from ssa_nerfstudio.rasterization.interface import Cameras, Gaussians, RenderOptions

INTERPRETED = """
import math
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _isect_offset_encode, _isect_tiles
from ssa_nerfstudio.rasterization import _tile_lists_triton
from ssa_nerfstudio.rasterization._tile_lists_triton import listed
from ssa_nerfstudio.rasterization.constants import ALPHA_MIN, EPS2D, TILE

WIDTH, HEIGHT, N = 90, 60, 400
COLUMNS, ROWS = math.ceil(WIDTH / TILE), math.ceil(HEIGHT / TILE)
generator = torch.Generator().manual_seed(0)
# Of all sizes, shapes and opacities, some of them outside of the frame, some at the same depth.
means = 2 * torch.randn(N, 3, generator=generator) + torch.tensor([0.0, 0.0, 6.0])
means[::7, 2] = 5.0
roots = torch.randn(N, 3, 3, generator=generator) * 10 ** (2 * torch.rand(N, 1, 3, generator=generator) - 2.5)
K = torch.tensor([[80.0, 0.0, WIDTH / 2], [0.0, 80.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
radii, means2d, depths, conics, _ = _fully_fused_projection(
    means, roots @ roots.mT, torch.eye(4)[None], K[None], WIDTH, HEIGHT, eps2d=EPS2D
)
alphas = 10 ** -(4 * torch.rand(1, N, generator=generator))
alphas[0, :4] = torch.tensor([0.0, 1.0, ALPHA_MIN, 0.5])

def by_tile(offsets, ids):
    ends = [*offsets.flatten().tolist(), len(ids)]
    return [ids[a:b].tolist() for a, b in zip(ends, ends[1:])]

given = [each[0] for each in (means2d, conics, alphas, depths, radii)]
offsets, ids = listed(*given, WIDTH, HEIGHT)
assert offsets.dtype == ids.dtype == torch.int32 and offsets.shape == (ROWS, COLUMNS)
mine = by_tile(offsets, ids)
_, isect_ids, flatten_ids = _isect_tiles(means2d, radii, depths, TILE, COLUMNS, ROWS)
gsplats = by_tile(_isect_offset_encode(isect_ids, 1, COLUMNS, ROWS), flatten_ids)
ys, xs = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
x, y = xs[..., None] - means2d[0, :, 0], ys[..., None] - means2d[0, :, 1]
xx, xy, yy = conics[0].unbind(dim=-1)
shown = alphas[0] * torch.exp(-0.5 * (xx * x * x + yy * y * y) - xy * x * y) >= ALPHA_MIN
needed = 0
for tile, (own, others) in enumerate(zip(mine, gsplats, strict=True)):
    row, column = divmod(tile, COLUMNS)
    here = shown[TILE * row : TILE * (row + 1), TILE * column : TILE * (column + 1)].any(dim=0).any(dim=0)
    # gsplat's order on CUDA, whose sort is stable: of the same depth, the earlier first.
    others = sorted(others, key=lambda each: (float(depths[0, each]), each))
    assert own == [each for each in others if each in set(own)]
    blended = {each for each in others if here[each]}
    assert blended <= set(own)
    needed += len(blended)
total, of_gsplat = len(ids), len(flatten_ids)
assert needed <= total < 1.1 * needed + 5 < 0.6 * of_gsplat, (needed, total, of_gsplat)

# Of a frame with more tiles than 16 bits tell apart, tiles are sorted by longer numbers.
_tile_lists_triton._MOST_OF_16_BITS = ROWS * COLUMNS - 1
assert all(torch.equal(a, b) for a, b in zip(listed(*given, WIDTH, HEIGHT), (offsets, ids), strict=True))

# What is not a number stays in all of its square, so that the guards see it.
alphas[0, 1] = torch.nan
conics[0, 3] = torch.nan
mine = by_tile(*listed(*given, WIDTH, HEIGHT))
for each in (1, 3):
    assert [each in own for own in mine] == [each in own for own in gsplats]
# Nothing to draw: every tile's list is empty.
offsets, ids = listed(*given[:4], torch.zeros_like(radii[0]), WIDTH, HEIGHT)
assert len(ids) == 0 and not offsets.any()
print("equal")
"""


def test_tiles_list_all_that_is_blended_and_little_else_in_tritons_interpreter():
    check_in_tritons_interpreter(INTERPRETED)


def scene(count: int, stretch: float) -> Gaussians:
    generator = torch.Generator().manual_seed(count)
    scales = torch.exp(torch.randn(count, 3, generator=generator) * stretch - 3.5)
    means = 2 * torch.randn(count, 3, generator=generator) + torch.tensor([0.0, 0.0, 5.0])
    quats, opacities = torch.randn(count, 4, generator=generator), torch.rand(count, generator=generator) ** 3
    return Gaussians(*(each.cuda() for each in (means, quats, scales, opacities, torch.rand(count, 3))))


@pytest.mark.parametrize("device", [CUDA])
@pytest.mark.parametrize("size", [(640, 480), (4096, 2176)])
@pytest.mark.parametrize("stretch", [0.5, 2.0])
def test_images_are_those_of_gsplats_lists_to_the_last_bit(monkeypatch, device, size, stretch):
    """4096 x 2176 pixels have more tiles than a number of 16 bits tells apart."""
    gaussians, (width, height) = scene(20_000, stretch), size
    K = torch.tensor([[0.6 * width, 0.0, width / 2], [0.0, 0.6 * width, height / 2], [0.0, 0.0, 1.0]], device=device)
    options = RenderOptions(
        near_plane=0.01, far_plane=1e10, radius_clip=0.0, eps2d=0.3, sh_degree=None, render_mode="RGB", absgrad=False,
        antialiased=False,
    )  # fmt: skip
    cameras = Cameras(torch.eye(4, device=device)[None], K[None], width, height, None)
    projected = project(gaussians, cameras, options)
    means2d, conics, alphas, depths, radii = projected

    def picture() -> tuple[Tensor, Tensor, Tensor]:
        offsets, ids = tile_lists.tile_lists(means2d, conics, alphas, depths, radii, width, height)
        colors = gaussians.colors[None].contiguous()
        return *rasterize_to_pixels(means2d, conics, colors, alphas, width, height, 16, offsets, ids), ids

    image, alpha, ids = picture()
    monkeypatch.setattr(tile_lists, "_TRITON", False)
    expected, expected_alpha, gsplats = picture()
    assert torch.equal(image, expected)
    assert torch.equal(alpha, expected_alpha)
    assert 0 < len(ids) < 0.7 * len(gsplats)
