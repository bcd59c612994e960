"""Seconds of each part of an overlay's start: `python benchmarks/initialization_time.py --data DIR`

Each round is a process of its own, because loading kernels is part of a start. Parts are timed with the GPU idle before
and after. They are nested: `learned_overlays` is all of the overlay, `estimate` holds `estimate_falloff` and
`estimate_layers`, and `find_extra_seeds` holds `distant_points` and `gap_points`.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.errors import InputError

_PROGRAM = """
import functools, json, sys, time
from pathlib import Path
import torch
from ssa_nerfstudio.evidence import initialization
from ssa_nerfstudio.plugin import extra_seeds, overlay_setup, pipeline
parts = {}
def now():
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()
def timed(module, name):
    function = getattr(module, name)
    @functools.wraps(function)
    def timing(*arguments, **options):
        begin = now()
        result = function(*arguments, **options)
        parts[name] = parts.get(name, 0.0) + now() - begin
        return result
    setattr(module, name, timing)
for name in ("change_points", "detect", "sample_points", "estimate", "initialize_from"):
    timed(overlay_setup, name)
for name in ("estimate_falloff", "estimate_layers"):
    timed(initialization, name)
for name in ("learned_overlays", "nearest_depth", "find_extra_seeds"):
    timed(pipeline, name)
for name in ("distant_points", "gap_points"):
    timed(extra_seeds, name)
from ssa_nerfstudio.experiments.runs.run_configuration import configure
config = configure("ssa-splatfacto", Path(sys.argv[1]), Path(sys.argv[2]), 1)
config.pipeline.model.overlay = "on"
device = "cuda" if torch.cuda.is_available() else "cpu"
config.pipeline.setup(device=device, test_mode="val", world_size=1, local_rank=0)
print("PARTS", json.dumps(parts))
"""


@dataclass
class Command:
    """Time the parts of an overlay's start, from decoded photos on."""

    data: Path
    """A nerfstudio dataset."""
    rounds: Count = 3
    """Processes."""

    def run(self) -> None:
        """Print a row for each part: its seconds in every round, and their median.

        Raises:
            InputError: the dataset cannot be trained on, or a start failed.
        """
        Transforms.read(self.data)
        found = [_parts(self.data) for _ in range(self.rounds)]
        print("| part | seconds | median |\n|---|---|---|")
        for part in found[0]:
            seconds = [each.get(part, 0.0) for each in found]
            print(f"| `{part}` | {', '.join(f'{value:.2f}' for value in seconds)} | {statistics.median(seconds):.2f} |")


def _parts(data: Path) -> dict[str, float]:
    words = [sys.executable, "-c", _PROGRAM, str(data), "unused"]
    process = subprocess.run(words, capture_output=True, text=True)
    lines = [line for line in process.stdout.splitlines() if line.startswith("PARTS ")]
    if not lines:
        reason = (process.stderr.strip() or process.stdout.strip()).rpartition("\n")[2]
        raise InputError(f"the overlay was not initialized: {reason}", "try to train on it by ns-train")
    return json.loads(lines[0].removeprefix("PARTS "))


if __name__ == "__main__":
    run_script(Command)
