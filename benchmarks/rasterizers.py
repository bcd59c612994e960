"""Accuracy and speed of the rasterizers: `python benchmarks/rasterizers.py`

Image, alpha, expected depth and every gradient of each implementation on this machine are compared with `reference` in
float64, on Gaussians like those of a trained scene; forward + backward is timed. On a CUDA machine gsplat's own
`rasterization` is compared, too. Errors are relative in the 2-norm: |a - b| / |b|.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count
from ssa_nerfstudio.rasterization import rasterizer, reference
from ssa_nerfstudio.rasterization.interface import Gaussians, RenderOptions
from ssa_nerfstudio.rasterization.projection import project

PARAMETERS = ("means", "quats", "scales", "opacities", "colors")
"""Parameters of a Gaussian, in the order of the rasterizers' arguments."""
Scene = tuple[dict[str, Tensor], Tensor, Tensor]
"""Arguments of `rasterization`: parameters by name, viewmats [C, 4, 4], Ks [C, 3, 3]."""
OPTIONS = RenderOptions(
    near_plane=0.01,
    far_plane=1e10,
    radius_clip=0.0,
    eps2d=0.3,
    sh_degree=3,
    render_mode="RGB",
    absgrad=False,
    antialiased=False,
)
"""The defaults of `rasterization`, with third-degree harmonics."""


def random_scene(
    n: int, width: int, height: int, size: float, dtype: torch.dtype = torch.float32, seed: int = 0
) -> Scene:
    """Gaussians in a 2 x 2 x 2 cube three units in front of a camera in general position.

    Args:
        n: number of Gaussians.
        size: their median standard deviation, in world units.

    Returns:
        The scene, with colors as third-degree spherical harmonics.
    """
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    in_camera = torch.rand(n, 3, generator=generator) * 2 - 1
    in_camera[:, 2] += 3
    viewmats = torch.eye(4)[None]
    viewmats[0, :3, :3] = torch.linalg.qr(normal(3, 3)).Q
    viewmats[0, :3, 3] = normal(3)
    gaussians = {
        "means": (in_camera - viewmats[0, :3, 3]) @ viewmats[0, :3, :3],
        "quats": normal(n, 4),
        "scales": size * torch.exp(0.4 * normal(n, 3)),
        "opacities": torch.rand(n, generator=generator),
        "colors": 0.3 * normal(n, 16, 3),
    }
    Ks = torch.tensor([[1.1 * width, 0, width / 2], [0, 1.1 * width, height / 2], [0, 0, 1]], dtype=dtype)[None]
    return {name: value.to(dtype) for name, value in gaussians.items()}, viewmats.to(dtype), Ks


def draw(
    rasterization: Callable,
    gaussians: dict[str, Tensor],
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    **options,
) -> dict[str, Tensor]:
    """Render RGB and expected depth and backpropagate fixed random cotangents: every output and gradient by name."""
    leaves = {name: value.detach().clone().requires_grad_() for name, value in gaussians.items()}
    options = {"sh_degree": 3, "render_mode": "RGB+ED", "packed": False, **options}
    render, alpha, info = rasterization(**leaves, viewmats=viewmats, Ks=Ks, width=width, height=height, **options)
    info["means2d"].retain_grad()
    generator = torch.Generator().manual_seed(1)
    cotangent = torch.rand(*render.shape[:3], render.shape[3] + 1, generator=generator).to(render)
    ((render * cotangent[..., :-1]).sum() + (alpha * cotangent[..., -1:]).sum()).backward()
    results = {"image": render[..., :3], "alpha": alpha, "depth": render[..., 3:]}
    results.update({f"d {name}": leaf.grad for name, leaf in leaves.items()})  # pyright: ignore[reportArgumentType]
    results["d means2d"] = info["means2d"].grad
    if hasattr(info["means2d"], "absgrad"):
        results["|d means2d|"] = info["means2d"].absgrad
    return {name: value.detach().to("cpu", torch.float64) for name, value in results.items()}


def floor(gaussians: dict[str, Tensor], viewmats: Tensor, Ks: Tensor, width: int, height: int) -> None:
    """Projection, harmonics and autograd in torch, without blending: a lower bound of a torch rasterizer's time."""
    leaves = Gaussians(**{name: value.detach().clone().requires_grad_() for name, value in gaussians.items()})
    splats = project(leaves, viewmats[0], Ks[0], width, height, OPTIONS)
    (splats.means2d.sum() + splats.conics.sum() + splats.opacities.sum() + splats.colors.sum()).backward()


def relative_error(a: Tensor, b: Tensor) -> float:
    """|a - b| / |b| in the 2-norm."""
    return float((a - b).norm() / b.norm().clamp_min(1e-300))


def bodies() -> dict[str, tuple[Callable, str, torch.dtype]]:
    """Implementations on this machine (numba for `cpu`, CUDA for gsplat): name to (function, device, dtype)."""
    found = {}
    if importlib.util.find_spec("numba"):
        splatter = rasterizer("cpu", "cpu")
        found = {"cpu": (splatter, "cpu", torch.float32), "cpu float64": (splatter, "cpu", torch.float64)}
    if torch.cuda.is_available():
        from gsplat.rendering import rasterization

        found["gsplat (our call)"] = (rasterizer("gsplat", "cuda"), "cuda", torch.float32)
        found["gsplat.rasterization"] = (rasterization, "cuda", torch.float32)
    return found


def compare(n: int, width: int, height: int, size: float) -> Table:
    """Compare implementations with `reference` in float64: a column for each, a row for each result."""
    scene = random_scene(n, width, height, size, torch.float64)
    oracle = draw(reference.rasterization, *scene, width, height)
    table = Table(title=f"relative error against reference in float64: {n} Gaussians, {width} x {height}")
    table.add_column("")
    columns = {}
    for name, (rasterization, device, dtype) in bodies().items():
        columns[name] = draw(rasterization, *_moved(scene, device, dtype), width, height, absgrad=True)
        table.add_column(name)
    if "cpu float64" in columns:  # autograd, and with it the reference, has no sum of magnitudes
        oracle["|d means2d|"] = columns["cpu float64"]["|d means2d|"]
    for key in oracle:
        table.add_row(key, *(f"{relative_error(column[key], oracle[key]):.1e}" for column in columns.values()))
    return table


def time_bodies(n: int, width: int, height: int, size: float, repeats: int = 10) -> Table:
    """Time forward + backward: median milliseconds, and their ratio to projection + SH + autograd alone ("floor")."""
    scene = random_scene(n, width, height, size)

    runs: dict[str, Callable] = {"floor": partial(floor, *scene, width, height)}
    for name, (rasterization, device, dtype) in bodies().items():
        if dtype == torch.float32:
            runs[name] = partial(draw, rasterization, *_moved(scene, device, dtype), width, height)
    runs["reference"] = partial(draw, reference.rasterization, *scene, width, height)
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for repeat in range(repeats + 2):  # interleaved, so that a busy machine slows all alike; the first two warm up
        for name, run in runs.items():
            if name == "reference" and repeat > 3:
                continue
            start = time.perf_counter()
            run()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            seconds[name].append(time.perf_counter() - start)
    medians = {name: sorted(values[2:])[len(values[2:]) // 2] for name, values in seconds.items()}
    table = Table(title=f"forward + backward, {n} Gaussians, {width} x {height}, {torch.get_num_threads()} threads")
    for column in ("", "ms", "x floor"):
        table.add_column(column)
    for name, median in medians.items():
        table.add_row(name, f"{1e3 * median:.1f}", f"{median / medians['floor']:.2f}")
    return table


def _moved(scene: Scene, device: str, dtype: torch.dtype) -> Scene:
    gaussians, viewmats, Ks = scene
    return {k: v.to(device, dtype) for k, v in gaussians.items()}, viewmats.to(device, dtype), Ks.to(device, dtype)


@dataclass
class Command:
    """Compare the rasterizers of this machine with the reference in float64, and time them."""

    compared: Count = 2_000
    """Gaussians of the comparison, in 160 x 120 pixels."""
    timed: Count = 10_000
    """Gaussians of the timing, in 256 x 256 pixels."""
    repeats: Count = 10
    """Rounds of the timing, of which the median counts."""

    def run(self) -> None:
        """Print both tables with versions."""
        console = Console(width=140)
        device = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
        console.print(f"{device}, torch {torch.__version__}, gsplat {version('gsplat')}")
        console.print(compare(self.compared, 160, 120, 0.03))
        console.print(time_bodies(self.timed, 256, 256, 0.012, self.repeats))


if __name__ == "__main__":
    run_script(Command)
