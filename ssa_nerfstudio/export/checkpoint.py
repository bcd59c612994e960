"""A finished run, read from its checkpoint alone; photos, dataset and GPU are not needed."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio._system.text_files import MAX_SETTINGS_BYTES, read_text
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.artifacts import Artifacts, Overlay
from ssa_nerfstudio.plugin.camera_matching import LENS_VALUES
from ssa_nerfstudio.plugin.compat.nerfstudio_repairs import allow_checkpoint_scalars
from ssa_nerfstudio.plugin.training.checkpoints import LOAD_ERRORS, damage, newest_first, reason, step_of
from ssa_nerfstudio.plugin.training.nonfinite import first_nonfinite

_MODEL = "_model."
_MODELS_FOLDER = "nerfstudio_models"
_SHAPES: dict[str, tuple[int | None, ...]] = {
    "means": (3,),
    "scales": (3,),
    "quats": (4,),
    "opacities": (1,),
    "features_dc": (3,),
    "features_rest": (None, 3),
}
_OTHER_STEP = "choose another checkpoint with --step, or train again"
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Checkpoint:
    """The model of one checkpoint."""

    path: Path
    """The step-*.ckpt file."""
    step: int
    """Step after which it was written."""
    model: dict[str, Any]
    """The model's state dict."""

    @staticmethod
    def read(config: Path, step: int | None = None) -> Checkpoint:
        """Read a checkpoint of a run from the folder beside its config.yml, which may have been moved.

        Args:
            config: the run's config.yml.
            step: which checkpoint; where None, the newest that is whole, with a warning for each that is not.

        Raises:
            InputError: the checkpoint does not exist, cannot be read or holds no Gaussian splats.
        """
        if not config.is_file():
            problem = "is a folder" if config.is_dir() else "does not exist"
            raise InputError(f"{config} {problem}", "choose the config.yml that ns-train wrote")
        folder = config.parent / _MODELS_FOLDER
        found = newest_first(folder)
        there = ", ".join(str(step_of(path)) for path in found) or "none"
        if step is not None:
            path = folder / f"step-{step:09d}.ckpt"
            if path not in found:
                raise InputError(f"{folder} has no checkpoint of step {step}", f"there are {there}")
            return _read(path, f"choose another with --step: there are {there}")
        if not found:
            raise InputError(f"{folder} holds no step-*.ckpt", "choose the config.yml of a run that saved one")
        for path in found[:-1]:
            try:
                return _read(path, "")
            except InputError as error:
                _LOG.warning(f"{error}; an older checkpoint is read instead (--step chooses one)")
        return _read(found[-1], "copy it again or train again")

    def gaussians(self) -> dict[str, Tensor]:
        """Parameters of the N Gaussians: means [N, 3], scales [N, 3] (log), quats [N, 4] (w first), opacities [N, 1]
        (logit), features_dc [N, 3], features_rest [N, K, 3]."""
        prefix = "gauss_params."
        return {name.removeprefix(prefix): v for name, v in self.model.items() if name.startswith(prefix)}

    @property
    def has_overlay(self) -> bool:
        """Whether the run trained an overlay."""
        keys = self.model.get("artifacts.camera_keys")
        return keys is not None and not (isinstance(keys, Tensor) and keys.numel() == 0)

    def artifacts(self) -> Artifacts:
        """The overlays.

        Raises:
            InputError: the run has none.
        """
        prefix = "artifacts."
        if not self.has_overlay:
            raise InputError(
                f"{self.path} has no overlay: none was detected, the overlay was off, or another method trained it",
                "train ssa-splatfacto with the overlay on",
            )
        artifacts = Artifacts().eval()
        try:
            artifacts.allocate(self.model, prefix, wanted=True)
            artifacts.load_state_dict(
                {name.removeprefix(prefix): v for name, v in self.model.items() if name.startswith(prefix)}
            )
        except InputError:
            raise
        except (*LOAD_ERRORS, AttributeError) as error:
            raise InputError(f"{self.path}: its overlay cannot be read ({reason(error)})", _OTHER_STEP) from error
        if (broken := first_nonfinite(artifacts.state_dict())) is not None:
            raise InputError(f"{self.path}: {broken} of its overlay is not finite", _OTHER_STEP)
        count = len(artifacts)
        frames = [[artifacts[group].width, artifacts[group].height] for group in range(count)]
        lenses = tuple(artifacts.lenses.shape)
        if artifacts.camera_keys[:, :2].tolist() != frames or lenses not in ((0, LENS_VALUES), (count, LENS_VALUES)):
            raise InputError(f"{self.path}: its overlay is not of the cameras that it states", _OTHER_STEP)
        return artifacts


class _Inert(yaml.SafeLoader):
    """Reads the objects of config.yml as dictionaries, lists and text; nerfstudio's loader would run code in it."""


def _values(loader: yaml.SafeLoader, _: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    return loader.construct_sequence(node, deep=True) if isinstance(node, yaml.SequenceNode) else node.value


_Inert.add_multi_constructor("tag:yaml.org,2002:python/", _values)


def data_of_run(config: Path) -> Path:
    """The dataset that a run was trained on, as its config.yml states it.

    Raises:
        InputError: config.yml cannot be read, or the dataset is no longer there.
    """
    try:
        manager = yaml.load(read_text(config, MAX_SETTINGS_BYTES), Loader=_Inert)["pipeline"]["datamanager"]
        data = Path(*(manager["data"] or manager["dataparser"]["data"]))
    except InputError:
        raise
    except (OSError, yaml.YAMLError, LookupError, TypeError, ValueError, RecursionError) as error:
        raise InputError(
            f"{config} cannot be read ({reason(error)})", "choose the config.yml that ns-train wrote"
        ) from error
    if not data.exists():
        raise InputError(f"{data}, which the run was trained on, does not exist", "say where it is: --data")
    return data


def _read(path: Path, remedy: str) -> Checkpoint:
    """Read one file; its checksums are compared first, which torch does not do."""
    allow_checkpoint_scalars()
    try:
        if (wrong := damage(path)) is not None:
            raise ValueError(wrong)
        saved = torch.load(path, map_location="cpu", weights_only=True)
        state = {name.removeprefix("module."): value for name, value in saved["pipeline"].items()}
        step = int(saved["step"])
    except (*LOAD_ERRORS, AttributeError) as error:
        raise InputError(f"{path} cannot be read as a checkpoint ({reason(error)})", remedy) from error
    model = {name.removeprefix(_MODEL): value for name, value in state.items() if name.startswith(_MODEL)}
    means = model.get("gauss_params.means")
    if not isinstance(means, Tensor) or means.dim() != 2:
        raise InputError(f"{path} holds no Gaussian splats", "choose a run of ssa-splatfacto or splatfacto")
    for name, shape in _SHAPES.items():
        values = model.get(f"gauss_params.{name}")
        if not isinstance(values, Tensor) or not values.is_floating_point() or not _fits(values, (len(means), *shape)):
            raise InputError(f"{path}: its {name} are not those of {len(means)} Gaussians", remedy)
    return Checkpoint(path, step, model)


def _fits(values: Tensor, shape: tuple[int | None, ...]) -> bool:
    sizes = values.shape
    return len(sizes) == len(shape) and all(size in (there, None) for there, size in zip(sizes, shape, strict=True))


def load_overlay(config: Path | str, camera: int = 0, step: int | None = None) -> Overlay:
    """Load the overlay that a run learned; neither photos nor a GPU are needed.

    Args:
        config: the run's config.yml.
        camera: camera group of a rig, in the order of the overlays.
        step: which checkpoint; the newest where None.

    Returns:
        A module whose `layers()` are the transmittance T [H, W, 1 or 3] and addition B [H, W, 3] of I = T C + B, in
        the undistorted frame.

    Raises:
        InputError: there is no such checkpoint, or it has no overlay for this camera.
    """
    artifacts = Checkpoint.read(Path(config), step).artifacts()
    if not 0 <= camera < len(artifacts):
        raise InputError(
            f"{config} has {counted(len(artifacts), 'overlay')}, not one of camera {camera}", "count from 0"
        )
    return artifacts[camera]
