"""What a baseline replaces in the training of `ssa-splatfacto` without an overlay; all else is shared.

A baseline is a module of this folder with a `BASELINE`, and a line in `specification.method_matrix.METHODS` that
names it. It may train on another dataset (`Baseline.dataset`), and its model may override four places of
`SSASplatfactoModel`: `examine` (photos and cameras before the first step), `get_outputs` (the prediction of a photo,
`composite`), `loss_mask` (weights of the photometric loss) and `get_loss_dict` (further terms).
"""

from __future__ import annotations

import importlib
import inspect
import json
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any

from filelock import FileLock
from pydantic import Field
from torch import nn
from torch.nn import Parameter

from ssa_nerfstudio._system.text_files import read_text
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import category
from ssa_nerfstudio.experiments.benchmark.specification.plan import Run
from ssa_nerfstudio.plugin.model import SSASplatfactoModel, SSASplatfactoModelConfig
from ssa_nerfstudio.plugin.trainer import SSATrainerConfig
from ssa_nerfstudio.plugin.training.fused_adam import FusedAdamConfig
from ssa_nerfstudio.plugin.training.schedules import FULL_LENGTH, MAX_OVERLAY_FACTOR

Count = Annotated[int, Field(ge=1)]
"""A setting that is a number of something."""
Share = Annotated[float, Field(ge=0, le=1)]
"""A setting in [0, 1]."""


@dataclass(frozen=True)
class Capture:
    """A dataset with its artifact, as all methods train on it."""

    data: Path
    """The folder."""
    artifact: str
    """What is in front of its photos: watermark, ..., `none`."""
    mask: Path | None
    """White where the artifact is that the photos carry themselves; None where it is simulated, or not known."""
    settings: dict[str, Any]
    """What the run sets of the baseline's own settings."""

    def write_copy(self, folder: Path, frames: dict[str, dict[str, str]]) -> None:
        """Write the dataset with other entries of some frames, by file_path; its files are linked, not copied.

        A frame keeps its role where its file_path changes, because prepared datasets state their split.
        """
        for path in self.data.iterdir():
            if path.name != "transforms.json":
                (folder / path.name).symlink_to(path.resolve())
        meta = json.loads(read_text(self.data / "transforms.json"))
        meta["frames"] = [{**frame, **frames.get(frame["file_path"], {})} for frame in meta["frames"]]
        for split in ("train", "val", "test"):
            if names := meta.get(f"{split}_filenames"):
                meta[f"{split}_filenames"] = [frames.get(name, {}).get("file_path", name) for name in names]
        (folder / "transforms.json").write_text(json.dumps(meta, indent=1), encoding="utf-8")


@dataclass(frozen=True)
class Baseline:
    """How a baseline differs from splatfacto on the same data."""

    config: type[SSASplatfactoModelConfig] = SSASplatfactoModelConfig
    """Its settings, whose `_target` is its model. Benchmark files may change each of them."""
    settings: dict[str, Any] = field(default_factory=lambda: {"overlay": "off"})
    """Settings of splatfacto and of the plugin that it needs otherwise."""
    learning_rates: dict[str, float] = field(default_factory=dict)
    """Of the modules in `BaselineModel.beside`, by name."""
    per_photo: bool = False
    """They belong to single photos, each seen fewer times in a short training: rates are raised by FULL_LENGTH / steps,
    up to MAX_OVERLAY_FACTOR."""
    dataset: Callable[[Capture, Path], None] | None = None
    """Writes the dataset that is trained on into a folder, where that is not the prepared one."""
    check: Callable[[dict[str, Any]], None] = lambda settings: None
    """Refuses a run's settings before any run begins, with an InputError: weights that are missing."""

    def adapt(self, config: SSATrainerConfig) -> None:
        """Turn a method's configuration into this baseline's: its model, its settings, Adam with constant rates."""
        model = config.pipeline.model
        taken = {each.name for each in fields(model)} - self._declared() - {"_target"}
        shared = {name: getattr(model, name) for name in taken}
        config.pipeline.model = self.config(**{**shared, **self.settings})
        shortened = FULL_LENGTH / config.max_num_iterations if self.per_photo else 1.0
        shortened = max(1.0, min(shortened, MAX_OVERLAY_FACTOR))
        for name, rate in self.learning_rates.items():
            config.optimizers[name] = {"optimizer": FusedAdamConfig(lr=rate * shortened), "scheduler": None}

    def trained_on(self, run: Run, data: Path) -> Path:
        """Where the dataset that a run trains on is, or will be: the prepared one, or one beside it.

        Raises:
            InputError: the baseline cannot be trained with the run's settings.
        """
        self.check(self._own_settings(run))
        if self.learning_rates and run.model.get("exposure", "off") != "off":
            raise InputError(f"{run.baseline} predicts photos without their exposures", "set exposure: off for it")
        if self.dataset is None:
            return data
        digest = zlib.crc32(json.dumps(self._own_settings(run), sort_keys=True).encode())
        return data.with_name(f"{data.name}-{run.baseline}-{digest:08x}")

    def make_dataset(self, run: Run, data: Path, mask: Path) -> None:
        """Make the dataset that a run trains on where it is not there yet.

        Args:
            run: what is trained.
            data: its prepared dataset.
            mask: of the artifact that its photos carry themselves, where there is one.
        """
        made = self.trained_on(run, data)
        if self.dataset is None:
            return
        with FileLock(made.with_name(f".{made.name}.lock")):  # another run on this machine may be making it
            if not made.exists():
                settings = self._own_settings(run)
                self.dataset(Capture(data, category(run.effect), mask if run.mask else None, settings), made)

    def _declared(self) -> set[str]:
        """Settings that its classes declare; nerfstudio's may have others of the same name, such as `prompt`."""
        classes = self.config.__mro__[: self.config.__mro__.index(SSASplatfactoModelConfig)]
        return {name for each in classes for name in inspect.get_annotations(each)}

    def _own_settings(self, run: Run) -> dict[str, Any]:
        """What a run sets of the baseline's settings, and not of splatfacto's and the plugin's."""
        shared = {each.name for each in fields(SSASplatfactoModelConfig)} - self._declared()
        return {name: value for name, value in run.model.items() if name not in shared}


def find(name: str) -> Baseline:
    """The baseline of a module of this folder; without a name, one that changes nothing."""
    return importlib.import_module(f"{__package__}.{name}").BASELINE if name else Baseline(settings={})


class BaselineModel(SSASplatfactoModel):
    """splatfacto with modules that are learned beside the scene. Only training needs them: viewers load the scene."""

    recordable = False  # subclasses read the pictures
    beside: nn.ModuleDict
    """Modules by the name of their learning rate; `examine` fills it."""

    def populate_modules(self) -> None:
        """The scene, and nothing beside it yet."""
        super().populate_modules()
        self.beside = nn.ModuleDict()

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        """splatfacto's groups, and one for each module beside the scene."""
        return super().get_param_groups() | {name: list(module.parameters()) for name, module in self.beside.items()}

    def load_state_dict(self, dict: dict[str, Any], **kwargs):  # type: ignore[override]
        """Load a checkpoint; without what was learned beside the scene where this model has not examined photos."""
        if not len(self.beside):
            dict = {name: value for name, value in dict.items() if not name.startswith("beside.")}
        return super().load_state_dict(dict, **kwargs)
