"""Milliseconds of one training step, splatfacto's and ours: `python benchmarks/step_time.py --data DIR`

Full resolution, unscaled schedules, the whole body of nerfstudio's training loop, steps 700 to 1099 of one process; the
device is synchronized at both ends only. Run the methods in turn, several times: a machine drifts more than they
differ; with --alternate one process trains without CUDA graphs and with by turns, up to step 1499. --profile writes
where the host's time goes. A large scene is made of a small one with --gaussians and --enlarge.
"""

from __future__ import annotations

import copy
import json
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Literal

import torch
from gsplat.strategy import ops
from PIL import Image

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Factor, NotNegative, file_to_write
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.errors import InputError

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

FIRST, LAST = 699, 1099
"""Steps between which the time is taken: after Triton's compilation and the first refinement, at step 600, which takes
150 ms to load its kernels."""
TURN = 100
"""Steps of a turn with --alternate, as many as from one refinement to the next."""
GRAPHS = {"off": "0", "on": "1"}
"""Values of SSA_CUDA_GRAPHS that take turns with --alternate."""
GROWN = 610
"""Step after which --gaussians splits, and from which on their number stays."""
PROFILED = (640, 680)
"""Steps between which the profile is taken."""


@dataclass
class Command:
    """Time the training steps of one method."""

    data: Path
    """A nerfstudio dataset."""
    method: Literal["splatfacto", "ssa-splatfacto", "ssa-splatfacto-mcmc", "ssa-splatfacto-paper"] = "ssa-splatfacto"
    """Method to time."""
    overlay: Literal["on", "off"] = "on"
    """Whether the method learns an overlay; splatfacto has none."""

    gaussians: NotNegative = 0
    """Split the Gaussians after 610 steps, as densification does, until there are at least so many; then no more."""
    enlarge: Factor = 1.0
    """Enlarge the photos by this: the work of a capture with more pixels, not its details."""

    alternate: bool = False
    """Take turns of 100 steps, four without CUDA graphs (SSA_CUDA_GRAPHS=0), four with, and print a line for each."""
    profile: Annotated[Path, file_to_write()] | None = None
    """Write a table of torch's profiler to this file, and end after the steps that are in it."""

    def run(self) -> None:
        """Train 1100 steps and print one line; or 680 and write a file.

        Raises:
            InputError: the dataset cannot be trained on, or the method splits no Gaussians, or lacks CUDA.
        """
        if self.gaussians and self.method == "ssa-splatfacto-mcmc":
            raise InputError("MCMC splits no Gaussians", "leave out --gaussians")
        Transforms.read(self.data)
        if self.method == "splatfacto" and not torch.cuda.is_available():
            raise InputError("there is no CUDA, without which splatfacto cannot train", "choose another --method")
        from ssa_nerfstudio.experiments.runs.prepared_trainer import prepared_trainer
        from ssa_nerfstudio.plugin.training.event_writers import no_event_writers_left
        from ssa_nerfstudio.plugin.training.step_callbacks import after_each_step

        with TemporaryDirectory() as folder, no_event_writers_left():
            trainer = prepared_trainer(self._config(Path(folder)))
            if self.gaussians:
                after_each_step(trainer, _growth(trainer, self.gaussians))
            if self.profile is not None:
                trainer.config.max_num_iterations = PROFILED[1] + 1
                _write_profile(trainer, self.profile)
            else:
                self._time(trainer)

    def _config(self, output: Path) -> TrainerConfig:
        from nerfstudio.configs.method_configs import all_methods

        from ssa_nerfstudio.experiments.runs.run_configuration import leave_unattended
        from ssa_nerfstudio.plugin.methods import METHODS

        config = copy.deepcopy((all_methods | METHODS)[self.method])
        data = self.data if self.enlarge == 1 else _enlarged(self.data, self.enlarge, output / "photos")
        leave_unattended(config, data, output, LAST + 1)
        config.steps_per_save = 10 * LAST  # --alternate trains longer
        model = config.pipeline.model
        model.num_downscales = 0  # pyright: ignore[reportAttributeAccessIssue]
        if self.method != "splatfacto":
            config.scale_schedules = False
            model.overlay = self.overlay  # pyright: ignore[reportAttributeAccessIssue]
        return config

    def _time(self, trainer: Any) -> None:
        """Train, and print a line for each value of SSA_CUDA_GRAPHS."""
        from ssa_nerfstudio.plugin.training.step_callbacks import after_each_step

        last = FIRST + 4 * len(GRAPHS) * TURN if self.alternate else LAST
        trainer.config.max_num_iterations = last + 1
        times: dict[int, float] = {}

        def note(step: int) -> None:
            if step in (FIRST, last) or (self.alternate and (step - FIRST) % TURN == 0):
                if torch.cuda.is_available():
                    torch.cuda.synchronize()
                    if step == FIRST:
                        torch.cuda.reset_peak_memory_stats()
                times[step] = time.perf_counter()
                if self.alternate:
                    os.environ["SSA_CUDA_GRAPHS"] = [*GRAPHS.values()][(step - FIRST) // TURN % len(GRAPHS)]

        after_each_step(trainer, note)
        trainer.train()
        for number, graphs in enumerate(GRAPHS if self.alternate else [""]):
            turns = range(FIRST + number * TURN, last, len(GRAPHS) * TURN) if self.alternate else [FIRST]
            length = TURN if self.alternate else last - FIRST
            found = [1e3 * (times[turn + length] - times[turn]) / length for turn in turns]
            what = f"{self.method} {self.overlay}{graphs and f', CUDA graphs {graphs}'}"
            each = f" ({', '.join(f'{value:.3f}' for value in found)})" if found[1:] else ""
            count = trainer.pipeline.model.num_points
            peak = torch.cuda.max_memory_allocated() / 2**20 if torch.cuda.is_available() else 0.0
            print(f"{what}: {sum(found) / len(found):.3f} ms a step{each}, {count} Gaussians, {peak:.0f} MiB at most")


def _enlarged(data: Path, factor: float, folder: Path) -> Path:
    """Copy a capture's photos and cameras into a folder, so many times as large."""
    transforms = json.loads((data / "transforms.json").read_text())
    sizes = {"w", "h"}
    scaled = sizes | {"fl_x", "fl_y", "cx", "cy"}
    for camera in (transforms, *transforms["frames"]):
        camera.update({k: round(factor * v) if k in sizes else factor * v for k, v in camera.items() if k in scaled})
    for frame in transforms["frames"]:
        (folder / frame["file_path"]).parent.mkdir(parents=True, exist_ok=True)
        with Image.open(data / frame["file_path"]) as photo:
            size = (round(factor * photo.width), round(factor * photo.height))
            photo.resize(size, Image.Resampling.BICUBIC).save(folder / frame["file_path"])
    if "ply_file_path" in transforms:
        shutil.copy(data / transforms["ply_file_path"], folder / transforms["ply_file_path"])
    (folder / "transforms.json").write_text(json.dumps(transforms))
    return folder


def _growth(trainer: Any, count: int) -> Callable[[int], None]:
    """What splits the Gaussians, those with the largest opacity last, and ends their densification."""

    def grow(step: int) -> None:
        model = trainer.pipeline.model
        if step != GROWN:
            return
        optimizers = {name: trainer.optimizers.optimizers[name] for name in model.gauss_params}
        while model.num_points < count:
            rank = model.gauss_params["opacities"].flatten().argsort().argsort()
            ops.split(model.gauss_params, optimizers, model.strategy_state, rank < count - model.num_points)
        model.strategy.refine_stop_iter = GROWN

    return grow


def _write_profile(trainer: Any, path: Path) -> None:
    """Train, and write what `PROFILED` holds: launches and milliseconds a step, operations by the time of each side."""
    from ssa_nerfstudio.plugin.training.step_callbacks import after_each_step

    profiler = torch.profiler.profile(activities=torch.profiler.supported_activities())

    def note(step: int) -> None:
        if step == PROFILED[0]:
            profiler.start()
        elif step == PROFILED[1]:
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            profiler.stop()

    after_each_step(trainer, note)
    trainer.train()
    found, steps = profiler.key_averages(), PROFILED[1] - PROFILED[0]
    names = ("launch", "memcpyasync", "memsetasync", "synchronize")
    runtime = {e.key: e.count / steps for e in found if any(name in e.key.lower() for name in names)}
    busy = sum(e.self_device_time_total for e in found if e.device_type != torch.autograd.DeviceType.CPU)
    kinds = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
    lines = [
        f"{trainer.pipeline.model.num_points} Gaussians, steps {PROFILED[0]} to {PROFILED[1]}",
        f"aten operations a step: {sum(e.count for e in found if e.key.startswith('aten::')) / steps:.1f}",
        f"host, own time of all operations: {sum(e.self_cpu_time_total for e in found) / 1e3 / steps:.3f} ms a step",
        f"device busy: {busy / 1e3 / steps:.3f} ms a step",
        f"device memory at its peak: {torch.cuda.max_memory_allocated() / 2**20:.0f} MiB in use, "
        f"{torch.cuda.max_memory_reserved() / 2**20:.0f} MiB reserved",
        *(f"{name}: {count:.2f} a step" for name, count in sorted(runtime.items(), key=lambda item: -item[1])),
        "",
        *(found.table(sort_by=f"self_{kind}_time_total", row_limit=40, max_name_column_width=80) for kind in kinds),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    run_script(Command)
