"""The methods that `ns-train` lists: nerfstudio's entry points."""

from __future__ import annotations

from typing import cast

from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, ViewerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.plugins.types import MethodSpecification

from ssa_nerfstudio.plugin import command_entry, former_names
from ssa_nerfstudio.plugin.compat import nerfstudio_repairs, open3d_libraries, versions
from ssa_nerfstudio.plugin.datamanager import SSADatamanagerConfig
from ssa_nerfstudio.plugin.model import SSASplatfactoModelConfig
from ssa_nerfstudio.plugin.pipeline import SSAPipelineConfig
from ssa_nerfstudio.plugin.trainer import SSATrainerConfig, machine
from ssa_nerfstudio.plugin.training.console_table import ConsoleTable
from ssa_nerfstudio.plugin.training.fused_adam import FusedAdamConfig
from ssa_nerfstudio.plugin.training.schedules import DEFAULT_LENGTH, FAST_LENGTH, FULL_LENGTH

# Every nerfstudio command imports this module through the entry points, before it loads or renders anything.
command_entry.report_in_one_line()
command_entry.check_config()
versions.check_versions()
open3d_libraries.preload()
nerfstudio_repairs.allow_checkpoint_scalars()
nerfstudio_repairs.list_external_methods_fast()
former_names.provide_former_names()
if command_entry.is_nerfstudio_command():
    nerfstudio_repairs.provide_ffmpeg()


def _trainer(name: str, model: SSASplatfactoModelConfig, steps: int = DEFAULT_LENGTH) -> SSATrainerConfig:
    """splatfacto's trainer settings with fused optimizers, an `overlay` group, and less evaluation while training.

    The schedules are those of FULL_LENGTH steps; the trainer scales them.
    """
    return SSATrainerConfig(
        method_name=name,
        max_num_iterations=steps,
        steps_per_save=2_000,
        steps_per_eval_batch=0,
        steps_per_eval_image=5_000,
        steps_per_eval_all_images=0,
        mixed_precision=False,
        # nerfstudio's "basic" prints mean times after everything else.
        logging=LoggingConfig(
            profiler="none", local_writer=LocalWriterConfig(_target=ConsoleTable, enable=True, stats_to_track=())
        ),
        machine=machine(),
        pipeline=SSAPipelineConfig(
            datamanager=SSADatamanagerConfig(dataparser=NerfstudioDataParserConfig(load_3D_points=True)),
            model=model,
        ),
        optimizers={
            "means": {
                "optimizer": FusedAdamConfig(lr=1.6e-4),
                "scheduler": ExponentialDecaySchedulerConfig(lr_final=1.6e-6, max_steps=FULL_LENGTH),
            },
            "features_dc": {"optimizer": FusedAdamConfig(lr=2.5e-3), "scheduler": None},
            "features_rest": {"optimizer": FusedAdamConfig(lr=2.5e-3 / 20), "scheduler": None},
            "opacities": {"optimizer": FusedAdamConfig(lr=0.05), "scheduler": None},
            "scales": {"optimizer": FusedAdamConfig(lr=0.005), "scheduler": None},
            "quats": {"optimizer": FusedAdamConfig(lr=0.001), "scheduler": None},
            "overlay": {"optimizer": FusedAdamConfig(lr=5e-3), "scheduler": None},
            "exposure": {
                "optimizer": FusedAdamConfig(lr=5e-3),
                "scheduler": ExponentialDecaySchedulerConfig(lr_final=5e-4, max_steps=FULL_LENGTH),
            },
            "shading": {
                "optimizer": FusedAdamConfig(lr=1.5e-3),
                "scheduler": ExponentialDecaySchedulerConfig(lr_final=1.5e-4, max_steps=FULL_LENGTH),
            },
            "camera_opt": {
                "optimizer": FusedAdamConfig(lr=1e-4),
                "scheduler": ExponentialDecaySchedulerConfig(
                    lr_final=5e-7, max_steps=FULL_LENGTH, warmup_steps=1_000, lr_pre_warmup=0
                ),
            },
            "bilateral_grid": {
                "optimizer": FusedAdamConfig(lr=2e-3),
                "scheduler": ExponentialDecaySchedulerConfig(
                    lr_final=1e-4, max_steps=FULL_LENGTH, warmup_steps=1_000, lr_pre_warmup=0
                ),
            },
        },
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    )


ssa_splatfacto = MethodSpecification(
    config=_trainer("ssa-splatfacto", SSASplatfactoModelConfig()),
    description="splatfacto that learns and removes a static screen-space artifact (watermark, dashboard, mud, rain).",
)

ssa_splatfacto_fast = MethodSpecification(
    config=_trainer("ssa-splatfacto-fast", SSASplatfactoModelConfig(), FAST_LENGTH),
    description="ssa-splatfacto in 4,000 steps, with ADC: about 20 seconds on a fast GPU, and a decibel behind it.",
)

ssa_splatfacto_mcmc = MethodSpecification(
    config=_trainer("ssa-splatfacto-mcmc", SSASplatfactoModelConfig(strategy="mcmc")),
    description="ssa-splatfacto with MCMC densification in short trainings, too (ssa-splatfacto: from 7,000 steps on).",
)

ssa_splatfacto_paper = MethodSpecification(
    config=_trainer(
        "ssa-splatfacto-paper",
        SSASplatfactoModelConfig(
            strategy="adc",
            overlay="on",
            overlay_start="statistics",
            overlay_intervals="off",
            overlay_film="kept",
            shading="off",
            sparsity="l1",
            sparsity_weight=0.05,
            background_color="black",
            num_downscales=0,
            use_absgrad=False,
            densify_grad_thresh=2e-4,
            cull_alpha_thresh=0.005,
            densify_size_thresh=0.01,
            cull_scale_thresh=0.1,
            stop_screen_size_at=0,
            scale_by_extent=True,
            pause_after_reset=0,
            ignore_background=False,
        ),
        FULL_LENGTH,
    ),
    description="The protocol of the SSA-3DGS paper: 3DGS's own settings and the l1 sparsity of 0.05.",
)

METHODS = {
    str(method.config.method_name): cast(SSATrainerConfig, method.config)
    for method in (ssa_splatfacto, ssa_splatfacto_fast, ssa_splatfacto_mcmc, ssa_splatfacto_paper)
}
"""Configurations by the methods' names."""
