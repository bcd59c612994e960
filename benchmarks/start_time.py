"""Seconds from a command to the end of its first training step: `python benchmarks/start_time.py --data DIR`

Each start is a process of its own, `ns-train METHOD --data DIR` with its defaults but for the viewer, which waits for
no browser; methods take turns. The first round may compile kernels, which later ones find. A method that is not this
plugin's starts as without the plugin, which makes every command start faster.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.errors import InputError

_PROGRAM = """
import os
import sys
import torch
from nerfstudio.plugins import registry
if not sys.argv[1].startswith("ssa-"):
    registry.discover_methods = lambda: ({}, {})
from nerfstudio.engine.trainer import Trainer
from nerfstudio.scripts.train import entrypoint
setup = Trainer.setup
def set_up(trainer, *arguments, **options):
    setup(trainer, *arguments, **options)
    iteration = trainer.train_iteration
    def first_step(step):
        iteration(step)
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        print("\\nTHE FIRST STEP IS DONE", flush=True)
        os._exit(0)
    trainer.train_iteration = first_step
Trainer.setup = set_up
entrypoint()
"""


@dataclass
class Command:
    """Time how long methods take from the command to the end of their first step."""

    data: Path
    """A nerfstudio dataset."""
    methods: tuple[str, ...] = ("splatfacto", "ssa-splatfacto")
    """Methods to start, in turn."""
    rounds: Count = 4
    """Starts of each; the first is not counted."""

    def run(self) -> None:
        """Print each start, then a line for each method: its seconds, their median, and its ratio to the first.

        Raises:
            InputError: there is no such method, the dataset cannot be trained on, or a start failed.
        """
        Transforms.read(self.data)
        from nerfstudio.configs.method_configs import all_methods

        for method in self.methods:
            if method not in all_methods:
                raise InputError(f"--methods: there is no method {method!r}", f"choose among {', '.join(all_methods)}")
        seconds: dict[str, list[float]] = {method: [] for method in self.methods}
        for _ in range(self.rounds):
            for method in self.methods:
                seconds[method].append(_start(method, self.data))
                print(f"{method}: {seconds[method][-1]:.1f} s", flush=True)
        medians = {method: statistics.median(found[1:] or found) for method, found in seconds.items()}
        for method, found in seconds.items():
            each = ", ".join(f"{value:.1f}" for value in found)
            ratio = medians[method] / medians[self.methods[0]]
            print(f"{method}: {each} s; median without the first {medians[method]:.2f} s, {ratio:.2f} times")


def _start(method: str, data: Path) -> float:
    with tempfile.TemporaryDirectory() as folder:
        words = [method, "--data", str(data), "--output-dir", folder, "--vis", "tensorboard"]
        begin = time.perf_counter()
        process = subprocess.run([sys.executable, "-c", _PROGRAM, *words], capture_output=True, text=True)
        if "THE FIRST STEP IS DONE" not in process.stdout:
            reason = (process.stderr.strip() or process.stdout.strip()).rpartition("\n")[2]
            raise InputError(f"{method} did not start: {reason}", "start it by ns-train to see why")
        return time.perf_counter() - begin


if __name__ == "__main__":
    run_script(Command)
