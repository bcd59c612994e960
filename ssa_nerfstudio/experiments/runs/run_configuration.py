"""Configurations of unattended trainings."""

from __future__ import annotations

import copy
import dataclasses
import difflib
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_type_hints

import yaml
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.trainer import TrainerConfig

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.configuration import build
from ssa_nerfstudio.plugin.methods import METHODS
from ssa_nerfstudio.plugin.model import SSASplatfactoModelConfig
from ssa_nerfstudio.plugin.trainer import SSATrainerConfig


def configure(
    method: str,
    data: Path,
    output: Path,
    steps: int,
    model: dict[str, Any] | None = None,
    scale_factor: float = 1.0,
    seed: int = 0,
    adapt: Callable[[SSATrainerConfig], None] = lambda config: None,
) -> SSATrainerConfig:
    """A method's configuration for an unattended run: no viewer, no evaluation in between, one checkpoint at the end.

    Args:
        method: a key of `plugin.methods.METHODS`.
        data: nerfstudio dataset; without named splits every 8th photo is held out.
        output: folder of the run (nerfstudio puts `<name>/<method>/<time>` below it).
        steps: number of training steps; schedules are scaled to it.
        model: values of the model's configuration by field name.
        scale_factor: photos are resized by this.
        seed: added to nerfstudio's own, of all random numbers and of the order of the views.
        adapt: changes the method's configuration before `model` is applied.

    Raises:
        InputError: the model has no such setting, or not with such a value.
    """
    config = copy.deepcopy(METHODS[method])
    leave_unattended(config, data, output, steps)
    config.machine.seed += seed
    datamanager = config.pipeline.datamanager
    datamanager.camera_res_scale_factor = scale_factor
    datamanager.train_cameras_sampling_seed += seed
    adapt(config)
    settings = {each.name for each in dataclasses.fields(config.pipeline.model)} - {"_target"}
    kinds: dict[str, Any] = get_type_hints(type(config.pipeline.model), include_extras=True)
    for name, value in (model or {}).items():
        if name not in settings:
            close = difflib.get_close_matches(name, settings, n=1)
            raise InputError(f"the model has no setting {name!r}", f"{close[0]!r} may be meant" if close else "")
        built = dataclasses.is_dataclass(value)  # by a caller in Python; files hold keys and values
        setattr(config.pipeline.model, name, value if built else build(kinds[name], value, f"setting {name!r}"))
    return config


def leave_unattended(config: TrainerConfig, data: Path, output: Path, steps: int) -> None:
    """Let a run need no one: no viewer, no evaluation in between, one checkpoint at the end.

    Args:
        config: of one of this plugin's methods, or of nerfstudio's own; changed in place.
        data, output, steps: as for `configure`.
    """
    config.vis, config.max_num_iterations, config.steps_per_save = "tensorboard", steps, steps + 1
    config.steps_per_eval_image = config.steps_per_eval_batch = config.steps_per_eval_all_images = 0
    config.logging.local_writer.enable = False
    config.output_dir, config.data, config.pipeline.datamanager.data = output, data, data
    parser = NerfstudioDataParserConfig(load_3D_points=True, eval_mode="interval", eval_interval=8)
    config.pipeline.datamanager.dataparser = parser  # pyright: ignore[reportAttributeAccessIssue]


def model_settings(settings: tuple[str, ...]) -> dict[str, Any]:
    """Settings of the model by field name, from name=value.

    Raises:
        InputError: one lacks the =, or its value is no YAML.
    """
    usual, model = SSASplatfactoModelConfig(), {}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals:
            raise InputError(f"--settings {setting}: there is no =", "give name=value, for example overlay=off")
        try:
            model[name] = yaml.safe_load(value)
        except (yaml.YAMLError, ValueError) as error:  # the latter of dates such as 2026-02-30
            raise InputError(
                f"--settings {setting}: the value is no valid YAML ({error})", "put it in quotes"
            ) from error
        if isinstance(model[name], bool) and isinstance(getattr(usual, name, None), str):
            model[name] = value.lower()  # YAML reads on and off as booleans
    if "overlay_given" in model:
        model["overlay_given"] = Path(str(model["overlay_given"]))
    return model
