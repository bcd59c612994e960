"""What a run was asked for, as the options of the commands that repeat its stages."""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio.data.panorama_entry import read_panorama
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.sfm.ingest import MAX_TRAINING_SIZE
from ssa_nerfstudio.workflow.finished_training import Evaluation
from ssa_nerfstudio.workflow.photos_to_splats import DATASET, TRAINING

CPU_STEPS = 2_000
"""Steps of a training without a GPU: tens of minutes on two cores."""
CPU_SIZE = 640
"""Longest side of the photos that a training without a GPU sees, pixels."""
_DATAPARSER = "--nerfstudio-data."
_SAVES = 20


@dataclass(frozen=True)
class Choices:
    """The options of `ssa run` that its stages depend on."""

    photos: Path
    """Photos, a video, or a nerfstudio dataset."""
    method: str
    """nerfstudio's name of it."""
    steps: int
    """Of the training."""
    scale: float
    """Factor by which the training resizes the photos, in (0, 1]."""
    detect: tuple[str, ...] = ()
    """Further options of `ssa detect`."""
    process: tuple[str, ...] = ()
    """Further options of `ssa process`."""
    train: tuple[str, ...] = ()
    """Further options of `ns-train`."""

    def data(self, output: Path) -> Path:
        """The dataset, existing or to be made."""
        return self.photos if is_dataset(self.photos) else output / DATASET

    def record(self) -> dict[str, dict[str, Any]]:
        """JSON values by stage and name of the option."""
        train = {"--method": self.method, "--steps": self.steps, "photos scaled by": self.scale}
        return {
            "detect": {"PHOTOS": str(self.photos.resolve()), "--detect.": list(self.detect)},
            "process": {"--process.": list(self.process)},
            "train": {**train, "--train.": list(self.train)},
        }

    def training_options(self, output: Path) -> list[str]:
        """Options of `ns-train METHOD` for the training in the output folder, whose path has no time in it."""
        unattended = ["--vis", "tensorboard", "--logging.local-writer.enable", "False"]
        unattended += ["--viewer.quit-on-train-completion", "True"]
        saves = ["--steps-per-save", str(max(1, min(2_000, self.steps // _SAVES)))]
        place = ["--output-dir", str(output.resolve()), "--experiment-name", TRAINING, "--timestamp", ""]
        data = ["--data", str(self.data(output).resolve())]
        return [*data, *place, *unattended, *saves, *self._training()]

    def commands(self, output: Path, config: Path, evaluation: Evaluation) -> dict[str, str]:
        """What a shell in the output folder runs to look at the run and to repeat its stages elsewhere.

        Args:
            output: folder of the run.
            config: its config.yml.
            evaluation: of the run, which says what it has to be evaluated and exported.
        """
        photos, data = (os.path.relpath(path, output) for path in (self.photos, self.data(output)))
        run = ["--load-config", os.path.relpath(config, output.resolve())]
        masked_by = run if evaluation.has_overlay else ["--data", data]  # without an overlay by detection
        whole = [] if read_panorama(Transforms.read(self.data(output))) is None else ["--equirectangular"]
        stages = {
            "Look at the splats": ["ns-viewer", *run],
            "Detect": ["ssa", "detect", "--data", photos, "--output", "again/detection", *self.detect],
            "Poses": ["ssa", "process", "--train", photos, "--output", "again/dataset", "--detect", *self.process],
            "Train": ["ns-train", self.method, "--data", data, "--output-dir", "again", *self._training()],
            "Evaluate": ["ns-eval", *run, "--output-path", "again/evaluation.json"],
            "Splats": ["ssa", "export-splats", *run, "--output-dir", "again", "--compressed"],
            "For Brush (or nerfstudio, COLMAP, LichtFeld Studio, 3DGRUT, Postshot)": [
                *("ssa", "export-dataset", "--for", "brush", *masked_by, "--output", "again/capture")
            ],
            "Artifact, masks, layers": ["ssa", "export-overlay", *run, "--output", "again/artifact", *whole],
        }
        if is_dataset(self.photos):
            del stages["Poses"]
        if not evaluation.views:
            del stages["Evaluate"]
        if not evaluation.has_overlay:
            del stages["Artifact, masks, layers"]
        return {name: shlex.join(words) for name, words in stages.items()}

    def _training(self) -> list[str]:
        """Options that make a difference to the result; those of the dataset's reader come last, as ns-train asks."""
        size = [] if self.scale == 1 else ["--pipeline.datamanager.camera-res-scale-factor", f"{self.scale:.4g}"]
        own, reader, words = [], [], None
        for word in self.train:
            if word.startswith("--"):
                words = reader if word.startswith(_DATAPARSER) else own
                word = "--" + word.removeprefix(_DATAPARSER) if words is reader else word
            (own if words is None else words).append(word)
        last = ["nerfstudio-data", *reader] if reader else []
        return ["--max-num-iterations", str(self.steps), *size, *own, *last]


def is_dataset(photos: Path) -> bool:
    """Whether the photos have poses already."""
    return photos.suffix == ".json" or (photos / "transforms.json").is_file()


def choose_length_and_scale(longest: int, steps: int | None, of_method: int) -> tuple[int, float, tuple[str, ...]]:
    """Choose how long to train and at which size, for the machine that this is.

    Args:
        longest: side of a photo, pixels.
        steps: what the user asked for.
        of_method: steps of the method's configuration, for a GPU.

    Returns:
        The steps, the factor by which photos are resized, and what the user should know about them.
    """
    if torch.cuda.is_available():
        return steps or of_method, 1.0, ()
    trained = longest
    while trained > MAX_TRAINING_SIZE:  # nerfstudio trains on copies of half the size
        trained //= 2
    scale = min(1.0, CPU_SIZE / trained)
    if scale == 1 and steps is not None:
        return steps, scale, ()
    text = (
        f"without a GPU, training takes {counted(steps or CPU_STEPS, 'step')} on photos of at most "
        f"{round(scale * trained)} pixels; with one, the same command takes {of_method:,} steps on all pixels, "
        "which is sharper"
    )
    return steps or CPU_STEPS, scale, (text,)
