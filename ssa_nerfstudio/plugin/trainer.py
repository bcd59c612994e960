"""nerfstudio's trainer with schedules that fit the run, and resuming that finishes the run it resumes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pickle import UnpicklingError

from nerfstudio.configs.base_config import MachineConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig, Optimizers
from nerfstudio.engine.trainer import TRAIN_INTERATION_OUTPUT, Trainer, TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE

from ssa_nerfstudio.errors import refuse
from ssa_nerfstudio.plugin.inputs import check_checkpoint, check_device
from ssa_nerfstudio.plugin.pipeline import SSAPipeline, SSAPipelineConfig
from ssa_nerfstudio.plugin.schedules import scaled


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam that updates a parameter group in one kernel. eps is 1e-15: gradients here are means over pixels, about
    1 / (H W), and torch's 1e-8 would freeze whatever a single pixel drives."""

    eps: float = 1e-15
    """Added to the root of the second moment."""
    fused: bool = True
    """One kernel a group instead of a dozen."""


@dataclass
class SSATrainerConfig(TrainerConfig):
    """Configuration of `SSATrainer`."""

    _target: type = field(default_factory=lambda: SSATrainer)
    pipeline: SSAPipelineConfig = field(default_factory=SSAPipelineConfig)
    """Photos, cameras, scene and artifact."""
    scale_schedules: bool = True
    """Scale every schedule by max_num_iterations / 30000, so that a shorter run is the whole run made shorter and not
    its beginning."""


class SSATrainer(Trainer):
    """`Trainer` for the methods of this plugin."""

    config: SSATrainerConfig
    pipeline: SSAPipeline

    def __init__(self, config: SSATrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        check_device(config.machine.device_type)
        if config.scale_schedules:
            config = scaled(config)
        super().__init__(config, local_rank, world_size)

    def setup_optimizers(self) -> Optimizers:
        """Optimisers of the configuration; the means' learning rate in units of the scene where the model asks so."""
        self.pipeline.model.metrics_every = max(1, self.config.logging.steps_per_log)
        scale = self.pipeline.model.scene_scale
        if scale != 1.0:
            means = self.config.optimizers["means"]
            means["optimizer"].lr *= scale
            means["scheduler"].lr_final *= scale
        return super().setup_optimizers()

    def _load_checkpoint(self) -> None:
        check_checkpoint(self.config.load_dir, self.config.load_step, self.config.load_checkpoint)
        try:
            super()._load_checkpoint()
        except (RuntimeError, OSError, EOFError, UnpicklingError) as error:
            source = self.config.load_checkpoint or f"the newest checkpoint in {self.config.load_dir}"
            reason = str(error).splitlines()[0]
            raise refuse(
                f"{source} cannot be read ({reason}); remove it or name an earlier one: --load-step"
            ) from error

    def train_iteration(self, step: int) -> TRAIN_INTERATION_OUTPUT:
        """One step; what is logged is cut off from the graph, which upstream keeps alive until the log is written."""
        loss, losses, metrics = super().train_iteration(step)
        return loss.detach(), {name: value.detach() for name, value in losses.items()}, metrics

    def train(self) -> None:
        """Train up to max_num_iterations steps in all; upstream's resumed runs train that many more."""
        planned = self.config.max_num_iterations
        self.config.max_num_iterations = max(0, planned - self._start_step)
        if self.config.max_num_iterations == 0:
            CONSOLE.print(f"The checkpoint is at step {self._start_step} of {planned}: nothing is left to train.")
            return
        super().train()


def machine() -> MachineConfig:
    """CUDA where torch has it, else the CPU."""
    import torch

    return MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu")
