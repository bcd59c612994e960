"""Hard cases of the rasterizers: `cpu` in float32 stays finite, and in float64 agrees with `reference`.

On a machine with CUDA gsplat is held to the same cases in float32; `python tests/stability/compare_bodies.py` tells
what differs.
"""

from __future__ import annotations

import math

import pytest
import torch
from hard_cases import Case, Family
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from benchmarks.rasterizers import draw, relative_error
from ssa_nerfstudio.rasterization import RasterizerName, cpu, rasterizer, reference
from ssa_nerfstudio.rasterization.constants import NEAR_PLANE

RASTERIZER = Family("Rasterizer")
WIDTH, HEIGHT = 34, 22
BODY: RasterizerName = "cpu"
"""The body that is tested on the cases in float32."""
SINGLE_PRECISION: list[dict[str, float]] = []
"""Relative errors of BODY in float32 by output, one entry for every scene that was drawn."""
Gaussians = dict[str, Tensor]


def gaussians(n: int, seed: int = 0, degree: int = 3) -> Gaussians:
    """Ordinary Gaussians around (0, 0, 3) in front of a camera at the origin with its axis along z."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(n, 3, generator=generator) * 2 - 1
    means[:, 2] += 3
    return {
        "means": means.double(),
        "quats": torch.randn(n, 4, generator=generator).double(),
        "scales": 0.1 * torch.exp(0.4 * torch.randn(n, 3, generator=generator)).double(),
        "opacities": (0.1 + 0.8 * torch.rand(n, generator=generator)).double(),
        "colors": 0.3 * torch.randn(n, (degree + 1) ** 2, 3, generator=generator).double(),
    }


def hold(scene: Gaussians, *, focal: float = 30.0, size=(WIDTH, HEIGHT), tolerance: float = 1e-8, **options) -> dict:
    """Draw with every body: all finite in float32, and the cpu's float64 that of the reference. Returns the oracle."""
    width, height = size
    viewmats = torch.eye(4, dtype=torch.float64)[None]
    Ks = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)[None]
    options = {"sh_degree": math.isqrt(scene["colors"].shape[1]) - 1, **options}
    oracle = draw(reference.rasterization, scene, viewmats, Ks, width, height, **options)
    double = draw(cpu.rasterization, scene, viewmats, Ks, width, height, **options)
    single = {name: value.float() for name, value in scene.items()}
    device = "cuda" if BODY == "gsplat" else "cpu"
    moved = {name: value.to(device) for name, value in single.items()}
    narrow = draw(
        rasterizer(BODY, device), moved, viewmats.float().to(device), Ks.float().to(device), width, height, **options
    )
    for drawn in (oracle, double, narrow):
        assert [name for name, value in drawn.items() if not torch.isfinite(value).all()] == []
        assert drawn["alpha"].min() >= 0
        assert drawn["alpha"].max() <= 1
    SINGLE_PRECISION.append({name: relative_error(narrow[name].cpu().double(), oracle[name]) for name in oracle})
    errors = {name: relative_error(double[name], oracle[name]) for name in oracle}
    assert all(error < tolerance for error in errors.values()), errors
    return oracle


def among_others(index: int = 0, **changes: Tensor | float | list[float]) -> Gaussians:
    """Twenty ordinary Gaussians, of which one is changed."""
    scene = gaussians(20)
    for name, value in changes.items():
        scene[name][index] = torch.as_tensor(value, dtype=torch.float64)
    return scene


def without(scene: Gaussians, index: int = 0) -> Gaussians:
    return {name: torch.cat([value[:index], value[index + 1 :]]) for name, value in scene.items()}


@RASTERIZER.case("a Gaussian behind the camera", "A division by a negative depth mirrors it into the image.", -2.0)
@RASTERIZER.case("a Gaussian far behind", "The same at a depth of -1e6.", -1e6)
@RASTERIZER.case("a Gaussian on the near plane", "Drawn by one body and not by the other.", NEAR_PLANE)
@RASTERIZER.case("a Gaussian at the camera's center", "A division by a depth of 0.", 0.0)
@RASTERIZER.case(
    "a Gaussian just before the near plane", "Magnified without bounds where it must not be drawn.", NEAR_PLANE - 1e-6
)
def _culled(depth: float) -> None:
    scene = among_others(means=[0.0, 0.0, depth])
    with_it, left_out = hold(scene), hold(without(scene))
    assert torch.equal(with_it["image"], left_out["image"])
    assert (with_it["d means"][0] == 0).all()


@RASTERIZER.case(
    "a Gaussian just past the near plane",
    "A focal length over 0.01 magnifies it and its gradients.",
    [0.0, 0.0, NEAR_PLANE + 1e-6],
)
@RASTERIZER.case(
    "one past the near plane, off axis",
    "x / z of 500: the linearised projection leaves every frame.",
    [5.0, 0.0, NEAR_PLANE + 1e-4],
)
@RASTERIZER.case("a Gaussian 1e6 away", "Its depth swamps the others'.", [0.0, 0.0, 1e6])
@RASTERIZER.case("a Gaussian 1e6 to the side", "Its center is beyond any integer of pixels.", [1e6, 0.0, 3.0])
def _placed(mean: list[float]) -> None:
    hold(among_others(means=mean), tolerance=1e-6)


@RASTERIZER.case(
    "scales of 1e-12", "A covariance of 1e-24 vanishes beside its blur, and its gradient is divided by it.", 1e-12
)
@RASTERIZER.case("scales of 1e-8", "The smallest that the guard lets through.", 1e-8)
@RASTERIZER.case("scales of 1e3", "It covers everything, seen from inside.", 1e3)
@RASTERIZER.case(
    "scales of 1e4", "The largest that the guard lets through: the determinant is near float32's end.", 1e4
)
@RASTERIZER.case("scales of 1e6", "The determinant in float32 leaves its range.", 1e6)
@RASTERIZER.case("scales of 0", "A gradient through 0 / 0.", 0.0)
def _sized(scale: float) -> None:
    hold(among_others(scales=[scale] * 3), tolerance=1e-5)


@RASTERIZER.case("a needle of 1e6", "The conic of a line: a c - b^2 cancels to nothing.", [1e-6, 1e-6, 1.0])
@RASTERIZER.case("a needle of 1e6 across the frame", "The same, long.", [1.0, 1e-6, 1e-6])
@RASTERIZER.case("a disc of 1e6", "Seen edge on it is a line.", [1.0, 1.0, 1e-6])
@RASTERIZER.case("a needle of 1e10", "Beyond float32's digits.", [1e-9, 1e-9, 10.0])
def _needle(scales: list[float]) -> None:
    for quat in ([1.0, 0, 0, 0], [0.7, 0.1, 0.7, 0.1], [0.5, 0.5, -0.5, 0.5]):
        hold(among_others(scales=scales, quats=quat), tolerance=1e-4)


@RASTERIZER.case("a quaternion of zero", "Normalising it divides by 0.", 0.0)
@RASTERIZER.case("a quaternion of 1e-20", "Its square underflows in float32.", 1e-20)
@RASTERIZER.case("a quaternion of 1e15", "Its gradient is 1e15 times smaller.", 1e15)
def _quaternion(length: float) -> None:
    hold(among_others(quats=[length * 0.5] * 4))


@RASTERIZER.case(
    "opacity logits of +40", "An alpha of 1 leaves a transmittance of 0, by which the backward pass divides.", 40.0
)
@RASTERIZER.case("opacity logits of -40", "The logarithm of its alpha over 1 / 255 is negative.", -40.0)
@RASTERIZER.case("an opacity of exactly 1 / 255", "Drawn nowhere or at a single point.", math.log(1 / 254))
def _opacity(logit: float) -> None:
    hold({**gaussians(20), "opacities": torch.full((20,), logit, dtype=torch.float64).sigmoid()})


@RASTERIZER.case("equal depths", "An order that changes from run to run, or from body to body.")
def _() -> None:
    scene = gaussians(20)
    scene["means"][:, 2] = 3.0
    a, b = hold(scene), hold(scene)
    assert torch.equal(a["image"], b["image"])


@RASTERIZER.case("the same Gaussian twenty times", "Ties in every coordinate.")
def _() -> None:
    hold({name: value[:1].expand_as(value).contiguous() for name, value in gaussians(20).items()})


@RASTERIZER.case("none visible", "Empty selections, sums and sorts.")
def _() -> None:
    scene = gaussians(20)
    scene["means"][:, 2] = -3.0
    drawn = hold(scene)
    assert drawn["alpha"].max() == 0
    assert all((drawn[f"d {name}"] == 0).all() for name in scene)


@RASTERIZER.case("an empty scene", "No Gaussian at all.")
def _() -> None:
    assert hold(gaussians(0))["image"].max() == 0


@RASTERIZER.case("one Gaussian", "Batches of one.")
def _() -> None:
    hold(gaussians(1))


@RASTERIZER.case("an image of one pixel", "One tile, mostly outside of the image.", (1, 1))
@RASTERIZER.case("an image of one row", "Tiles of which 15 rows of 16 are outside.", (40, 1))
@RASTERIZER.case("an image of one column", "The same across.", (1, 40))
@RASTERIZER.case("an image one pixel wider than a tile", "A tile of one column.", (17, 17))
def _images(size: tuple[int, int]) -> None:
    hold(gaussians(20), size=size)


@RASTERIZER.case("a focal length of 0.01 pixels", "A frame that sees half the world: limits of x / z of 2000.", 0.01)
@RASTERIZER.case("a focal length of 1 pixel", "A field of view of 170 degrees.", 1.0)
@RASTERIZER.case("a focal length of 1e5 pixels", "Every Gaussian is larger than the frame.", 1e5)
def _focal(focal: float) -> None:
    hold(gaussians(20), focal=focal, tolerance=1e-5)


@RASTERIZER.case("harmonics of 1e4", "Colors far above 1 and gradients of their directions of 1e4.", 1e4)
@RASTERIZER.case("harmonics of -1e4", "Every color is clamped to 0.", -1e4)
@RASTERIZER.case("harmonics of 1e12", "Far beyond anything that can be learned.", 1e12)
def _harmonics(size: float) -> None:
    scene = gaussians(20)
    scene["colors"] = torch.full_like(scene["colors"], size)
    hold(scene)


@RASTERIZER.case("1000 splats on one pixel", "Blending must stop, and the backward pass find where.", 1000)
def _pixel(n: int) -> None:
    scene = gaussians(n, degree=0)
    scene["means"] = torch.tensor([[0.0, 0.0, 3.0]], dtype=torch.float64) + 1e-4 * scene["means"]
    scene["scales"] = scene["scales"] * 0.1
    scene["opacities"] = scene["opacities"] * 0.02
    hold(scene, size=(16, 16), tolerance=1e-6)


@RASTERIZER.case(
    "1e5 splats on one pixel", "Sums of 1e5 small terms, and a transmittance of 1e-4 reached by rounding.", slow=True
)
def _() -> None:
    n = 100_000
    scene = {name: value.float() for name, value in gaussians(n, degree=0).items()}
    scene["means"] = torch.tensor([[0.0, 0.0, 3.0]]) + 1e-4 * scene["means"]
    scene["scales"], scene["opacities"] = 0.1 * scene["scales"], torch.full((n,), 0.0041)
    Ks = torch.tensor([[[30.0, 0, 8], [0, 30.0, 8], [0, 0, 1]]])
    drawn = draw(cpu.rasterization, scene, torch.eye(4)[None], Ks, 16, 16, sh_degree=0)
    assert all(torch.isfinite(value).all() for value in drawn.values())
    assert drawn["alpha"].max() <= 1


@RASTERIZER.case(
    "finite differences away from the cut-offs", "A hand-written gradient that agrees with no difference quotient."
)
def _() -> None:
    # Opacities that stay above 1/255 within the tiles and transmittances that stay above 1e-4: nothing is cut off.
    scene = gaussians(3, degree=0)
    scene["means"][:, :2] *= 0.1
    scene["scales"] = torch.full_like(scene["scales"], 3.0)
    scene["opacities"] = torch.full((3,), 0.5, dtype=torch.float64)
    Ks = torch.tensor([[[20.0, 0, 8], [0, 20.0, 8], [0, 0, 1]]], dtype=torch.float64)
    viewmats = torch.eye(4, dtype=torch.float64)[None]

    def image(*values: Tensor) -> Tensor:
        named = dict(zip(scene, values, strict=True))
        return cpu.rasterization(**named, viewmats=viewmats, Ks=Ks, width=16, height=16, sh_degree=0)[0]

    leaves = [value.clone().requires_grad_() for value in scene.values()]
    assert torch.autograd.gradcheck(image, leaves, eps=1e-6, atol=1e-6, rtol=1e-4)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000), st.integers(2, 30))
def _permuted(seed: int, n: int) -> None:
    scene = gaussians(n, seed)
    scene["means"][:, 2] = 2 + torch.arange(n) / n  # distinct depths
    order = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
    a, b = hold(scene), hold({name: value[order] for name, value in scene.items()})
    torch.testing.assert_close(a["image"], b["image"], rtol=0, atol=1e-12)
    torch.testing.assert_close(a["d means"][order], b["d means"], rtol=1e-9, atol=1e-12)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000), st.floats(0, 1), st.floats(0, 1))
def _background(seed: int, x: float, y: float) -> None:
    scene = gaussians(12, seed)
    Ks = torch.tensor([[[30.0, 0, 17], [0, 30.0, 11], [0, 0, 1]]], dtype=torch.float64)

    def on(value: float) -> Tensor:
        gray = torch.full((1, 3), value, dtype=torch.float64)
        viewmats = torch.eye(4, dtype=torch.float64)[None]
        options = {"width": WIDTH, "height": HEIGHT, "sh_degree": 3, "backgrounds": gray}
        return cpu.rasterization(**scene, viewmats=viewmats, Ks=Ks, **options)[0]

    torch.testing.assert_close(on((x + y) / 2), (on(x) + on(y)) / 2, atol=1e-12, rtol=0)


RASTERIZER.case("any order of Gaussians", "The picture depends on the order in which they are stored.")(_permuted)
RASTERIZER.case("any background", "A picture that is not linear in its background.")(_background)


@RASTERIZER.parametrize
def test_rasterizer(case: Case) -> None:
    case.check()


@pytest.mark.stability
@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat needs CUDA")
@RASTERIZER.parametrize
def test_gsplat(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "BODY", "gsplat")
    case.check()
