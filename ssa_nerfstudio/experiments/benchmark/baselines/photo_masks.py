"""3DGS with one mask for all photos, nerfstudio's `mask_path`: what people do about a static artifact today.

The loss leaves out masked pixels. The mask is the true one, as if it had been drawn by hand with great care, or what
`ssa detect` finds in the photos.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.data.writing import staged_folder
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.capture_detection import detect_camera, read_cameras
from ssa_nerfstudio.experiments.benchmark.baselines.baseline import Baseline, Capture
from ssa_nerfstudio.plugin.model import SSASplatfactoModel, SSASplatfactoModelConfig

VISIBLE = 0.02
"""A pixel belongs to a simulated artifact where T is below 1, or B above 0, by more than this: five gray levels."""
MASK = "artifact_is_black.png"
"""In the folder `ignored` of the dataset; what is black is ignored, as nerfstudio has it."""


@dataclass
class MaskConfig(SSASplatfactoModelConfig):
    """splatfacto's settings; the mask is part of the dataset."""

    _target: type = field(default_factory=lambda: SSASplatfactoModel)
    mask_from: Literal["truth", "detection"] = "truth"
    """truth: of the simulator, or the file that the benchmark states; detection: of `ssa detect`."""


def write_dataset(capture: Capture, folder: Path) -> None:
    """Write the dataset with a mask_path for each of its frames, which nerfstudio wants for all or none.

    Raises:
        InputError: photos of several cameras, or nothing is left to train on.
    """
    dataset = Dataset.read(capture.data, eval_interval=8)
    camera, *others = read_cameras(capture.data, frames=0)
    if others:
        raise InputError(f"{capture.data} has several cameras", "masks are made for one camera alone")
    truth = capture.settings["mask_from"] == "truth"
    area = _true_area(capture, dataset.views[0].size) if truth else detect_camera(camera, threads=1).mask.numpy()
    if area.all():
        raise InputError(f"the artifact in {capture.data} covers every pixel", "nothing is left to train on")
    with staged_folder(folder) as part:
        (part / "ignored").mkdir()
        Image.fromarray((~area).astype(np.uint8) * 255).save(part / "ignored" / MASK)
        capture.write_copy(part, {view.path: {"mask_path": f"ignored/{MASK}"} for view in dataset.views})


def _true_area(capture: Capture, size: tuple[int, int]) -> np.ndarray:
    """Where the artifact is, bool [H, W] of the raw frame, whose size is given."""
    if capture.mask is not None:
        height, width = size
        return np.asarray(Image.open(capture.mask).convert("L").resize((width, height))) > 127
    with np.load(capture.data / "layers" / "raw.npz") as layers:
        return ((1 - layers["T"] > VISIBLE) | (layers["B"] > VISIBLE)).any(axis=2)


BASELINE = Baseline(MaskConfig, dataset=write_dataset)
