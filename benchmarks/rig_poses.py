"""Poses of a rig whose two cameras have an artifact each: `python benchmarks/rig_poses.py --data DIR ...`

Even photos of a dataset with known poses are cropped into front/, odd ones into side/, and something opaque is drawn in
front of either. `ssa process` runs on them with and without masks of what is detected. Centers are compared as by
`sfm_accuracy.py`.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from sfm_accuracy import center_errors

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count, at_least
from ssa_nerfstudio.data.sources import read_sources
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.sfm.photos_to_dataset import process
from ssa_nerfstudio.sfm.reconstruction import SfmSettings

CAMERAS = {"front": (480, 270), "side": (400, 300)}
"""Width and height of the crops."""
MIN_PHOTOS = 3
"""Of each camera."""


@dataclass
class Command:
    """Measure structure from motion on rigs behind two artifacts."""

    data: tuple[Path, ...]
    """Datasets with true poses."""
    photos: Annotated[int, at_least(2 * MIN_PHOTOS)] = 40
    """Number of photos, the first in order."""
    width: Annotated[int, at_least(max(width for width, _ in CAMERAS.values()))] = 640
    """Photos are reduced to it before they are cropped, pixels."""
    off_center: int = 0
    """How far the side camera's crop is right of the center, pixels; no camera is like this, but a user's crop may."""
    threads: Count = 1
    """Threads."""

    def run(self) -> None:
        """Measure, and print a line for each dataset and way.

        Raises:
            InputError: a dataset cannot be used, crops do not fit into its photos, or too few photos register.
        """
        if abs(self.off_center) > (most := (self.width - CAMERAS["side"][0]) // 2):
            raise InputError(
                f"--off-center must be from -{most} to {most} at --width {self.width}, got {self.off_center}"
            )
        metas = {data: self._meta(data) for data in self.data}
        for data, meta in metas.items():
            frames = sorted(meta["frames"], key=lambda frame: frame["file_path"])[: self.photos]
            true = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
            with tempfile.TemporaryDirectory() as scratch:
                rig = Path(scratch) / "rig"
                for number, frame in enumerate(frames):
                    self._write(data / frame["file_path"], rig, number)
                for detect in (False, True):
                    output = Path(scratch) / f"dataset_{detect}"
                    settings = SfmSettings(threads=self.threads)
                    found = process(read_sources(rig, "frame", MIN_PHOTOS), output, detect=detect, settings=settings)
                    row = {"data": data.name, "detect": detect, "masked": round(found.masked, 3)}
                    scale = self.width / meta["w"]
                    row["true lens"] = [round(scale * meta[key]) for key in ("fl_x", "fl_y")]
                    print(json.dumps(row | compared(output, true)), flush=True)

    def _meta(self, data: Path) -> dict[str, Any]:
        meta, tallest = Transforms.read(data).meta, max(height for _, height in CAMERAS.values())
        if not {"w", "h", "fl_x", "fl_y"} <= meta.keys():
            raise InputError(f"{data} does not state one lens for all photos", "choose a dataset of one camera")
        if (height := round(self.width * meta["h"] / meta["w"])) < tallest:
            problem = f"--width {self.width} makes photos of {data} {height} pixels high"
            raise InputError(problem, f"choose a larger one: crops are {tallest} high")
        return meta

    def _write(self, photo: Path, rig: Path, number: int) -> None:
        camera = "side" if number % 2 else "front"
        picture = cv2.imread(str(photo))
        height = round(self.width * picture.shape[0] / picture.shape[1])
        picture = cv2.resize(picture, (self.width, height), interpolation=cv2.INTER_AREA)
        width, tall = CAMERAS[camera]
        left = (self.width - width) // 2 + (self.off_center if camera == "side" else 0)
        top = (height - tall) // 2
        picture = picture[top : top + tall, left : left + width].copy()
        if camera == "front":  # a bonnet and a line of text
            cv2.ellipse(picture, (width // 2, tall + 20), (190, 70), 0, 0, 360, (90, 30, 30), -1, cv2.LINE_AA)
            cv2.putText(picture, "12.4 km/h", (20, 36), cv2.FONT_HERSHEY_TRIPLEX, 0.8, (60, 255, 120), 2, cv2.LINE_AA)
        else:  # a strut
            corners = np.array([[0, 0], [60, 0], [30, tall], [0, tall]])
            cv2.fillPoly(picture, [corners], (120, 120, 125), cv2.LINE_AA)
        (rig / camera).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(rig / camera / f"{number:04d}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 93])


def compared(dataset: Path, true: np.ndarray) -> dict[str, object]:
    """Lenses of a dataset, how many photos have poses, and the error of their centers, relative to the true extent.

    Args:
        dataset: made of photos called by their number.
        true: camera centers [N, 3].
    """
    frames = json.loads((dataset / "transforms.json").read_text())["frames"]
    centers = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    wanted = true[[int(Path(frame["source_name"]).stem) for frame in frames]]
    extent = np.linalg.norm(true - true.mean(axis=0), axis=1).mean()
    error = 100 * np.sqrt(np.square(center_errors(centers, wanted)).mean()) / extent
    lenses = {tuple(round(frame[key]) for key in ("fl_x", "fl_y")) for frame in frames}
    return {"lenses": sorted(lenses), "registered": len(frames), "error %": round(float(error), 2)}


if __name__ == "__main__":
    run_script(Command)
