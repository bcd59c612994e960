"""Time of the cpu rasterizer of two checkouts: `python benchmarks/rasterizer_revisions.py --before DIR`

Forward and backward of RGB and expected depth with absolute gradients, on the random scenes of `rasterizers.py`. The
two take turns, so that a busy machine slows both alike; times are CPU time of the process, on one thread unless
`--threads` says otherwise.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median

import torch
from rasterizers import random_scene
from rich.console import Console
from rich.table import Table

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.rasterization import rasterizer

SCENES = ((10_000, 256, 0.012), (50_000, 512, 0.006), (50_000, 512, 0.012))
"""Number of Gaussians, side of the image in pixels, median standard deviation in world units."""


def rasterization_of(checkout: Path) -> Callable:
    """Import the cpu rasterizer of another checkout beside this one's."""
    ours = {name: module for name, module in sys.modules.items() if name.split(".")[0] == "ssa_nerfstudio"}
    for name in ours:
        del sys.modules[name]
    sys.path.insert(0, str(checkout))
    try:
        from ssa_nerfstudio.rasterization.cpu import rasterization
    finally:
        sys.path.remove(str(checkout))
        for name in [name for name in sys.modules if name.split(".")[0] == "ssa_nerfstudio"]:
            del sys.modules[name]
        sys.modules.update(ours)
    return rasterization


def draw(rasterization: Callable, leaves: dict, viewmats: torch.Tensor, Ks: torch.Tensor, size: int) -> list[float]:
    """Seconds of CPU time of forward and of backward."""
    for leaf in leaves.values():
        leaf.grad = None
    start = time.process_time()
    image, alpha, _ = rasterization(
        **leaves, viewmats=viewmats, Ks=Ks, width=size, height=size, sh_degree=3, render_mode="RGB+ED", absgrad=True
    )
    middle = time.process_time()
    torch.autograd.backward([image, alpha], [torch.ones_like(image), torch.ones_like(alpha)])
    return [middle - start, time.process_time() - middle]


@dataclass
class Command:
    """Time forward and backward of the cpu rasterizer of another checkout and of this one, in turn."""

    before: Path
    """The other checkout, such as a git worktree."""
    repeats: Count = 15
    """Rounds, of which the median counts."""
    threads: Count = 1
    """Threads of the kernels and of torch."""

    def run(self) -> None:
        """Print a table.

        Raises:
            InputError: `before` is no checkout.
        """
        if not (self.before / "ssa_nerfstudio" / "rasterization" / "cpu.py").is_file():
            raise InputError(f"{self.before} is no checkout of this repository", "give the folder of a git worktree")
        torch.set_num_threads(self.threads)
        both = {"before": rasterization_of(self.before.resolve()), "now": rasterizer("cpu", "cpu")}
        table = Table(title=f"ms of CPU time, median of {self.repeats}, {self.threads} threads")
        for column in ("Gaussians", "pixels", "size", "", "before", "now", "before / now"):
            table.add_column(column)
        for n, size, spread in SCENES:
            gaussians, viewmats, Ks = random_scene(n, size, size, spread)
            leaves = {name: value.requires_grad_() for name, value in gaussians.items()}
            runs = {name: partial(draw, body, leaves, viewmats, Ks, size) for name, body in both.items()}
            seconds = {name: [] for name in runs}
            for repeat in range(self.repeats + 2):  # the first two compile and warm up
                for name, run in runs.items():
                    forward, backward = run()
                    if repeat >= 2:
                        seconds[name].append((forward, backward, forward + backward))
            for part, title in enumerate(("forward", "backward", "both")):
                before, now = (1e3 * median(times[part] for times in seconds[name]) for name in ("before", "now"))
                scene = (f"{n}", f"{size} x {size}", f"{spread}") if part == 0 else ("", "", "")
                table.add_row(*scene, title, f"{before:.1f}", f"{now:.1f}", f"{before / now:.2f}")
        Console(width=120).print(table)


if __name__ == "__main__":
    run_script(Command)
