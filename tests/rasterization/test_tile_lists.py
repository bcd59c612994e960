"""Which Gaussians are listed in which tiles: all that are blended there, in gsplat's order, and hardly any others."""

from __future__ import annotations

import sys
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch
from conftest import check_in_tritons_interpreter
from gsplat.cuda import _torch_impl
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

def by_tile(offsets, ids):
    ends = [*offsets.flatten().tolist(), len(ids)]
    return [ids[a:b].tolist() for a, b in zip(ends, ends[1:])]

def of_gsplat(means2d, conics, alphas, depths, radii, width, height):
    columns, rows = math.ceil(width / TILE), math.ceil(height / TILE)
    _, isect_ids, ids = _isect_tiles(means2d[None], radii[None], depths[None], TILE, columns, rows)
    return _isect_offset_encode(isect_ids, 1, columns, rows), ids

def check(means2d, conics, alphas, depths, radii, width, height):
    # What is blended in a tile is listed there, in gsplat's order; numbers of entries: blended, listed, gsplat's.
    given = means2d, conics, alphas, depths, radii, width, height
    (offsets, ids), (places, others) = listed(*given), of_gsplat(*given)
    columns, rows = math.ceil(width / TILE), math.ceil(height / TILE)
    assert offsets.dtype == ids.dtype == torch.int32 and offsets.shape == (rows, columns)
    tile = torch.searchsorted(places.flatten(), torch.arange(len(others)), right=True) - 1
    corner = TILE * torch.stack([tile % columns, tile // columns], dim=-1)
    within = torch.stack(torch.meshgrid(torch.arange(TILE), torch.arange(TILE), indexing="xy"), dim=-1).reshape(-1, 2)
    blended = []
    for some, at in zip(others.split(4096), corner.split(4096)):
        pixel = at[:, None] + within
        x, y = (pixel + 0.5 - means2d[some][:, None]).unbind(dim=-1)
        xx, xy, yy = conics[some][:, None].unbind(dim=-1)
        sigma = 0.5 * (xx * x * x + yy * y * y) + xy * x * y
        shown = (sigma >= 0) & (alphas[some][:, None] * torch.exp(-sigma) >= ALPHA_MIN)
        blended.append((shown & (pixel[..., 0] < width) & (pixel[..., 1] < height)).any(dim=1))
    needed = [set() for _ in range(rows * columns)]
    for number, each in zip(tile[torch.cat(blended)].tolist(), others[torch.cat(blended)].tolist()):
        needed[number].add(each)
    for own, all_, wanted in zip(by_tile(offsets, ids), by_tile(places, others), needed, strict=True):
        if own or wanted:
            # gsplat's order on CUDA, whose sort is stable: of the same depth, the earlier first.
            all_ = sorted(all_, key=lambda each: (float(depths[each]), each))
            assert own == [each for each in all_ if each in set(own)]
            assert wanted <= set(own), wanted - set(own)
    return sum(map(len, needed)), len(ids), len(others)

def projected(means, covars, width, height):
    K = torch.tensor([[80.0, 0.0, width / 2], [0.0, 80.0, height / 2], [0.0, 0.0, 1.0]])
    radii, means2d, depths, conics, _ = _fully_fused_projection(
        means, covars, torch.eye(4)[None], K[None], width, height, eps2d=EPS2D
    )
    return means2d[0], conics[0], depths[0], radii[0]

# Of all sizes, shapes and opacities, some of them outside of the frame, some at the same depth.
WIDTH, HEIGHT, N = 90, 60, 400
generator = torch.Generator().manual_seed(0)
means = 2 * torch.randn(N, 3, generator=generator) + torch.tensor([0.0, 0.0, 6.0])
means[::7, 2] = 5.0
roots = torch.randn(N, 3, 3, generator=generator) * 10 ** (2 * torch.rand(N, 1, 3, generator=generator) - 2.5)
means2d, conics, depths, radii = projected(means, roots @ roots.mT, WIDTH, HEIGHT)
alphas = 10 ** -(4 * torch.rand(N, generator=generator))
alphas[:4] = torch.tensor([0.0, 1.0, ALPHA_MIN, 0.5])
given = means2d, conics, alphas, depths, radii, WIDTH, HEIGHT
needed, total, most = check(*given)
assert needed <= total < 1.1 * needed + 5 < 0.6 * most, (needed, total, most)

# Needles, hundreds of pixels long and half a one thin, of which the frame shows an end: in float32 their exponents err
# by so much that pixels beyond the ellipse are blended.
count = 400
length, angle = 400 * 4 ** torch.rand(count, generator=generator), torch.pi * torch.rand(count, generator=generator)
along = length[:, None] * torch.stack([angle.cos(), angle.sin()], dim=-1)
from_center = (2 + 1.4 * torch.rand(count, 1, generator=generator)) * along
places = 128 * torch.rand(count, 2, generator=generator) - 64 + from_center
means = torch.nn.functional.pad(places / 80, (0, 1), value=1.0)
axis = torch.nn.functional.pad(along / 80, (0, 1))
means2d, conics, depths, radii = projected(means, axis[:, :, None] * axis[:, None], 128, 128)
needed, total, most = check(means2d, conics, torch.ones(count), depths, radii, 128, 128)
assert 500 < needed and total < 1.25 * needed < 0.3 * most, (needed, total, most)

# Discs that reach the first center of a pixel of a tile by a thousandth of a pixel: from the left and the right, from
# above and below.
deviation = torch.tensor([0.6, 1.0, 1.7, 2.6])
reach = deviation * math.sqrt(2 * math.log(1 / ALPHA_MIN)) - 0.001
ways = [(32.5, 40.5, -1, 0), (47.5, 40.5, 1, 0), (40.5, 32.5, 0, -1), (40.5, 47.5, 0, 1)]
means2d = torch.cat([torch.tensor([[x, y]]) + reach[:, None] * torch.tensor([[u, v]]) for x, y, u, v in ways])
deviation = deviation.repeat(4)[:, None]
conics = torch.tensor([1.0, 0.0, 1.0]) / deviation.square()
depths, radii = torch.arange(16) + 1.0, (4 * deviation[:, 0]).ceil().int()
given_discs = means2d, conics, torch.ones(16), depths, radii, 80, 80
needed, total, _ = check(*given_discs)
assert by_tile(*listed(*given_discs))[5 * 2 + 2] == list(range(16))

# Of frames with more tiles than 16 bits tell apart, tiles are sorted by longer numbers.
width = 40_000 * TILE
means2d = torch.stack([torch.linspace(-9, width + 9, 41), torch.linspace(-5, 21, 41)], dim=-1)
conics = torch.tensor([0.02, 0.01, 0.03]).expand(41, 3)
given_wide = means2d, conics, torch.ones(41), torch.linspace(2, 1, 41), torch.full((41,), 30, dtype=torch.int32)
needed, total, most = check(*given_wide, width, TILE)
assert 41 <= needed <= total <= most
# A narrow frame's lists are the same by either.
expected, _tile_lists_triton._MOST_OF_16_BITS = listed(*given), 0
assert all(torch.equal(a, b) for a, b in zip(listed(*given), expected, strict=True))

# What is not a number stays in all of its square, so that the guards see it.
means2d, conics, alphas, depths, radii, *_ = given
alphas[1] = torch.nan
conics[3] = torch.nan
mine, gsplats = by_tile(*listed(*given)), by_tile(*of_gsplat(*given))
for each in (1, 3):
    assert [each in own for own in mine] == [each in own for own in gsplats]
# Nothing to draw: every tile's list is empty.
offsets, ids = listed(*given[:4], torch.zeros_like(radii), WIDTH, HEIGHT)
assert len(ids) == 0 and not offsets.any()
print("equal")
"""


def test_tiles_list_all_that_is_blended_and_little_else_in_tritons_interpreter():
    check_in_tritons_interpreter(INTERPRETED)


def isect_tiles(means2d, radii, depths, tile_size, columns, rows, packed, n_cameras):
    """gsplat's, as it runs anywhere."""
    assert not packed
    assert n_cameras == len(means2d)
    return _torch_impl._isect_tiles(means2d, radii, depths, tile_size, columns, rows)


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("count", [0, 30])
def test_without_kernels_tiles_list_all_in_their_squares_camera_by_camera(monkeypatch, cameras, count):
    monkeypatch.setattr(tile_lists, "isect_tiles", isect_tiles)
    monkeypatch.setattr(tile_lists, "isect_offset_encode", _torch_impl._isect_offset_encode)
    generator = torch.Generator().manual_seed(0)
    means2d = torch.rand(cameras, count, 2, generator=generator) * 100 - 20
    radii = torch.randint(0, 20, (cameras, count), generator=generator, dtype=torch.int32)
    depths = torch.rand(cameras, count, generator=generator) + 0.5
    conics, alphas = torch.ones(cameras, count, 3), torch.full((cameras, count), 0.001)  # neither matters here
    offsets, ids = tile_lists.tile_lists(means2d, conics, alphas, depths, radii, 70, 40)
    assert offsets.shape == (cameras, 3, 5)
    assert offsets.dtype == ids.dtype == torch.int32
    ends = [*offsets.flatten().tolist(), len(ids)]
    for tile, (start, end) in enumerate(pairwise(ends)):
        camera, place = divmod(tile, 15)
        corner = 16 * torch.tensor([place % 5, place // 5])
        reach = radii[camera, :, None]
        inside = (means2d[camera] + reach > corner) & (means2d[camera] - reach < corner + 16) & (reach > 0)
        expected = inside.all(dim=1).nonzero()[:, 0].tolist()
        expected.sort(key=lambda each: float(depths[camera, each]))
        assert ids[start:end].tolist() == [count * camera + each for each in expected]


class OnCuda(Tensor):
    """A tensor that says it is on CUDA."""

    is_cuda = True


@pytest.mark.parametrize(
    ("triton", "cuda", "cameras", "count"),
    [(True, True, 1, 3), (False, True, 1, 3), (True, False, 1, 3), (True, True, 2, 3), (True, True, 1, 0)],
)
def test_kernels_list_what_one_camera_on_cuda_sees_where_triton_is(monkeypatch, triton, cuda, cameras, count):
    kernels = "ssa_nerfstudio.rasterization._tile_lists_triton"
    mine = torch.zeros(1, 2), torch.arange(count)
    monkeypatch.setitem(sys.modules, kernels, SimpleNamespace(listed=lambda means2d, *_: mine))
    monkeypatch.setattr(tile_lists, "isect_tiles", isect_tiles)
    monkeypatch.setattr(tile_lists, "isect_offset_encode", _torch_impl._isect_offset_encode)
    monkeypatch.setattr(tile_lists, "_TRITON", triton)
    means2d, radii = torch.full((cameras, count, 2), 8.0), torch.ones(cameras, count, dtype=torch.int32)
    conics, ones = torch.ones(cameras, count, 3), torch.ones(cameras, count)
    given = means2d.as_subclass(OnCuda) if cuda else means2d
    offsets, ids = tile_lists.tile_lists(given, conics, ones, ones, radii, 32, 16)
    assert (ids is mine[1]) == (triton and cuda and cameras == 1 and count > 0)
    assert offsets.shape == (cameras, 1, 2)


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
