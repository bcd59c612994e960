"""Accuracy of structure from motion behind a static artifact: `python benchmarks/sfm_accuracy.py --data DIR ...`

Artifacts are put in front of the photos of datasets with known poses; `ssa process` runs on them in several ways.
Camera centers are compared with transforms.json after a similarity alignment, relative to the mean distance of the true
centers from their centroid.
"""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count, file_to_write
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.data.sources import read_source
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.runs.result_lines import read_lines
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
"""Whether photos are flattened, whether stationary matches are dropped, and the mask: none, detected, or the true one
(transmittance at most 0.9)."""


def measure(
    photos: Path, mask: np.ndarray | None, detect: bool, settings: SfmSettings, true: dict[str, np.ndarray]
) -> dict[str, float]:
    """Run structure from motion and compare its camera centers with the true ones.

    Args:
        photos: folder of the photos.
        mask: bool [height, width], True where features may lie, or None.
        detect: whether to detect a mask instead.
        settings: of structure from motion.
        true: camera center [3] by the stem of the photo's file.

    Returns:
        photos, registered, points; and error, the root mean square of the camera centers' errors in percent of the mean
        distance of the true centers from their centroid (NaN below 4 registered photos).
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


def center_errors(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Measure camera centers against true ones after the least-squares similarity between them.

    Args:
        found: [N, 3], in any frame and scale; N at least 3, not all on one line.
        true: [N, 3].

    Returns:
        Distances [N], in units of `true`.
    """
    rotation, scale, translation = similarity(found, true)
    return np.linalg.norm(scale * found @ rotation.T + translation - true, axis=1)


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Fit the similarity x -> scale R x + t between point sets by least squares.

    Umeyama, Least-squares estimation of transformation parameters between two point patterns, 1991.

    Args:
        source, target: [N, 3].

    Returns:
        Rotation R [3, 3], scale, translation t [3].
    """
    source_offsets, target_offsets = source - source.mean(axis=0), target - target.mean(axis=0)
    u, stretch, v = np.linalg.svd(target_offsets.T @ source_offsets)
    # Where the best fit is a reflection, the axis of the smallest singular value is flipped.
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    rotation = (u * signs) @ v
    scale = float((stretch * signs).sum() / np.square(source_offsets).sum())
    return rotation, scale, target.mean(axis=0) - scale * rotation @ source.mean(axis=0)


@dataclass
class Command:
    """Measure structure from motion behind artifacts, with and without countermeasures."""

    data: tuple[Path, ...]
    """Datasets with true poses."""
    output: Annotated[Path, file_to_write()]
    """File of JSON lines to append to, one for each run; runs that it has are not repeated."""
    effects: tuple[str, ...] = ("none", "dashboard", "ui", "mud")
    """Artifacts; none for clean photos."""
    ways: tuple[Literal["COLMAP", "detection", "mask", "default", "default and detection"], ...] = tuple(WAYS)
    """Countermeasures; COLMAP for none."""
    photos: Count = 40
    """Largest number of training photos, the first in order."""
    max_image_size: Count = 1600
    """Longest side of the photos for feature extraction, pixels."""
    threads: Count = 1
    """Threads."""

    def run(self) -> None:
        """Measure, and print the rows.

        Raises:
            InputError: a dataset or an effect cannot be used, or `output` holds something else.
        """
        read_effects(tuple(effect for effect in self.effects if effect != "none"))
        done = read_lines(self.output, ("data", "artifact", "way"))
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
                settings = SfmSettings(
                    "exhaustive", self.max_image_size, flatten, filter_stationary, threads=self.threads
                )
                used = _open_part(capture / "layers/raw.npz") if mask == "true" else None
                result = json.dumps(row | measure(photos, used, mask == "detected", settings, true))
                print(result, flush=True)
                with self.output.open("a") as file:
                    file.write(result + "\n")


def _open_part(layers: Path) -> np.ndarray:
    """Mask of the pixels whose transmittance is above 0.9, bool [H, W]."""
    with np.load(layers) as arrays:
        return arrays["T"].min(axis=-1) > 0.9


if __name__ == "__main__":
    run_script(Command)
