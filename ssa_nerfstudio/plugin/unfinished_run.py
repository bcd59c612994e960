"""What `ns-train` says and leaves of a run that cannot begin, or that is stopped."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nerfstudio.engine.trainer import Trainer

from ssa_nerfstudio._system import termination
from ssa_nerfstudio._system.terminal_messages import print_error
from ssa_nerfstudio.errors import TrainingStopped
from ssa_nerfstudio.plugin.command_entry import is_nerfstudio_command, resuming
from ssa_nerfstudio.plugin.training.checkpoints import newest_first, step_of


@contextmanager
def no_config_left(trainer: Trainer) -> Iterator[None]:
    """Let a run of `ns-train` that cannot begin leave nothing: its config.yml would be that of the newest run."""
    try:
        yield
    except BaseException:  # of ctrl+c, too
        config = trainer.base_dir / "config.yml"
        if is_nerfstudio_command() and list(trainer.base_dir.glob("*")) == [config]:
            config.unlink()
            for folder in (trainer.base_dir, *trainer.base_dir.parents):
                if folder == Path(trainer.config.output_dir) or any(folder.iterdir()):
                    break
                folder.rmdir()
        raise


@contextmanager
def stopped_in_one_line(trainer: Trainer) -> Iterator[None]:
    """Let ctrl+c in `ns-train`, or SIGTERM, say how to go on; after ctrl+c upstream ends with exit code 0.

    After the training it closes the viewer, as upstream asks for.

    Raises:
        SystemExit: the training was stopped, and has said so.
    """
    if not is_nerfstudio_command():
        yield
        return
    with termination.as_ctrl_c():
        try:
            yield
        except KeyboardInterrupt:
            if trainer.training_state == "completed":
                return
            saved = newest_first(trainer.checkpoint_dir)
            stopped = TrainingStopped(f"at step {trainer.step}, before the first checkpoint", "start again")
            if saved:
                remedy = f"go on from step {step_of(saved[0])}: {resuming(trainer.checkpoint_dir)}"
                stopped = TrainingStopped(f"at step {trainer.step}", remedy)
            raise SystemExit(print_error(stopped)) from None
