"""How often intervals are found where an artifact changes, and where none does: `python benchmarks/interval_rates.py`

Photos of real captures: as they are, behind one artifact all the time, or behind one that comes half-way, is there in
the middle third, or is replaced half-way by another of its kind.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import track

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.data.photos import read_photo
from ssa_nerfstudio.evidence.change_points import change_points
from ssa_nerfstudio.evidence.statistics import ImageStatistics
from ssa_nerfstudio.experiments.simulation.scene import Scene, read_effects

RECORDED = "recorded"
"""The artifact that the capture itself has, where clean/ has its photos without it."""
COURSES = ("always", "second half", "middle third", "replaced half-way")
"""When an artifact is there."""


@dataclass(frozen=True)
class Capture:
    """Photos in their order, uint8 [H, W, 3]."""

    clean: list[np.ndarray]
    recorded: list[np.ndarray] | None
    """The same with the artifact that they were recorded with."""

    @classmethod
    def read(cls, data: Path) -> Capture:
        """Read the photos of a dataset, all of one size."""
        dataset = Dataset.read(data, eval_interval=8)
        photos = [dataset.read_photo(view) for view in dataset.views]
        if not (data / "clean").is_dir():
            return cls(photos, None)
        return cls([read_photo(data / "clean" / Path(view.path).name) for view in dataset.views], photos)

    def layers(self, effect: str, seed: int) -> list[Callable[[int], np.ndarray]]:
        """Two artifacts of one kind (a recorded one has no other), each as a function from a photo's number to it."""
        if effect == RECORDED:
            recorded = self.recorded or []
            return [lambda number: recorded[number]]
        artifacts = [Scene(read_effects((effect,)), s).draw(*self.clean[0].shape[:2]) for s in (2 * seed, 2 * seed + 1)]
        return [lambda number, a=artifact: a.apply(self.clean[number], None) for artifact in artifacts]


def course(name: str, views: int) -> list[int | None]:
    """The number of the artifact in front of each view, 0 or 1; None for none."""
    half, third = views // 2, views // 3
    return {
        "never": [None] * views,
        "always": [0] * views,
        "second half": [None] * half + [0] * (views - half),
        "middle third": [None] * third + [0] * third + [None] * (views - 2 * third),
        "replaced half-way": [0] * half + [1] * (views - half),
    }[name]


def gathered(capture: Capture, effect: str, seed: int, at: list[int | None]) -> ImageStatistics:
    """Statistics of a capture whose photos have the artifacts `at` in front."""
    statistics, layers = ImageStatistics(), capture.layers(effect, seed)
    for number, which in enumerate(at):
        statistics.add(torch.from_numpy(capture.clean[number] if which is None else layers[which](number)))
    return statistics


@dataclass
class Command:
    """Count captures in which intervals are found, and by how many photos their ends are off."""

    data: tuple[Path, ...]
    """Clean nerfstudio datasets, or ones with clean counterparts of all photos in clean/."""
    effects: tuple[str, ...] = (RECORDED, "watermark", "ui", "dashboard", "rain", "mud")
    """Effects, each alone; recorded: the capture's own, where it has clean counterparts."""
    seeds: Count = 3
    """Seeds of each effect and of the shifts."""
    rate: bool = False
    """Measure the time of the scan instead."""

    def run(self) -> None:
        """Print a Markdown table row by row.

        Raises:
            InputError: a dataset or an effect cannot be used.
        """
        read_effects(tuple(effect for effect in self.effects if effect != RECORDED))
        for row in self._rate_rows() if self.rate else self._rows():
            print(row, flush=True)

    def _rows(self) -> Iterator[str]:
        yield "| capture | effect | " + " | ".join(COURSES) + " |"
        yield "|---|---|" + "---|" * len(COURSES)
        for data in self.data:
            capture = Capture.read(data)
            never = [_found(capture, "ui", seed, "never") for seed in range(self.seeds)]
            yield f"| `{data.name}` | none | {_cell(never)} |" + " - |" * (len(COURSES) - 1)
            effects = [effect for effect in self.effects if effect != RECORDED or capture.recorded]
            for effect in track(effects, data.name, transient=True, console=Console(stderr=True)):
                cells = [
                    "-"
                    if effect == RECORDED and name == COURSES[3]
                    else _cell([_found(capture, effect, seed, name) for seed in range(self.seeds)])
                    for name in COURSES
                ]
                yield f"| `{data.name}` | {effect} | " + " | ".join(cells) + " |"

    def _rate_rows(self) -> Iterator[str]:
        yield "| capture | scan without a change, CPU s | with one |"
        yield "|---|---|---|"
        for data in self.data:
            capture, seconds = Capture.read(data), []
            for name in COURSES[:2]:
                statistics = gathered(capture, "ui", 0, course(name, len(capture.clean)))
                turns = []
                for _ in range(3):
                    started = time.process_time()
                    change_points(statistics)
                    turns.append(time.process_time() - started)
                seconds.append(f"{np.median(turns):.1f}")
            yield f"| `{data.name}` | " + " | ".join(seconds) + " |"


def _found(capture: Capture, effect: str, seed: int, name: str) -> tuple[list[int], list[int]]:
    """Change points that are found, and those that are there."""
    at = course(name, len(capture.clean))
    true = [view for view in range(1, len(at)) if at[view] != at[view - 1]]
    return change_points(gathered(capture, effect, seed, at), seed=seed), true


def _cell(runs: list[tuple[list[int], list[int]]]) -> str:
    """Runs in which change points are found; of those with the right number, the largest distance from the truth."""
    hits = [(cuts, true) for cuts, true in runs if cuts]
    text = f"{len(hits)} of {len(runs)}"
    if not runs[0][1] or not hits:
        return text
    right = [(cuts, true) for cuts, true in hits if len(cuts) == len(true)]
    off = max((abs(cut - at) for pair in right for cut, at in zip(*pair, strict=True)), default=0)
    others = f", {len(hits) - len(right)} with another number" if len(right) < len(hits) else ""
    return f"{text}, off by {off}{others}"


if __name__ == "__main__":
    run_script(Command)
