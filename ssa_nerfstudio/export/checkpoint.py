"""A finished run, read from its checkpoint alone; photos, dataset and GPU are not needed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from torch import Tensor

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.artifacts import Artifacts, Overlay
from ssa_nerfstudio.plugin.compat.nerfstudio_repairs import allow_checkpoint_scalars
from ssa_nerfstudio.plugin.training.checkpoints import damage, newest_first, step_of

_MODEL = "_model."
_MODELS_FOLDER = "nerfstudio_models"


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
            step: which checkpoint; the newest where None.

        Raises:
            InputError: the checkpoint does not exist, cannot be read or holds no Gaussian splats.
        """
        if not config.is_file():
            raise InputError(f"{config} does not exist", "choose the config.yml that ns-train wrote")
        folder = config.parent / _MODELS_FOLDER
        found = {step_of(path): path for path in newest_first(folder)}
        if step is not None and step not in found:
            there = ", ".join(map(str, sorted(found))) or "none"
            raise InputError(f"{folder} has no checkpoint of step {step}", f"there are {there}")
        if not found:
            raise InputError(f"{folder} holds no step-*.ckpt", "choose the config.yml of a run that saved one")
        path = found[max(found) if step is None else step]
        allow_checkpoint_scalars()
        try:
            saved = torch.load(path, map_location="cpu", weights_only=True)
            state = {name.removeprefix("module."): value for name, value in saved["pipeline"].items()}
            at = int(saved["step"])
        except (RuntimeError, OSError, EOFError, UnpicklingError, KeyError, TypeError, AttributeError) as error:
            reason = damage(path) or (str(error) or type(error).__name__).splitlines()[0]
            raise InputError(
                f"{path} cannot be read as a checkpoint ({reason})", "copy it again or train again"
            ) from error
        model = {name.removeprefix(_MODEL): value for name, value in state.items() if name.startswith(_MODEL)}
        if "gauss_params.means" not in model:
            raise InputError(f"{path} holds no Gaussian splats", "choose a run of ssa-splatfacto or splatfacto")
        return Checkpoint(path, at, model)

    def gaussians(self) -> dict[str, Tensor]:
        """Parameters of the N Gaussians: means [N, 3], scales [N, 3] (log), quats [N, 4] (w first), opacities [N, 1]
        (logit), features_dc [N, 3], features_rest [N, K, 3]."""
        prefix = "gauss_params."
        return {name.removeprefix(prefix): v for name, v in self.model.items() if name.startswith(prefix)}

    def artifacts(self) -> Artifacts:
        """The overlays.

        Raises:
            InputError: the run has none.
        """
        prefix = "artifacts."
        if not len(self.model.get(f"{prefix}camera_keys", ())):
            raise InputError(
                f"{self.path} has no overlay: none was detected, the overlay was off, or another method trained it",
                "train ssa-splatfacto with the overlay on",
            )
        artifacts = Artifacts().eval()
        artifacts.allocate(self.model, prefix, wanted=True)
        own = {name.removeprefix(prefix): v for name, v in self.model.items() if name.startswith(prefix)}
        artifacts.load_state_dict(own)
        return artifacts


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
        raise InputError(f"{config} has {len(artifacts)} overlays, not one of camera {camera}", "count from 0")
    return artifacts[camera]
