"""Speed of `ssa simulate` beside decoding and encoding its photos: `python benchmarks/simulator_speed.py --data DIR`

The bare rate is that of reading every training photo and writing it as PNG, with the same code and as many threads.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from rich.console import Console
from rich.table import Table

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count
from ssa_nerfstudio.data.dataset import Dataset, View
from ssa_nerfstudio.data.photos import write_photo
from ssa_nerfstudio.experiments.effects.catalogue import EFFECTS
from ssa_nerfstudio.experiments.simulation.scene import Scene, read_effects
from ssa_nerfstudio.experiments.simulation.simulator import simulate


def measure(
    dataset: Dataset, effect: str, threads: int, repeats: int, clock: Callable[[], float] = time.perf_counter
) -> tuple[float, float]:
    """Time the bare round trip and the simulator in turns, so that a busy machine slows both alike.

    Args:
        dataset: its training photos are used.
        effect: name of the one effect.
        threads: photos in flight at once.
        repeats: turns, at least 1.
        clock: seconds.

    Returns:
        Medians over the turns: seconds of the bare round trip, seconds of the simulator with all that it writes.
    """
    train = [view for view in dataset.views if view.role == "train"]
    scene = Scene(read_effects((effect,)))
    seconds: tuple[list[float], list[float]] = ([], [])
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            scratch = Path(folder)
            started = clock()
            _round_trip(dataset, train, scratch / "bare", threads)
            between = clock()
            simulate(dataset, scene, scratch / "simulated", threads)
            seconds[0].append(between - started)
            seconds[1].append(clock() - between)
    return statistics.median(seconds[0]), statistics.median(seconds[1])


def _round_trip(dataset: Dataset, views: list[View], folder: Path, threads: int) -> None:
    def work(view: View) -> None:
        photo = dataset.read_photo(view)
        write_photo(folder / PurePosixPath(view.path).with_suffix(".png"), photo)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, views))


@dataclass
class Command:
    """Time the simulator against the bare decoding and encoding of the same photos."""

    data: Path
    """Dataset to read."""
    effects: tuple[str, ...] = tuple(EFFECTS)
    """Effects to time, each alone."""
    threads: Count = 2
    """Photos in flight at once."""
    repeats: Count = 3
    """Turns, of which the median counts."""

    def run(self) -> None:
        """Print a row for each effect.

        Raises:
            InputError: the dataset or an effect cannot be used.
        """
        read_effects(self.effects)
        dataset = Dataset.read(self.data, eval_interval=8)
        count = len(dataset.split[0])
        height, width = dataset.views[0].size
        table = Table(title=f"{count} photos of {width} x {height}, {self.threads} threads")
        for column in ("", "bare, photos/s", "simulated, photos/s", "ratio"):
            table.add_column(column)
        for effect in self.effects:
            bare, simulated = measure(dataset, effect, self.threads, self.repeats)
            table.add_row(effect, f"{count / bare:.1f}", f"{count / simulated:.1f}", f"{bare / simulated:.2f}")
        Console(width=120).print(table)


if __name__ == "__main__":
    run_script(Command)
