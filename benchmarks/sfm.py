"""How well does structure from motion survive a static artifact, and what helps?

`python benchmarks/sfm.py --data DIR ...` puts artifacts in front of the photos of datasets with known
poses, runs `ssa process` on them in several ways, and prints one row a run. Camera centers are compared with
transforms.json after a similarity alignment, relative to the mean distance of the true centers from their middle.
"""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.alignment import center_errors
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.data.sources import read_source
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.simulation.scene import Scene, read_effects
from ssa_nerfstudio.experiments.simulation.simulator import simulate
from ssa_nerfstudio.sfm.photos_to_dataset import process
from ssa_nerfstudio.sfm.reconstruction import SfmSettings

WAYS = {
    "COLMAP": (False, False, "none"),
    "detection": (False, False, "detected"),
    "mask": (False, False, "true"),
    "default": (True, True, "none"),
    "default and detection": (True, True, "detected"),
}
"""Flattened photos, dropped stationary matches, which mask (the true one: where the transmittance is at most 0.9)."""


def measure(
    photos: Path, mask: np.ndarray | None, detect: bool, settings: SfmSettings, true: dict[str, np.ndarray]
) -> dict[str, float]:
    """Runs structure from motion and compares what it found.

    Args:
        photos: folder of them.
        mask: bool [height, width], True where features may lie, or None.
        detect: whether the command finds a mask by itself.
        settings: of structure from motion.
        true: camera center [3] by the stem of the photo's file.

    Returns:
        photos, registered, points; and error, the root mean square of the camera centers' errors in percent of the mean
        distance of the true centers from their middle (not a number below 4 registered photos).
    """
    source = read_source(photos, "frame", min_photos=3)
    found = {"photos": len(source.photos), "registered": 0, "points": 0, "error": float("nan")}
    with tempfile.TemporaryDirectory() as scratch:
        output = Path(scratch) / "dataset"
        try:
            outcome = process([source], output, mask, detect, min_registered=0, settings=settings)
        except InputError:
            return found
        frames = json.loads((output / "transforms.json").read_text())["frames"]
    centers = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    wanted = np.array([true[Path(frame["source_name"]).stem] for frame in frames])
    found |= {"registered": len(frames), "points": outcome.points}
    if len(frames) > 3:
        everywhere = np.array([true[photo.stem] for photo in source.photos])
        extent = np.linalg.norm(everywhere - everywhere.mean(axis=0), axis=1).mean()
        found["error"] = 100 * float(np.sqrt(np.square(center_errors(centers, wanted)).mean()) / extent)
    return found


@dataclass
class Command:
    """Structure from motion behind artifacts, with and without what helps."""

    data: tuple[Path, ...]
    """Datasets with true poses."""
    output: Path
    """JSON lines to write, one a run; runs that it has already are not repeated."""
    effects: tuple[str, ...] = ("none", "dashboard", "ui", "mud")
    """Artifacts; none: clean photos."""
    ways: tuple[str, ...] = tuple(WAYS)
    """What to do against them: COLMAP (nothing), detection, mask, default, default and detection."""
    photos: int = 40
    """At most so many training photos, the first in order."""
    max_image_size: int = 1600
    """Longest side that features are looked for at, pixels."""
    threads: int = 1
    """Threads."""

    def run(self) -> None:
        """Measure, and print the rows."""
        done = [json.loads(line) for line in self.output.read_text().splitlines()] if self.output.exists() else []
        for data in self.data:
            for effect in self.effects:
                ways = [way for way in self.ways if effect != "none" or way in ("COLMAP", "default")]
                asked = [{"data": data.name, "artifact": effect, "way": way} for way in ways]
                if left := [row for row in asked if not any(row.items() <= other.items() for other in done)]:
                    self._measure(data, effect, left)

    def _measure(self, data: Path, effect: str, asked: list[dict[str, str]]) -> None:
        meta = Dataset.read(data, eval_interval=8).meta
        true = {Path(frame["file_path"]).stem: np.array(frame["transform_matrix"])[:3, 3] for frame in meta["frames"]}
        with tempfile.TemporaryDirectory() as folder:
            capture, photos = Path(folder) / "capture", Path(folder) / "photos"
            scene = Scene(read_effects(() if effect == "none" else (effect,)))
            simulate(Dataset.read(data, eval_interval=8), scene, capture, self.threads)
            photos.mkdir()
            for path in sorted(Dataset.read(capture, eval_interval=8).split[0])[: self.photos]:
                os.link(capture / path, photos / Path(path).name)
            for row in asked:
                flatten, filter_stationary, mask = WAYS[row["way"]]
                settings = SfmSettings("exhaustive", self.max_image_size, flatten, filter_stationary, self.threads)
                used = _open_part(capture / "layers/raw.npz") if mask == "true" else None
                result = json.dumps(row | measure(photos, used, mask == "detected", settings, true))
                print(result, flush=True)
                with self.output.open("a") as file:
                    file.write(result + "\n")


def _open_part(layers: Path) -> np.ndarray:
    """Where the true artifact leaves more than 90 % of the scene's light."""
    with np.load(layers) as arrays:
        return arrays["T"].min(axis=-1) > 0.9


if __name__ == "__main__":
    import tyro

    tyro.cli(Command).run()
