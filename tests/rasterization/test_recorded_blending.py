"""Recorded blending against plain blending: on a CPU with gsplat's kernels replaced by torch, on CUDA with them."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from recordings import CUDA, recorder
from torch import Tensor

from ssa_nerfstudio.rasterization import cuda, reference
from ssa_nerfstudio.rasterization.constants import TILE
from ssa_nerfstudio.rasterization.interface import Cameras, RenderOptions
from ssa_nerfstudio.rasterization.projection import Splats
from ssa_nerfstudio.rasterization.recorded_blending import LOOK_EVERY, ROOM, SHRINK, TIGHT, RecordedBlending
from ssa_nerfstudio.rasterization.tile_lists import TileLists, entries_of

WIDTH, HEIGHT = 50, 40
NAMES = ("means2d", "conics", "alphas", "channels")


def blended_by_torch(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    alphas: Tensor,
    cameras: Cameras,
    lists: TileLists,
    magnitudes: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """What gsplat's kernels draw, and, in place of the sums of magnitudes, three times the gradients."""
    centers = means2d[0] if magnitudes is None else (means2d + 3 * magnitudes)[0]
    width, height, ids = cameras.width, cameras.height, lists.gaussians
    image, alpha = means2d.new_zeros(height, width, 3), means2d.new_zeros(height, width, 1)
    starts = [*lists.offsets.flatten().tolist(), len(ids)]
    splats = Splats(ids, ids, centers, conics[0], alphas[0], colors[0])
    for i in range(lists.offsets.numel()):
        row, column = divmod(i, lists.offsets.shape[2])
        if lists.drawn.flatten()[i]:
            edges = row * TILE, min(row * TILE + TILE, height), column * TILE, min(column * TILE + TILE, width)
            here = ids[starts[i] : starts[i + 1]].long()
            color, opaque = reference._blend_tile(splats, centers, here, *edges)
            image[edges[0] : edges[1], edges[2] : edges[3]] = color
            alpha[edges[0] : edges[1], edges[2] : edges[3]] = opaque
    return image[None], alpha[None]


@pytest.fixture(autouse=True)
def kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """gsplat's blend on CUDA only."""
    of_gsplat = cuda.blend_lists
    monkeypatch.setattr(
        cuda,
        "blend_lists",
        lambda means2d, *given: (of_gsplat if means2d.is_cuda else blended_by_torch)(means2d, *given),
    )


def view(count: int, seed: int, device: str, size: float = 4.0) -> dict[str, Tensor]:
    """Splats of a view, of which the last one is not drawn."""
    generator = torch.Generator().manual_seed(seed)
    made = {
        "means2d": torch.rand(1, count, 2, generator=generator) * torch.tensor([WIDTH, HEIGHT]),
        "conics": torch.tensor([1.0, 0.3, 0.8]).expand(1, count, 3) / size**2,
        "alphas": 0.2 + 0.7 * torch.rand(1, count, generator=generator),
        "channels": torch.rand(1, count, 3, generator=generator),
    }
    made = {name: value.to(device).requires_grad_() for name, value in made.items()}
    radii = torch.full((1, count), int(3 * size), dtype=torch.int32)
    radii[:, -1] = 0
    return {**made, "depths": torch.rand(1, count, generator=generator).to(device), "radii": radii.to(device)}


def outcome(blend: Any, given: dict[str, Tensor], absgrad: bool = True, scale: int = 1) -> dict[str, Tensor]:
    for name in NAMES:
        given[name].grad = None
    projected = cuda.Projected(**{name: given[name] for name in cuda.Projected._fields})
    frame = Cameras(torch.eye(4)[None], torch.eye(3)[None], scale * WIDTH, scale * HEIGHT, None)
    options = RenderOptions(0.01, 1e10, 0.0, 0.3, None, "RGB", absgrad=absgrad, antialiased=False)
    image, alpha = blend(projected, given["channels"], frame, options)
    weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(0)).to(image.device)
    ((image * weights).sum() + alpha.square().sum()).backward()
    found = {"image": image, "alpha": alpha, **{name: given[name].grad for name in NAMES}}
    if absgrad:
        found["absgrad"] = vars(given["means2d"]).pop("absgrad")
    return {name: value.detach().clone() for name, value in found.items()}


def plain(device: str) -> Any:
    """Blending by lists that are as long as needed; on CUDA gsplat's own."""
    if device == "cuda":
        return cuda.blend
    return lambda *given: RecordedBlending(recorder("cpu"))(*given)


def assert_the_same(found: dict[str, Tensor], expected: dict[str, Tensor], device: str) -> None:
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        difference = (found[name] - value).norm() / value.norm().clamp_min(1e-20)
        assert difference <= (1e-4 if device == "cuda" else 1e-6), name  # gsplat adds gradients up in any order


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("absgrad", [True, False])
def test_views_are_blended_as_without_a_recording(device: str, absgrad: bool) -> None:
    blend = RecordedBlending(recorder(device))
    for seed in range(6):
        given = view(60, seed, device)
        assert_the_same(outcome(blend, given, absgrad), outcome(plain(device), given, absgrad), device)
    assert [each is not None for each in blend._calls._known.values()] == [True]


def test_what_is_blended_is_the_reference() -> None:
    given = view(60, 0, "cpu")
    found = outcome(RecordedBlending(recorder("cpu")), given)
    order = given["depths"][0].argsort()[given["radii"][0, given["depths"][0].argsort()] > 0]
    splats = Splats(
        order,
        given["radii"][0, order],
        given["means2d"][0, order],
        given["conics"][0, order],
        given["alphas"][0, order],
        torch.cat([given["channels"][0, order], given["depths"][0, order, None]], dim=-1),
    )
    image, alpha = reference.blend(splats, given["means2d"], 0, WIDTH, HEIGHT, absgrad=False)
    torch.testing.assert_close(found["image"][0], image[..., :3].detach())
    torch.testing.assert_close(found["alpha"][0], alpha.detach())
    torch.testing.assert_close(found["absgrad"], 3 * found["means2d"])


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_a_refinement_and_another_frame_begin_new_lists(device: str) -> None:
    blend = RecordedBlending(recorder(device))
    for count, scale in ((60, 1), (60, 2), (60, 1), (60, 2), (90, 1), (90, 1), (30, 2), (30, 1), (30, 2)):
        given = view(count, count, device)
        found = outcome(blend, given, scale=scale)
        assert_the_same(found, outcome(plain(device), given, scale=scale), device)
    assert len(blend._calls._known) == 2, "one for each frame"


def needed(given: dict[str, Tensor], scale: int = 1) -> int:
    """Entries of the lists that a view needs."""
    return int(entries_of(given["means2d"][0], given["radii"][0], scale * WIDTH, scale * HEIGHT)[1].prod(dim=1).sum())


def view_that_needs(least: float, most: float, device: str = "cpu") -> dict[str, Tensor]:
    views = (view(60, 0, device, size=size) for size in torch.linspace(1.0, 6.0, 51).tolist())
    return next(each for each in views if least < needed(each) <= most)


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_a_view_that_needs_more_than_there_is_is_not_drawn_until_the_lists_are_longer(device: str) -> None:
    blend = RecordedBlending(recorder(device))
    small = view(60, 0, device, size=2.0)
    for _ in range(3):
        assert outcome(blend, small)["image"].isfinite().all()
    before = blend._capacity
    large = view_that_needs(before, 1.2 * before, device)
    missed = outcome(blend, large)
    assert missed["image"].isnan().all()
    for _ in range(2 * LOOK_EVERY):
        outcome(blend, small)
    assert blend._capacity == int(ROOM * needed(large))
    assert_the_same(outcome(blend, large), outcome(plain(device), large), device)


def test_lists_are_longer_before_a_view_misses_any() -> None:
    blend = RecordedBlending(recorder("cpu"))
    outcome(blend, view(60, 0, "cpu", size=3.0))
    before = blend._capacity
    given = view_that_needs(TIGHT * before, before)
    for _ in range(2 * LOOK_EVERY):
        assert outcome(blend, given)["image"].isfinite().all()
    assert blend._capacity > before


def test_more_gaussians_have_room_for_as_many_entries_each_as_any_view_has_needed() -> None:
    blend = RecordedBlending(recorder("cpu"))
    large = view(60, 0, "cpu", size=6.0)
    for given in (large, view(60, 0, "cpu", size=1.0)):
        outcome(blend, given)
    outcome(blend, view(90, 0, "cpu", size=1.0))
    assert blend._capacity == int(ROOM * int(1.5 * needed(large)))


def test_lists_become_shorter_little_by_little() -> None:
    blend = RecordedBlending(recorder("cpu"))
    outcome(blend, view(60, 0, "cpu", size=6.0))
    found = [blend._capacity]
    for count in (61, 60, 61):
        outcome(blend, view(count, 0, "cpu", size=1.0))
        found.append(blend._capacity)
    each = [capacity / count for capacity, count in zip(found, (60, 61, 60, 61), strict=True)]
    assert each[1] == pytest.approx(each[0], rel=0.02), "as many as the view before needed"
    assert each[2:] == [pytest.approx(SHRINK * each[1], rel=0.02), pytest.approx(SHRINK**2 * each[1], rel=0.02)]


def test_another_frame_has_room_from_its_first_view_on_and_takes_none_away() -> None:
    blend = RecordedBlending(recorder("cpu"))
    small, large = view(60, 0, "cpu", size=1.0), view(60, 0, "cpu", size=6.0)
    for given, scale in ((large, 1), (small, 2)):
        assert outcome(blend, given, scale=scale)["image"].isfinite().all()
        assert blend._capacity == int(ROOM * needed(large))
    blend = RecordedBlending(recorder("cpu"))
    views = [(small, 1), (small, 2), (view(61, 0, "cpu", size=1.0), 1), (view(61, 0, "cpu", size=6.0), 2)]
    for given, scale in views:
        assert outcome(blend, given, scale=scale)["image"].isfinite().all()
