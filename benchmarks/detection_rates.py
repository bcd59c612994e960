"""How often detection finds an artifact, and how often one that is not there: `python benchmarks/detection_rates.py`

Each effect is put in front of the raw photos of each capture, with several seeds and numbers of views; there is a row
for each capture and effect. With `--contiguous` views are neighbors, as in a short clip, where parallax is smallest.
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

from ssa_nerfstudio.cameras.lens import undistort
from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count, NotNegative
from ssa_nerfstudio.data.dataset import Dataset, View
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.detection import Detection, detect
from ssa_nerfstudio.evidence.statistics import ImageStatistics
from ssa_nerfstudio.experiments.effects.composition import Composition
from ssa_nerfstudio.experiments.simulation.scene import Scene, read_effects


def spread(total: int, count: int) -> set[int]:
    """Numbers of evenly spaced views, 0 for all."""
    return set(np.linspace(0, total - 1, count or total).round().astype(int).tolist())


def stretches(total: int, count: int) -> list[set[int]]:
    """Numbers of neighboring views at the beginning, in the middle and at the end of a capture."""
    return [set(range(start, start + count)) for start in (0, (total - count) // 2, total - count)]


def detections(dataset: Dataset, effect: str | None, seed: int, chosen: list[set[int]]) -> list[Detection]:
    """Detect an artifact in several subsets of a capture's views, in one pass over its photos.

    Args:
        dataset: all its photos are clean and of one size.
        effect: name of the effect to put in front, or None.
        seed: of the effect, and of detection's shifts.
        chosen: for each subset the numbers of its views, from 0.
    """
    views = dataset.views
    scene = Scene(read_effects((effect,)), seed) if effect else None
    artifact = scene.draw(*views[0].size) if scene else None
    all_statistics = [ImageStatistics() for _ in chosen]
    for number, view in enumerate(views):
        if not any(number in members for members in chosen):
            continue
        photo = _read(dataset, view)
        if scene is not None and artifact is not None:
            photo = _behind(scene, artifact, photo, number)
        for statistics, members in zip(all_statistics, chosen, strict=True):
            if number in members:
                statistics.add(torch.from_numpy(photo))
    return [detect(statistics, seed=seed) for statistics in all_statistics]


def rates(
    dataset: Dataset, repeats: int, clock: Callable[[], float] = time.process_time
) -> tuple[float, float, float, float]:
    """Time detection; medians over interleaved turns of the CPU seconds for all photos.

    Returns:
        Decoding and undistorting; statistics and blocks; the blocks of brightness alone; the test at the end.
    """
    turns = []
    for _ in range(repeats):
        statistics, seconds = ImageStatistics(), np.zeros(4)
        for view in dataset.views:
            started = clock()
            photo = torch.from_numpy(undistort(_read(dataset, view), view.lens))
            between = clock()
            statistics.add(photo)
            done = clock()
            statistics.brightness.add(photo.to(torch.int32), None)
            seconds[:3] += between - started, done - between, clock() - done
        started = clock()
        detect(statistics)
        seconds[3] = clock() - started
        turns.append(seconds)
    prepared, summed, blocks, tested = np.median(turns, axis=0)
    return float(prepared), float(summed), float(blocks), float(tested)


def _read(dataset: Dataset, view: View) -> np.ndarray:
    return dataset.read_photo(view)


def _behind(scene: Scene, artifact: Composition, photo: np.ndarray, number: int) -> np.ndarray:
    inside = artifact.view(scene.view_generators(artifact, number)) if artifact.box is not None else None
    return artifact.apply(photo, inside)


@dataclass
class Command:
    """Count detection's hits and false alarms, on captures as they are and behind simulated artifacts."""

    data: tuple[Path, ...]
    """Clean nerfstudio datasets."""
    effects: tuple[str, ...] = ("none", "watermark", "ui", "dashboard", "rain", "mud")
    """Effects, each alone; none for the photos as they are."""
    views: tuple[NotNegative, ...] = (12, 25, 50)
    """Numbers of views; 0 for all, unless contiguous."""
    contiguous: bool = False
    """Take neighboring views, from the beginning, the middle and the end, instead of evenly spread ones."""
    seeds: Count = 5
    """Seeds of each effect and of detection's shifts."""
    rate: bool = False
    """Measure the time of detection instead, beside that of decoding and undistorting."""

    def run(self) -> None:
        """Print a Markdown table row by row.

        Raises:
            InputError: a number is too small, or a dataset or an effect cannot be used.
        """
        if self.contiguous and 0 in self.views:
            raise InputError("--views 0 is all views, of which --contiguous has no parts", "leave one of them out")
        read_effects(tuple(effect for effect in self.effects if effect != "none"))
        for row in self._rate_rows() if self.rate else self._rows():
            print(row, flush=True)

    def _rows(self) -> Iterator[str]:
        yield "| capture | effect | " + " | ".join(f"{count or 'all'} views" for count in self.views) + " |"
        yield "|---|---|" + "---|" * len(self.views)
        cases = [(data, effect) for data in self.data for effect in self.effects]
        for data, effect in track(cases, "Detecting", transient=True, console=Console(stderr=True)):
            dataset = Dataset.read(data, eval_interval=8)
            total = len(dataset.views)
            choices = [
                [] if count > total else stretches(total, count) if self.contiguous else [spread(total, count)]
                for count in self.views
            ]
            chosen = [views for at in choices for views in at]
            name = None if effect == "none" else effect
            runs = [iter(detections(dataset, name, seed, chosen)) for seed in range(self.seeds)]
            cells = [_cell([next(run) for run in runs for _ in at]) if at else "-" for at in choices]
            yield f"| `{data.name}` | {effect} | " + " | ".join(cells) + " |"

    def _rate_rows(self) -> Iterator[str]:
        yield "| capture | decode and undistort, ms a photo | statistics | of which detection's | test at the end, s |"
        yield "|---|---|---|---|---|"
        for data in self.data:
            dataset = Dataset.read(data, eval_interval=8)
            prepared, summed, blocks, tested = rates(dataset, repeats=3)
            n = len(dataset.views) / 1000
            yield f"| `{data.name}` | {prepared / n:.1f} | {summed / n:.1f} | {blocks / n:.1f} | {tested:.2f} |"


def _cell(found: list[Detection]) -> str:
    """One cell: hits of all runs, their verdicts, and the mean share of the frame that they cover."""
    hits = [one for one in found if one.verdict != "none"]
    verdicts = "/".join(sorted({one.verdict for one in hits}))
    covered = f", {verdicts}, {np.mean([one.coverage for one in hits]):.1%}" if hits else ""
    return f"{len(hits)} of {len(found)}{covered}"


if __name__ == "__main__":
    run_script(Command)
