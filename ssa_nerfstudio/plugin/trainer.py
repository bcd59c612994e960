"""nerfstudio's trainer with scaled schedules, guarded steps, whole checkpoints, and resuming up to the planned step."""

from __future__ import annotations

import copy
import logging
import shlex
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from typing import Literal

import torch
from nerfstudio.configs.base_config import MachineConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import TRAIN_INTERATION_OUTPUT, Trainer, TrainerConfig
from nerfstudio.utils.decorators import check_main_thread
from nerfstudio.utils.rich_utils import CONSOLE

from ssa_nerfstudio._system import ctrl_c
from ssa_nerfstudio._system.environment import check_environment
from ssa_nerfstudio.errors import InputError, TrainingError
from ssa_nerfstudio.plugin.pipeline import SSAPipeline, SSAPipelineConfig, check_data
from ssa_nerfstudio.plugin.training.checkpoints import (
    LOAD_ERRORS,
    damage,
    load_pipeline_state,
    newest_first,
    reason,
    staged_checkpoints,
    step_of,
)
from ssa_nerfstudio.plugin.training.event_writers import gradient_norms, thin_event_writers
from ssa_nerfstudio.plugin.training.nonfinite import CHECK_EVERY, NonFiniteGuard, first_nonfinite
from ssa_nerfstudio.plugin.training.optimizers import JointOptimizers
from ssa_nerfstudio.plugin.training.schedules import densification, scaled
from ssa_nerfstudio.plugin.unfinished_run import no_config_left, stopped_in_one_line
from ssa_nerfstudio.plugin.validation import (
    check_checkpoint,
    check_device,
    check_intervals,
    check_length,
    check_machine,
    check_optimizers,
    check_output,
    check_port,
    check_reader,
    check_settings,
)

_LOG = logging.getLogger(__name__)


@dataclass
class SSATrainerConfig(TrainerConfig):
    """Configuration of `SSATrainer`."""

    _target: type = field(default_factory=lambda: SSATrainer)
    pipeline: SSAPipelineConfig = field(default_factory=SSAPipelineConfig)
    """Photos, cameras, scene and overlay."""
    scale_schedules: bool = True
    """Scale every schedule by max_num_iterations / 30000, so that a shorter run is a complete run."""

    def set_timestamp(self) -> None:
        """Set the timestamp as upstream; ns-train calls this first, so what it would fail at is checked here.

        Raises:
            InputError: a setting, the dataset or the checkpoint to resume from cannot be used.
        """
        self.check()
        check_data(self.pipeline)
        check_checkpoint(self.load_dir, self.load_step, self.load_checkpoint)
        super().set_timestamp()

    def check(self) -> None:
        """Check all that needs no photos.

        Raises:
            InputError: the machine has no such device, or a setting cannot be used.
        """
        check_environment()
        check_output(self.output_dir)
        check_machine(self.machine)
        check_port(self.viewer.websocket_port)
        check_device(self.machine.device_type)
        check_settings(self.pipeline.model, self.machine.device_type, self.max_num_iterations)
        check_length(self.max_num_iterations, self.pipeline.datamanager.camera_res_scale_factor)
        check_intervals(self)
        check_optimizers(self.optimizers)
        check_reader(self.pipeline.datamanager.dataparser)


class SSATrainer(Trainer):
    """`Trainer` for the methods of this plugin."""

    config: SSATrainerConfig
    pipeline: SSAPipeline
    optimizers: JointOptimizers
    _one: torch.Tensor | None = None

    def __init__(self, config: SSATrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        config.check()  # before schedules are rounded up
        config = scaled(config) if config.scale_schedules else copy.deepcopy(config)
        super().__init__(config, local_rank, world_size)

    def _resumed_checkpoint(self) -> Path | None:
        """The checkpoint to resume from; without --load-step the newest intact one."""
        folder, step, file = self.config.load_dir, self.config.load_step, self.config.load_checkpoint
        check_checkpoint(folder, step, file)
        if folder is None:
            return file
        if step is not None:
            return folder / f"step-{step:09d}.ckpt"
        candidates = newest_first(folder)
        usable = (path for path in candidates if damage(path) is None and load_pipeline_state(path) is not None)
        return next(usable, candidates[0])

    def setup_optimizers(self) -> JointOptimizers:
        """Optimizers of the configuration; the means' learning rate in units of the scene where the model asks so."""
        self.pipeline.model.metrics_every = max(1, self.config.logging.steps_per_log)
        if self.grad_scaler.is_enabled():
            self.pipeline.model.recordable = False  # gradients are of a multiple of the loss
        scale = self.pipeline.model.scene_scale
        if scale != 1.0:
            means = self.config.optimizers["means"]
            means["optimizer"].lr *= scale
            means["scheduler"].lr_final *= scale
        model = self.config.pipeline.model
        guard = NonFiniteGuard(model.max_skipped_steps) if model.guards else None
        return JointOptimizers(self.config.optimizers.copy(), self.pipeline.get_param_groups(), guard)

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Set up as upstream does, and report the overlay at the end of the training.

        The overlays of a resumed run are allocated here, before the optimizers are built.
        """
        self.config.pipeline.artifacts_of = checkpoint = self._resumed_checkpoint()
        model, resumed = self.config.pipeline.model, checkpoint and load_pipeline_state(checkpoint)
        model.strategy = densification(model.strategy, self.config.max_num_iterations, resumed)
        with no_config_left(self), stopped_in_one_line(self):
            try:
                super().setup(test_mode)
            except Exception as error:
                if type(error).__module__.startswith("wandb.") or "COMET_API_KEY" in str(error):
                    raise InputError(
                        f"--vis {self.config.vis}: {str(error).rstrip('.')}", "or choose --vis tensorboard"
                    ) from error
                raise
        thin_event_writers(self.config.logging.steps_per_log)
        last = (self.config.max_num_iterations - 1,)
        ending, ended = TrainingCallbackLocation.AFTER_TRAIN_ITERATION, TrainingCallbackLocation.AFTER_TRAIN
        self.callbacks.append(TrainingCallback([ending], self.pipeline.model.end_training, iters=last))
        self.callbacks.append(TrainingCallback([ended], self._report_artifact))

    def _report_artifact(self, step: int) -> None:
        artifacts = self.pipeline.model.artifacts
        config = shlex.quote(str(self.config.get_base_dir() / "config.yml"))
        lines = [f"Splats: ssa export-splats --load-config {config} --output-dir splats"]
        for group in range(len(artifacts)):
            name = f"Artifact of {artifacts.name(group)}" if len(artifacts) > 1 else "Artifact"
            lines.append(f"{name}: {artifacts.summary(group)}")
        if len(artifacts):
            lines.append(f"Export it: ssa export-overlay --load-config {config} --output artifact")
        else:
            why = "the overlay was off" if self.config.pipeline.model.overlay == "off" else "none was detected"
            lines.append(f"Artifact: {why}, no overlay was trained")
        CONSOLE.print(*lines, sep="\n", markup=False, emoji=False, highlight=False, soft_wrap=True)

    def _load_checkpoint(self) -> None:
        """Resume as upstream does; without --load-step from the newest intact checkpoint."""
        folder, step, file = self.config.load_dir, self.config.load_step, self.config.load_checkpoint
        if folder is None and file is None:
            super()._load_checkpoint()
            return
        if folder is None or step is not None:
            path = file if folder is None else folder / f"step-{step:09d}.ckpt"
            error = (path and damage(path)) or self._load_one()
            if error is not None:
                option = "--load-checkpoint" if folder is None else "--load-step"
                raise InputError(f"{path} cannot be read ({error})", f"name another checkpoint: {option}")
            return
        candidates = newest_first(folder)
        for candidate in candidates:
            self.config.load_step = step_of(candidate)
            error = damage(candidate) or self._load_one()
            if error is None:
                if candidate != candidates[0]:
                    _LOG.warning(f"resuming from {candidate}, the newest checkpoint that is whole")
                self.config.load_step = None
                return
            _LOG.warning(f"{candidate} cannot be used ({error})")
        raise InputError(
            f"{folder} holds no checkpoint that can be read", "give the folder of another run, or start a new training"
        )

    def _load_one(self) -> str | None:
        """Load the checkpoint that the configuration names; the reason why it cannot be used, or None."""
        try:
            super()._load_checkpoint()
        except InputError:
            raise  # of the settings: no other checkpoint helps
        except LOAD_ERRORS as error:
            return reason(error)
        broken = first_nonfinite(self.pipeline.state_dict())
        return None if broken is None else f"its {broken} holds values that are not finite"

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Write a checkpoint, complete and finite or not at all; older ones are deleted afterwards."""
        if self.optimizers.guard is not None:
            self.optimizers.guard.check(step)
        states = {name: optimizer.state_dict() for name, optimizer in self.optimizers.optimizers.items()}
        broken = first_nonfinite({**self.pipeline.state_dict(), **states})
        if broken is not None:
            raise TrainingError(
                f"training stopped at step {step}: {broken} holds values that are not finite, so no checkpoint was "
                "written",
                f"resume from an earlier one: --load-dir {self.checkpoint_dir}",
            )
        folder = self.checkpoint_dir
        try:
            with staged_checkpoints(folder) as self.checkpoint_dir:
                super().save_checkpoint(step)
        except (OSError, RuntimeError) as error:
            earlier = newest_first(folder)
            remedy = f"resume from {earlier[0]}: --load-dir {folder}" if earlier else "start a new training"
            raise TrainingError(
                f"the checkpoint of step {step} could not be written to {folder} ({str(error).splitlines()[0]})",
                f"make room on the disk and {remedy}",
            ) from error
        finally:
            self.checkpoint_dir = folder
        if self.config.save_only_latest_checkpoint:
            for path in newest_first(folder):
                if step_of(path) != step:
                    path.unlink()

    def train_iteration(self, step: int) -> TRAIN_INTERATION_OUTPUT:
        """One training step: forward, backward, one verdict for all optimizers, schedulers.

        What is returned is detached: upstream keeps the graph alive until the log is written.
        """
        optimizers, every = self.optimizers, self.gradient_accumulation_steps
        optimizers.zero_grad_some([name for name in optimizers.parameters if step % every[name] == 0])
        with torch.autocast(device_type="cuda" if "cuda" in self.device else "cpu", enabled=self.mixed_precision):
            _, losses, metrics = self.pipeline.get_train_loss_dict(step=step)
            loss = reduce(torch.add, losses.values())
        if loss.requires_grad:  # not what a recording has differentiated already
            if self._one is None:
                self._one = torch.ones_like(loss, requires_grad=False)
            self.grad_scaler.scale(loss).backward(self._one)  # without one, autograd fills one in at every step
        loss = loss.detach()
        due = [name for name in optimizers.parameters if step % every[name] == every[name] - 1]
        optimizers.step_groups(due, loss, self.grad_scaler)
        if self.config.log_gradients:
            metrics |= gradient_norms(self.pipeline.model)
        scale = self.grad_scaler.get_scale()
        self.grad_scaler.update()
        if scale <= self.grad_scaler.get_scale():  # a scaler that is lowered has skipped the step
            optimizers.scheduler_step_all(step)
        if optimizers.guard is not None:
            optimizers.guard.tell_densification(self.pipeline.model.info)
            if (step + 1) % CHECK_EVERY == 0:
                optimizers.guard.check(step)
        return loss, {name: value.detach() for name, value in losses.items()}, metrics

    def eval_iteration(self, step: int) -> None:
        """Evaluate as upstream does, which needs a test view."""
        if len(self.pipeline.datamanager.eval_dataset):
            super().eval_iteration(step)

    def train(self) -> None:
        """Train up to `max_num_iterations` steps in total; upstream's resumed runs train that many more."""
        planned = self.config.max_num_iterations
        self.config.max_num_iterations = max(0, planned - self._start_step)
        if self.config.max_num_iterations == 0:
            CONSOLE.print(f"The checkpoint is at step {self._start_step} of {planned}: nothing is left to train.")
            return
        with stopped_in_one_line(self), ctrl_c.unwrapped():
            super().train()


def machine() -> MachineConfig:
    """CUDA where torch has it, else the CPU."""
    return MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu")
