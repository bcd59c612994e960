"""Checks of a training's settings and views; transforms.json is checked in `data`.

`check_views` needs the datamanager, the others run before anything is built.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import is_zipfile

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.configs.base_config import MachineConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio.data.training_requirements import MIN_VIEWS
from ssa_nerfstudio.data.writing import is_text
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.training.schedules import densification

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

    from ssa_nerfstudio.plugin.settings import ModelSettings


_LOWEST = {
    "cap_max": 1,
    "max_skipped_steps": 1,
    "mcmc_opacity_regularizer": 0,
    "mcmc_scale_regularizer": 0,
    "mcmc_scale_start": 1e-6,
    "mcmc_stop_at": 0,
    "n_split_samples": 1,
    "num_downscales": 0,
    "num_random": 1,
    "pause_after_reset": 0,
    "refine_every": 1,
    "reset_alpha_every": 1,
    "resolution_schedule": 1,
    "sh_degree": 0,
    "sh_degree_interval": 1,
    "sparsity_weight": 0,
    "ssim_lambda": 0,
}
"""The lowest values of settings of the model that work."""


_HIGHEST = {"sh_degree": 4, "ssim_lambda": 1}
"""Highest values: of nerfstudio's spherical harmonics, and of a share."""
_MAX_SEED = 2**32 - 1
_ABOVE_ZERO = ("optimizer.lr", "optimizer.eps", "optimizer.max_norm", "scheduler.lr_final", "scheduler.max_steps")
"""Of a group's optimizer and schedule; what its kind lacks, or is None, is not checked. A decay is exponential, so that
it neither begins nor ends at 0; without eps, a gradient of 0 divides by 0."""
_FROM_ZERO = ("optimizer.weight_decay", "scheduler.lr_pre_warmup", "scheduler.warmup_steps")


def check_machine(machine: MachineConfig) -> None:
    """Refuse what nerfstudio and numpy fail at before the training is set up."""
    if not 0 <= machine.seed <= _MAX_SEED:
        raise InputError(f"--machine.seed must be from 0 to {_MAX_SEED}, got {machine.seed}")
    for name in ("num_devices", "num_machines"):
        if (value := getattr(machine, name)) < 1:
            raise InputError(f"--machine.{name.replace('_', '-')} must be at least 1, got {value}")
        if value > 1:
            raise InputError(
                f"--machine.{name.replace('_', '-')} {value}: a training uses one device",
                "leave it at 1, and start another training with CUDA_VISIBLE_DEVICES=1",
            )


def check_output(folder: Path) -> None:
    """Refuse what tensorboard and COLMAP cannot write to, and what by convention is no folder."""
    if not is_text(str(folder)):
        raise InputError(f"--output-dir {folder}: the name is no text in UTF-8", "choose another folder")
    if folder == Path("-"):
        raise InputError("--output-dir -: a training does not go to the standard output", "choose another folder")


def check_port(port: int | None) -> None:
    """Refuse what is no port of TCP."""
    if port is not None and not 0 < port < 2**16:
        raise InputError(f"--viewer.websocket-port must be from 1 to {2**16 - 1}, got {port}")


def check_length(steps: int, scale_factor: float) -> None:
    """Refuse trainings of no steps or on photos of no size."""
    if steps < 1:
        raise InputError(f"--max-num-iterations must be at least 1, got {steps}")
    if not 0 < scale_factor < math.inf:
        raise InputError(
            f"--pipeline.datamanager.camera-res-scale-factor must be above 0, got {scale_factor}", "1 keeps the size"
        )


def check_intervals(config: TrainerConfig) -> None:
    """Refuse numbers of steps between two events that nerfstudio divides by, or takes without their sign."""
    lowest = {
        "steps_per_save": 0,  # 0: never, but for the end
        "steps_per_eval_batch": 0,  # 0: never
        "steps_per_eval_image": 0,
        "steps_per_eval_all_images": 0,
        "logging.steps_per_log": 1,
        "logging.max_buffer_size": 1,
        "logging.local_writer.max_log_size": 0,  # 0: no limit
    }
    for name, least in lowest.items():
        if (value := attrgetter(name)(config)) < least:
            raise InputError(f"--{name.replace('_', '-')} must be at least {least}, got {value}")
    for group, steps in config.gradient_accumulation_steps.items():
        if group not in config.optimizers:
            raise InputError(
                f"--gradient-accumulation-steps: no parameters are called {group!r}",
                f"choose of {', '.join(config.optimizers)}",
            )
        if steps < 1:
            raise InputError(f"--gradient-accumulation-steps must be at least 1, got {steps} for {group}")


def check_optimizers(optimizers: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse numbers that Adam fails at, that move parameters away from their optimum, or that make them NaN.

    Args:
        optimizers: by group, the configurations of its "optimizer" and "scheduler", as nerfstudio's trainer has them.
    """
    for group, parts in optimizers.items():
        for where in (*_ABOVE_ZERO, *_FROM_ZERO):
            part, name = where.split(".")
            value = getattr(parts.get(part), name, None)
            # A rate of 0 leaves a group as it is; a schedule takes its logarithm.
            may_be_zero = where in _FROM_ZERO or (where == "optimizer.lr" and parts.get("scheduler") is None)
            if value is None or 0 < value < math.inf or (value == 0 and may_be_zero):
                continue
            option = f"--optimizers.{group}.{where}".replace("_", "-")
            raise InputError(f"{option} must be finite and {'at least' if may_be_zero else 'above'} 0, got {value}")


def check_reader(reader: DataParserConfig) -> None:
    """Refuse factors, for every reader that has them, that leave no scene, mirror it, or make its poses NaN."""
    for name in ("scale_factor", "scene_scale"):
        if not 0 < (value := getattr(reader, name, 1.0)) < math.inf:
            raise InputError(f"--{name.replace('_', '-')} must be finite and above 0, got {value}", "1 keeps the size")


def check_device(device: torch.device | str) -> None:
    """Refuse CUDA where there is none, and a GPU that is not the current one, on which kernels would be launched."""
    device = torch.device(device)
    if device.type != "cuda":
        return
    if not torch.cuda.is_available():
        raise InputError(
            "the device is cuda, and torch finds no CUDA on this machine",
            "add --machine.device-type cpu, or install a torch build for your driver",
        )
    if device.index not in (None, torch.cuda.current_device()):
        raise InputError(
            f"the device is {device}, and the current one is cuda:{torch.cuda.current_device()}",
            f"call torch.cuda.set_device({device.index}) first, or start with CUDA_VISIBLE_DEVICES={device.index}",
        )


def check_checkpoint(load_dir: Path | None, load_step: int | None, load_checkpoint: Path | None) -> None:
    """Refuse to resume from a folder without checkpoints or a file that is none."""
    if load_dir is None:
        if load_checkpoint is not None and not (load_checkpoint.is_file() and is_zipfile(load_checkpoint)):
            what = "is no checkpoint" if load_checkpoint.exists() else "does not exist"
            raise InputError(f"--load-checkpoint {load_checkpoint} {what}", "give a step-*.ckpt of an earlier run")
        return
    pattern = "step-*.ckpt" if load_step is None else f"step-{load_step:09d}.ckpt"
    if not list(load_dir.glob(pattern)):
        raise InputError(
            f"--load-dir {load_dir} holds no {pattern}", "give the nerfstudio_models folder of an earlier run"
        )


def check_settings(model: ModelSettings, device: torch.device | str, steps: int = 0) -> None:
    """Refuse settings of the model that contradict each other or the machine; for a training of so many steps."""
    for name, lowest in _LOWEST.items():
        value = getattr(model, name)
        if value is not None and not lowest <= value < math.inf:
            raise InputError(f"--pipeline.model.{name.replace('_', '-')} must be at least {lowest}, got {value}")
    for name, highest in _HIGHEST.items():
        if (value := getattr(model, name)) > highest:
            raise InputError(f"--pipeline.model.{name.replace('_', '-')} must be at most {highest}, got {value}")
    for name, value in vars(model).items():
        if isinstance(value, float) and math.isnan(value):
            raise InputError(f"--pipeline.model.{name.replace('_', '-')} is no number")
    if model.use_bilateral_grid and min(model.grid_shape) < 1:
        shape = " ".join(map(str, model.grid_shape))
        raise InputError(f"--pipeline.model.grid-shape must be at least 1 in all directions, got {shape}")
    if not 0 <= model.clearance < 1:
        raise InputError(f"--pipeline.model.clearance must be in [0, 1), got {model.clearance}")
    if not 0 < model.mcmc_opacity_start < 1:
        raise InputError(f"--pipeline.model.mcmc-opacity-start must be in (0, 1), got {model.mcmc_opacity_start}")
    if model.exposure != "off" and model.use_bilateral_grid:
        raise InputError(
            f"--pipeline.model.exposure {model.exposure} and --pipeline.model.use-bilateral-grid True both model a "
            "photo's colors",
            "choose one",
        )
    if model.rasterizer == "reference" and model.use_absgrad and densification(model.strategy, steps) == "adc":
        raise InputError(
            "--pipeline.model.rasterizer reference has no absgrad", "add --pipeline.model.use-absgrad False"
        )
    needed = {"gsplat": "cuda", "cpu": "cpu"}.get(model.rasterizer)
    if needed is not None and torch.device(device).type != needed:
        raise InputError(f"--pipeline.model.rasterizer {model.rasterizer} does not run on {device}", "use auto")


def check_views(outputs: DataparserOutputs, source: Path) -> None:
    """Refuse training splits of fewer than two views and poses that are not finite."""
    views = len(outputs.image_filenames)
    if views < MIN_VIEWS:
        raise InputError(
            f"{source} leaves {counted(views, 'photo')} to train on",
            f"at least {MIN_VIEWS} are needed: add photos, or hold fewer back for evaluation",
        )
    cameras = outputs.cameras
    intrinsics = torch.cat([t.reshape(views, -1) for t in (cameras.fx, cameras.fy, cameras.cx, cameras.cy)], dim=1)
    for what, values in (("pose", cameras.camera_to_worlds), ("intrinsics", intrinsics)):
        finite = torch.isfinite(values).flatten(1).all(dim=1)
        if not finite.all():
            name = outputs.image_filenames[int((~finite).nonzero()[0])]
            raise InputError(
                f"{source}: {what} of {name} {'is' if what == 'pose' else 'are'} not of finite numbers",
                "correct the dataset, look at the options of its reader, or remove that photo",
            )


def check_first_resolution(cameras: Cameras, num_downscales: int) -> None:
    """Refuse to start with photos of less than a pixel."""
    shortest = int(min(cameras.width.min(), cameras.height.min()))
    if 2**num_downscales > shortest:
        raise InputError(
            f"--pipeline.model.num-downscales {num_downscales} starts with one pixel in 2^{num_downscales}, and a side "
            f"of a photo has {shortest}",
            "choose a smaller number",
        )
