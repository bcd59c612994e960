"""A training view that is rendered by recordings against one that launches every kernel by itself."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Mapping

import pytest
import torch
import torch.nn.functional as F
from gsplat.cuda._torch_impl import _fully_fused_projection as projection
from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci as quat_scale_to_covar_preci
from gsplat.cuda._torch_impl import _spherical_harmonics as harmonics
from recordings import run_again
from torch import Tensor

from ssa_nerfstudio._system.cuda_graphs import RecordedCalls
from ssa_nerfstudio.plugin import splat_rendering
from ssa_nerfstudio.plugin.splat_rendering import PARAMETERS, LearnedRender, SplatRenderer, activated, render_learned
from ssa_nerfstudio.rasterization import cuda
from ssa_nerfstudio.rasterization import harmonics as shading
from ssa_nerfstudio.rasterization.interface import Cameras, Gaussians, RenderOptions

WIDTH, HEIGHT = 96, 64


def parameters(count: int, device: str) -> dict[str, Tensor]:
    """splatfacto's, of a random scene."""
    generator = torch.Generator().manual_seed(count)
    means = torch.rand(count, 3, generator=generator) * 2 - 1
    values = {
        "means": means + torch.tensor([0.0, 0.0, 4.0]),
        "quats": torch.randn(count, 4, generator=generator),
        "scales": torch.rand(count, 3, generator=generator) - 3.5,
        "opacities": torch.randn(count, 1, generator=generator),
        "features_dc": torch.randn(count, 3, generator=generator),
        "features_rest": 0.2 * torch.randn(count, 15, 3, generator=generator),
    }
    return {name: torch.nn.Parameter(value.to(device)) for name, value in values.items()}


def cameras(view: int, device: str) -> tuple[Tensor, Tensor]:
    pose = torch.eye(4)
    pose[0, 3], pose[1, 3] = 0.1 * view, -0.05 * view
    K = torch.tensor([[80.0 + view, 0.0, WIDTH / 2], [0.0, 80.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return pose[None].to(device), K[None].to(device)


def outcome(renderer: Callable, given: Mapping[str, Tensor], view: int, sh_degree: int | None, mode: str):
    device = str(given["means"].device)
    for value in given.values():
        value.grad = None
    options = {
        "near_plane": 0.01,
        "sh_degree": sh_degree,
        "render_mode": "RGB",
        "absgrad": True,
        "rasterize_mode": mode,
    }
    render = LearnedRender(*renderer(given, *cameras(view, device), WIDTH, HEIGHT, **options))
    image, alpha, info = render[:3]
    info["means2d"].retain_grad()
    weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(view)).to(device)
    render.backpropagate(weights, 2 * alpha.detach())
    visible = info["radii"] > 0
    found = {
        "image": image,
        "alpha": alpha,
        "radii": visible,
        "means2d": torch.where(visible[..., None], info["means2d"], 0),
    }
    found |= {"absgrad": info["means2d"].absgrad, "gradient of means2d": info["means2d"].grad}
    found |= {f"gradient of {name}": value.grad for name, value in given.items() if value.grad is not None}
    return {name: value.detach().float().clone() for name, value in found.items()}, info


def by_gsplat(given: Mapping[str, Tensor], viewmats: Tensor, Ks: Tensor, width: int, height: int, **options):
    """`SplatRenderer` where nothing is learned: gsplat's kernels alone."""
    gaussians = activated(given, options["sh_degree"] is not None)
    return cuda.rasterization(**gaussians._asdict(), viewmats=viewmats, Ks=Ks, width=width, height=height, **options)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat needs CUDA")
@pytest.mark.parametrize(("sh_degree", "mode"), [(3, "classic"), (1, "classic"), (0, "antialiased"), (None, "classic")])
@pytest.mark.parametrize("graphs", ["0", "1"])
def test_a_training_view_is_gsplats_with_the_same_gradients(monkeypatch, sh_degree, mode, graphs):
    monkeypatch.setenv("SSA_CUDA_GRAPHS", graphs)
    given = parameters(500, "cuda")
    renderer = SplatRenderer("auto")
    for view in range(8):
        draw = renderer if graphs == "0" else renderer.learned
        found = [outcome(render, given, view, sh_degree, mode)[0] for render in (by_gsplat, draw)]
        assert found[0].keys() == found[1].keys()
        for name, expected in found[0].items():
            difference = (found[1][name] - expected).norm() / expected.norm().clamp_min(1e-20)
            assert difference <= 1e-4, (name, view)  # gsplat adds gradients up in any order
        with torch.no_grad():
            for value in given.values():
                value += 0.01 * torch.randn_like(value)
        if view == 3:  # as a refinement does
            given = {name: torch.nn.Parameter(value.detach()[::2].clone()) for name, value in given.items()}
        if view == 5:  # as gsplat's relocation does, in the same memory
            given = {name: torch.nn.Parameter(value.data) for name, value in given.items()}
    assert [each is not None for each in renderer.projections._known.values()] == ([] if graphs == "0" else [True])


def sums(projected: cuda.Projected, channels: Tensor, cameras, options) -> tuple[Tensor, Tensor]:
    """In place of blending: all of it counts."""
    means2d, conics, alphas, *_ = projected
    image = (channels * alphas[..., None]).sum(dim=1)[:, None, None] + means2d.sum() + conics.square().sum()
    return image.expand(1, HEIGHT, WIDTH, 3), alphas.sum().expand(1, HEIGHT, WIDTH, 1)


class Summing:
    """In place of `cuda.Blending`."""

    def __init__(self, projected: cuda.Projected, channels: Tensor, cameras, options) -> None:
        self._leaves = [each.detach().requires_grad_() for each in (*projected[:3], channels)]
        means2d, conics, alphas, colors = self._leaves
        mine = projected._replace(means2d=means2d, conics=conics, alphas=alphas)
        self._values = sums(mine, colors, cameras, options)
        self.image, self.alpha = (value.detach().requires_grad_() for value in self._values)

    def backpropagate(self, of_image: Tensor, of_alpha: Tensor) -> list[Tensor | None]:
        *found, of_colors = torch.autograd.grad(self._values, self._leaves, [of_image, of_alpha])
        return [*found, None, None, of_colors]


def recordable(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(cuda, "blend", sums)
    patch.setattr(cuda, "Blending", Summing)
    patch.setattr(shading, "runs_on_current_stream", lambda device, degree: True)


@pytest.mark.parametrize("sh_degree", [3, None])
def test_a_recording_takes_apart_what_is_shaded_and_blended(monkeypatch, sh_degree):
    """On a CPU: gsplat's plain projection and harmonics, run again in place of a graph."""
    recordable(monkeypatch)

    def shade(means: Tensor, center: Tensor, constant: Tensor, rest: Tensor, radii: Tensor, degree: int) -> Tensor:
        colors = harmonics(degree, means - center, torch.cat([constant[:, None], rest], dim=1))
        return torch.clamp_min(colors + 0.5, 0.0)

    def project(means: Tensor, _, quats: Tensor, scales: Tensor, *views, **options) -> tuple[Tensor | None, ...]:
        covariances, _ = quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        assert covariances is not None
        return projection(means, covariances, *views, eps2d=0.3)

    monkeypatch.setattr(cuda, "fully_fused_projection", project)
    monkeypatch.setattr(shading, "shade", shade)
    options = RenderOptions(0.01, 1e10, 0.0, 0.3, sh_degree, "RGB", absgrad=False, antialiased=False)
    given = parameters(30, "cpu")
    calls = RecordedCalls(run_again)
    for view in range(4):
        seen = Cameras(*cameras(view, "cpu"), WIDTH, HEIGHT, None)
        found = []
        for plain in (True, False):
            for value in given.values():
                value.grad = None
            render = render_learned(None if plain else calls, given, seen, options)
            image, alpha, info = render[:3]
            assert (render.parts is None) == plain
            of_image, of_alpha = torch.zeros_like(image), torch.zeros_like(alpha)
            of_image[0, 0, 0], of_alpha[0, 0, 0] = torch.tensor([1.0, 2.0, 3.0]), 1.0
            render.backpropagate(of_image, of_alpha)
            gradients = {name: value.grad.clone() for name, value in given.items() if value.grad is not None}
            found.append({"image": image.detach().clone(), "radii": info["radii"].clone(), **gradients})
        torch.testing.assert_close(found[0], found[1])
        if view == 2:  # recorded by now; as gsplat's relocation does, new parameters in the same memory
            given = {name: torch.nn.Parameter(value.data) for name, value in given.items()}
    assert [each is not None for each in calls._known.values()] == [True]
    assert len(found[0]) == (8 if sh_degree is not None else 7)


def test_a_camera_that_is_learned_has_its_gradient(monkeypatch):
    recordable(monkeypatch)
    monkeypatch.setattr(cuda, "project", lambda gaussians, cameras, options: moved(gaussians, cameras))
    options = RenderOptions(0.01, 1e10, 0.0, 0.3, None, "RGB", absgrad=False, antialiased=False)
    given, calls = parameters(30, "cpu"), RecordedCalls(run_again)
    for _ in range(3):
        found = []
        for recorded in (None, calls):
            for value in given.values():
                value.grad = None
            viewmats, Ks = cameras(1, "cpu")
            correction = torch.zeros(3, requires_grad=True)
            seen = Cameras(viewmats + F.pad(correction[None, :, None], (3, 0, 0, 1)), Ks, WIDTH, HEIGHT, None)
            render = render_learned(recorded, given, seen, options)
            render.backpropagate(torch.ones_like(render.image), None)
            found.append(correction.grad)
        assert found[0].abs().min() > 0
        torch.testing.assert_close(*found)


def moved(gaussians: Gaussians, cameras: Cameras) -> cuda.Projected:
    """In place of a projection: all that depends on the camera is where it sees the means."""
    seen = gaussians.means @ cameras.viewmats[0, :3, :3].T + cameras.viewmats[0, :3, 3]
    radii = torch.ones(1, len(seen), dtype=torch.int32)
    return cuda.Projected(seen[None, :, :2], seen[None].square(), gaussians.opacities[None], seen[None, :, 2], radii)


def test_recordings_of_fewer_gaussians_are_given_up_once_there_are_too_many_to_record(monkeypatch):
    """They would hold gradients and parameters of a scene that is no more."""
    monkeypatch.setattr(splat_rendering, "MOST_RECORDED", 50)
    renderer = SplatRenderer("cpu")
    renderer.projections = RecordedCalls(run_again)

    def double(parameter: Tensor) -> tuple[Tensor, ...]:
        return (2 * parameter,)

    former = torch.nn.Parameter(torch.ones(3))
    for _ in range(2):
        renderer.projections(double, [], [former], "kind")  # a recording from the second call on
    kept, parameter = weakref.ref(double), weakref.ref(former)
    del double, former
    outcome(renderer.learned, parameters(50, "cpu"), 0, 3, "classic")
    gc.collect()
    assert kept() is not None  # as long as its recording
    assert parameter() is None
    outcome(renderer.learned, parameters(51, "cpu"), 0, 3, "classic")
    gc.collect()
    assert kept() is None


@pytest.mark.parametrize(("count", "usable", "recorded"), [(50, True, True), (51, True, False), (50, False, False)])
def test_projections_are_recorded_up_to_a_number_of_gaussians_where_graphs_can_be_used(
    monkeypatch, count, usable, recorded
):
    given, seen = parameters(count, "cpu"), []

    def render(calls: RecordedCalls | None, *_) -> LearnedRender:
        seen.append(calls)
        return LearnedRender(torch.zeros(1, HEIGHT, WIDTH, 3), torch.zeros(1, HEIGHT, WIDTH, 1), {})

    monkeypatch.setattr(splat_rendering, "MOST_RECORDED", 50)
    monkeypatch.setattr(splat_rendering, "graphs_are_usable", lambda: usable)
    monkeypatch.setattr(splat_rendering, "render_learned", render)
    monkeypatch.setattr(SplatRenderer, "_is_gsplat", lambda self, device: True)
    renderer, (viewmats, Ks) = SplatRenderer("auto"), cameras(0, "cpu")
    options = {"near_plane": 0.01, "sh_degree": 3, "render_mode": "RGB", "absgrad": False, "rasterize_mode": "classic"}
    renderer.learned(given, viewmats, Ks, WIDTH, HEIGHT, **options)
    assert seen == [renderer.projections if recorded else None]


def test_what_is_drawn_is_the_activated_scene():
    given = parameters(50, "cpu")
    for with_harmonics in (True, False):
        gaussians = activated(given, with_harmonics)
        assert gaussians.means is given["means"]
        torch.testing.assert_close(gaussians.scales.log(), given["scales"])
        torch.testing.assert_close(gaussians.opacities.logit(), given["opacities"][:, 0])
        colors = gaussians.colors if with_harmonics else gaussians.colors.logit()
        constant = colors[:, 0] if with_harmonics else colors
        torch.testing.assert_close(constant, given["features_dc"])
    assert set(PARAMETERS) == set(given)
