"""Properties of any correct rasterizer, and of the cpu one: the same bits on any number of threads."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterization_scenes import BODIES, scene, torch_threads

from benchmarks.rasterizers import PARAMETERS, draw, relative_error
from ssa_nerfstudio.rasterization import cpu, reference

every_body = pytest.mark.parametrize("name", BODIES)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_image_and_gradients_are_the_same_bits_on_any_number_of_threads(dtype: torch.dtype) -> None:
    made = scene(500, 70, 90, dtype=dtype, cameras=2)
    results = {}
    for threads in (1, 2, 3, 5):
        with torch_threads(threads):
            results[threads] = draw(cpu.rasterization, *made, 70, 90, absgrad=True)
    for threads in (2, 3, 5):
        for name, value in results[1].items():
            assert torch.equal(results[threads][name], value), f"{name} differs on {threads} threads"


def test_two_python_threads_render_the_same_images_as_one() -> None:
    scenes = [scene(400, 60, 50, dtype=torch.float32, seed=seed) for seed in range(2)]
    alone = [draw(cpu.rasterization, *made, 60, 50) for made in scenes]

    def draw_often(which: int) -> bool:
        with torch_threads(2):
            drawn = [draw(cpu.rasterization, *scenes[which], 60, 50) for _ in range(15)]
        return all(torch.equal(result[name], value) for result in drawn for name, value in alone[which].items())

    with ThreadPoolExecutor(2) as pool:
        assert all(pool.map(draw_often, range(2)))


@settings(max_examples=15, deadline=None, derandomize=True)
@given(order=st.permutations(range(40)))
def test_the_order_in_which_gaussians_are_given_does_not_matter(order: list[int]) -> None:
    gaussians, viewmats, Ks = scene(40, 30, 20, size=0.2)
    shuffled = {name: value[order] for name, value in gaussians.items()}
    for rasterization in BODIES.values():
        plain = draw(rasterization, gaussians, viewmats, Ks, 30, 20)
        other = draw(rasterization, shuffled, viewmats, Ks, 30, 20)
        for name in ("image", "alpha", "depth"):
            assert torch.equal(other[name], plain[name])
        for name in PARAMETERS:
            assert torch.equal(other[f"d {name}"], plain[f"d {name}"][order])
        assert torch.equal(other["d means2d"], plain["d means2d"][:, order])


channel = st.floats(0, 1)
color = st.tuples(channel, channel, channel)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(first=color, second=color, share=channel)
def test_the_background_is_weighted_by_the_transmittance(
    first: tuple[float, ...], second: tuple[float, ...], share: float
) -> None:
    gaussians, viewmats, Ks = scene(30, 20, 18, size=0.1)

    def over(background: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
        render, alpha, _ = cpu.rasterization(
            **gaussians, viewmats=viewmats, Ks=Ks, width=20, height=18, sh_degree=3, backgrounds=background
        )
        return render, alpha

    a, b = (torch.tensor([c], dtype=torch.float64) for c in (first, second))
    black, alpha = over(None)
    torch.testing.assert_close(over(a)[0], black + (1 - alpha) * a, rtol=0, atol=1e-14)
    mixed = share * over(a)[0] + (1 - share) * over(b)[0]
    torch.testing.assert_close(over(share * a + (1 - share) * b)[0], mixed, rtol=0, atol=1e-14)
    assert 0 <= alpha.min() < 0.1
    assert alpha.max() <= 1


@every_body
def test_splats_behind_opaque_ones_are_not_drawn_and_get_no_gradient(name: str) -> None:
    gaussians, viewmats, Ks = scene(30, 3, 2, size=5.0, sh_degree=None)
    gaussians["means"][:, :2] = 0
    gaussians["means"][:, 2] = 3 + 0.01 * torch.arange(30)
    gaussians["opacities"][:] = 0.95  # 0.05, 0.0025, 1.25e-4 are left after three; a fourth would leave 6e-6
    everything = draw(BODIES[name], gaussians, viewmats, Ks, 3, 2, sh_degree=None)
    three = {key: value[:3] for key, value in gaussians.items()}
    nearest = draw(BODIES[name], three, viewmats, Ks, 3, 2, sh_degree=None)
    for key in ("image", "alpha", "depth"):
        torch.testing.assert_close(everything[key], nearest[key], rtol=1e-13, atol=0)
    assert everything["alpha"].min() > 0.999
    assert everything["alpha"].max() < 1 - 1e-4
    for key in PARAMETERS:
        assert (everything[f"d {key}"][3:] == 0).all()
        assert relative_error(everything[f"d {key}"][:3], nearest[f"d {key}"]) < 1e-12
    assert everything["d opacities"][:3].abs().min() > 0


def test_absgrad_is_the_sum_over_pixels_of_the_magnitudes_of_their_gradients() -> None:
    width, height = 9, 7
    gaussians, viewmats, Ks = scene(12, width, height, size=0.3, cameras=2, seed=1)
    absgrad = draw(cpu.rasterization, gaussians, viewmats, Ks, width, height, absgrad=True)["|d means2d|"]

    options = {"sh_degree": 3, "render_mode": "RGB+ED"}
    leaves = {name: value.clone().requires_grad_() for name, value in gaussians.items()}
    render, alpha, info = reference.rasterization(
        **leaves, viewmats=viewmats, Ks=Ks, width=width, height=height, **options
    )
    generator = torch.Generator().manual_seed(1)  # the cotangent of `draw`
    cotangent = torch.rand(2, height, width, 5, generator=generator).double()
    per_pixel = (torch.cat([render, alpha], dim=-1) * cotangent).sum(dim=-1).flatten()
    expected = torch.zeros_like(absgrad)
    for value in per_pixel:
        (gradient,) = torch.autograd.grad(value, info["means2d"], retain_graph=True)
        expected += gradient.abs()
    torch.testing.assert_close(absgrad, expected, rtol=1e-10, atol=1e-14)
    signed = draw(cpu.rasterization, gaussians, viewmats, Ks, width, height)["d means2d"]
    assert (absgrad > 1.5 * signed.abs()).any()
    assert (absgrad >= signed.abs() - 1e-14).all()


def test_absgrad_is_optional_and_changes_nothing_else() -> None:
    made = scene(50, 20, 20, cameras=2)
    with_it = draw(cpu.rasterization, *made, 20, 20, absgrad=True)
    without = draw(cpu.rasterization, *made, 20, 20)
    assert with_it.keys() - without.keys() == {"|d means2d|"}
    assert all(torch.equal(with_it[name], value) for name, value in without.items())


@every_body
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gaussians_at_behind_and_just_before_the_camera_leave_gradients_finite(name: str, dtype: torch.dtype) -> None:
    gaussians, viewmats, Ks = scene(60, 32, 24, size=0.2, dtype=dtype)
    near = 0.01
    gaussians["means"][0] = 0  # at the camera's center
    gaussians["means"][1] = torch.tensor([0.3, 0.1, 0.0])  # in its plane: divided by a depth of zero
    gaussians["means"][2] = torch.tensor([0.1, 0.1, -2.0])
    gaussians["means"][3] = torch.tensor([0.0, 0.0, near])  # on the near plane: not drawn
    gaussians["means"][4] = torch.tensor([0.0, 0.0, 1.001 * near])
    gaussians["means"][5] = torch.tensor([0.02, -0.01, 1.001 * near])
    drawn = draw(BODIES[name], gaussians, viewmats, Ks, 32, 24)
    assert all(value.isfinite().all() for value in drawn.values())
    for key in PARAMETERS:
        assert (drawn[f"d {key}"][:4] == 0).all()
    assert drawn["d opacities"][4] != 0
    rest = {key: value[4:] for key, value in gaussians.items()}
    without = draw(BODIES[name], rest, viewmats, Ks, 32, 24)
    assert torch.equal(drawn["image"], without["image"])


@pytest.mark.parametrize("broken", ["means", "quats", "scales"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_the_cpu_rasterizer_does_not_draw_gaussians_that_are_not_finite(broken: str, value: float) -> None:
    gaussians, viewmats, Ks = scene(60, 32, 24, size=0.2, dtype=torch.float32)
    rest = {key: parameter[5:] for key, parameter in gaussians.items()}
    gaussians[broken][:5] = value
    drawn = draw(cpu.rasterization, gaussians, viewmats, Ks, 32, 24)
    without = draw(cpu.rasterization, rest, viewmats, Ks, 32, 24)
    for key in ("image", "alpha", "depth"):
        assert torch.equal(drawn[key], without[key])
    for key in PARAMETERS:
        assert torch.equal(drawn[f"d {key}"][5:], without[f"d {key}"])
        assert (drawn[f"d {key}"][:5] == 0).all()


@every_body
@pytest.mark.parametrize("n", [0, 5])
def test_without_visible_gaussians_the_image_is_the_background(name: str, n: int) -> None:
    gaussians, viewmats, Ks = scene(5, 20, 18, cameras=2)
    gaussians = {key: value[:n] for key, value in gaussians.items()}
    gaussians["means"][:, 2] = -100.0
    backgrounds = torch.tensor([[0.2, 0.4, 0.6], [0.0, 1.0, 0.5]], dtype=torch.float64)
    leaves = {key: value.clone().requires_grad_() for key, value in gaussians.items()}
    render, alpha, info = BODIES[name](
        **leaves, viewmats=viewmats, Ks=Ks, width=20, height=18, sh_degree=3, backgrounds=backgrounds,
        render_mode="RGB+ED",
    )  # fmt: skip
    assert torch.equal(render[..., :3], backgrounds[:, None, None, :].expand(2, 18, 20, 3))
    assert (render[..., 3] == 0).all()
    assert (alpha == 0).all()
    assert (info["radii"] == 0).all()
    (render.sum() + alpha.sum()).backward()
    for key, leaf in leaves.items():
        assert leaf.grad is None or (leaf.grad == 0).all(), key


def test_a_graph_that_is_kept_gives_the_same_gradients_again() -> None:
    gaussians, viewmats, Ks = scene(50, 24, 20)
    leaves = {key: value.clone().requires_grad_() for key, value in gaussians.items()}
    render, alpha, _ = cpu.rasterization(**leaves, viewmats=viewmats, Ks=Ks, width=24, height=20, sh_degree=3)
    total = (render**2).sum() + alpha.sum()
    once, again = (torch.autograd.grad(total, list(leaves.values()), retain_graph=True) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(once, again, strict=True))
    assert all(gradient.abs().max() > 0 for gradient in once)


@every_body
def test_the_image_is_the_same_without_gradients(name: str) -> None:
    made = scene(50, 24, 20)
    drawn = draw(BODIES[name], *made, 24, 20)
    with torch.no_grad():
        render, alpha, info = BODIES[name](
            **made[0], viewmats=made[1], Ks=made[2], width=24, height=20, sh_degree=3, render_mode="RGB+ED"
        )
    assert torch.equal(render, torch.cat([drawn["image"], drawn["depth"]], dim=-1))
    assert torch.equal(alpha, drawn["alpha"])
    assert not info["means2d"].requires_grad


def test_info_has_the_entries_that_densification_reads() -> None:
    gaussians, viewmats, Ks = scene(40, 24, 20, cameras=2)
    gaussians["means"][:7] += 1000
    gaussians["means"].requires_grad_()
    _, _, info = cpu.rasterization(**gaussians, viewmats=viewmats, Ks=Ks, width=24, height=20, sh_degree=3)
    assert (info["width"], info["height"], info["n_cameras"], info["tile_size"]) == (24, 20, 2, 16)
    assert info["gaussian_ids"] is None
    assert info["camera_ids"] is None
    assert info["radii"].shape == (2, 40)
    assert info["radii"].dtype == torch.int32
    assert (info["radii"][:, :7] == 0).all()
    assert (info["radii"][:, 7:] > 0).any(dim=0).all()
    assert info["means2d"].shape == (2, 40, 2)
    projected = Ks[0] @ gaussians["means"][20].detach()
    torch.testing.assert_close(info["means2d"][0, 20].detach(), projected[:2] / projected[2])


def test_the_radius_clip_drops_the_small_and_keeps_the_large() -> None:
    gaussians, viewmats, Ks = scene(100, 40, 30, size=0.03)
    options = {"viewmats": viewmats, "Ks": Ks, "width": 40, "height": 30, "sh_degree": 3}
    all_radii = cpu.rasterization(**gaussians, **options)[2]["radii"]
    kept = cpu.rasterization(**gaussians, **options, radius_clip=4.0)[2]["radii"]
    assert torch.equal(kept, torch.where(all_radii > 4, all_radii, 0))
    assert 0 < (kept > 0).sum() < (all_radii > 0).sum()


def test_after_compile_kernels_the_first_frame_compiles_nothing() -> None:
    script = """
import torch
from benchmarks.rasterizers import draw, random_scene
from ssa_nerfstudio.rasterization import _projection_kernels, cpu
from ssa_nerfstudio.rasterization import _blending_kernels as _kernels
kernels = [k for module in (_kernels, _projection_kernels) for k in vars(module).values() if hasattr(k, "signatures")]
cpu.compile_kernels()
before = {kernel.py_func.__name__: len(kernel.signatures) for kernel in kernels}
for degree in (0, 3):
    scene = random_scene(50, 40, 30, 0.1)
    draw(cpu.rasterization, *scene, 40, 30, sh_degree=degree, absgrad=True, backgrounds=torch.ones(1, 3))
with torch.no_grad():
    cpu.rasterization(**scene[0], viewmats=scene[1], Ks=scene[2], width=40, height=30, sh_degree=2)
after = {kernel.py_func.__name__: len(kernel.signatures) for kernel in kernels}
assert before == after, (before, after)
assert before["blend_bands"] == before["project_gaussians"] == 1, before
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def one_gaussian(
    x: float, y: float, opacity: float = 0.5
) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor]:
    """A small Gaussian on the optical axis, and a camera whose axis meets the image, of 20 x 20 pixels, at (x, y)."""
    gaussians, viewmats, Ks = scene(1, 20, 20, size=0.05, sh_degree=None)
    gaussians["means"] = torch.tensor([[0.0, 0.0, 3.0]], dtype=torch.float64)
    gaussians["opacities"] = torch.tensor([opacity], dtype=torch.float64)
    Ks[0, 0, 2], Ks[0, 1, 2] = x, y
    return gaussians, viewmats, Ks


def drawn_radius(name: str, x: float, y: float) -> int:
    gaussians, viewmats, Ks = one_gaussian(x, y)
    return int(BODIES[name](**gaussians, viewmats=viewmats, Ks=Ks, width=20, height=20)[2]["radii"].item())


@every_body
def test_a_splat_whose_square_only_touches_the_frame_is_not_drawn(name: str) -> None:
    radius = drawn_radius(name, 10, 10)
    assert radius > 0
    for x, y in ((-radius, 10), (20 + radius, 10), (10, -radius), (10, 20 + radius)):
        assert drawn_radius(name, x, y) == 0
    for x, y in ((1e-6 - radius, 10), (20 + radius - 1e-6, 10), (10, 1e-6 - radius), (10, 20 + radius - 1e-6)):
        assert drawn_radius(name, x, y) == radius


@every_body
@pytest.mark.parametrize(("opacity", "drawn"), [(1 / 255, True), (1 / 255 - 1e-12, False)])
def test_what_reaches_a_255th_is_drawn(name: str, opacity: float, drawn: bool) -> None:
    gaussians, viewmats, Ks = one_gaussian(8.5, 11.5, opacity)
    alpha = BODIES[name](**gaussians, viewmats=viewmats, Ks=Ks, width=20, height=20)[1][0, ..., 0]
    assert (alpha > 0).sum() == drawn
    assert alpha[11, 8].item() == pytest.approx(opacity if drawn else 0, abs=1e-12)
