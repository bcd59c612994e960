"""`ssa run`."""

from __future__ import annotations

import inspect
import shlex
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ssa_nerfstudio._system import ctrl_c, termination
from ssa_nerfstudio.cli import arguments
from ssa_nerfstudio.cli.option_bounds import at_least
from ssa_nerfstudio.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from ssa_nerfstudio.workflow.choices import Choices
    from ssa_nerfstudio.workflow.photos_to_splats import Plan

STAGES = ("detect", "process", "train")
"""Stages whose commands' options follow `--STAGE.`."""
_ITS_OWN = {
    "detect": {"data": "PHOTOS", "output": "--output", "json": "OUTPUT/detection/detection.json"},
    "process": {"train": "PHOTOS", "output": "--output"},
    "train": {
        "data": "PHOTOS",
        "pipeline.datamanager.data": "PHOTOS",
        "max-num-iterations": "--steps",
        **dict.fromkeys(("output-dir", "experiment-name", "method-name", "timestamp"), "--output"),
        **dict.fromkeys(("load-dir", "load-step", "load-checkpoint", "load-config"), "the same command, to continue"),
    },
}
"""Options of the stages that `ssa run` sets, and what is used instead."""


@dataclass
class Command:
    """Make clean splats and a report from photos, a video or a dataset. The same command continues a stopped run.

    Options of the stages' own commands: --detect.NAME (ssa detect --help), --process.NAME (ssa process --help),
    --train.NAME (ns-train ssa-splatfacto --help), for example --train.pipeline.model.overlay on.
    """

    photos: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTOS")]
    """A folder of photos or videos, a rig's folder with a subfolder for each camera, one video, or a dataset."""
    output: Path
    """Folder for report.html, splats.ply, splats-compressed.ply, artifact.png, matte.png and the training's run."""
    method: Literal["ssa-splatfacto", "ssa-splatfacto-fast", "ssa-splatfacto-mcmc", "ssa-splatfacto-paper"] = (
        "ssa-splatfacto"
    )
    """What to train; -fast: ssa-splatfacto in fewer steps, with ADC in place of MCMC, as without a GPU."""
    steps: Annotated[int | None, at_least(1)] = None
    """Training steps; schedules are scaled to them. Default: 15000 with a GPU (4000 for -fast, 30000 for -paper),
    2000 without."""
    forwarded: tyro.conf.Suppress[tuple[tuple[str, ...], ...]] = ((),) * len(STAGES)
    """What followed --detect., --process. and --train., as options of those commands."""

    @classmethod
    def read(cls, options: list[str], program: str, description: str) -> Command:
        """The command from its options, those of the stages split off.

        Raises:
            InputError: as `arguments.read`.
        """
        own, forwarded = arguments.split_forwarded(options, STAGES)
        for stage, words in zip(STAGES, forwarded, strict=True):
            for name in (word[2:].partition("=")[0].replace("_", "-") for word in words if word.startswith("--")):
                if name in _ITS_OWN[stage]:
                    raise InputError(f"--{stage}.{name} is set by ssa run", f"use {_ITS_OWN[stage][name]}")
        values = {number + 1 for number, word in enumerate(own) if word.startswith("--") and "=" not in word}
        paths = [Path(word) for number, word in enumerate(own) if number not in values and Path(word).exists()]
        if len(paths) > 1:
            kind, one = ("folders", ", whose subfolders are its cameras") if paths[0].is_dir() else ("files", "")
            raise InputError(f"PHOTOS is one folder or video, not {len(paths)} {kind}", f"give {paths[0].parent}{one}")
        if "--photos" in own:
            raise InputError("PHOTOS has no option's name", "ssa run PHOTOS --output OUT")
        _, _, forwarding = (inspect.getdoc(cls) or "").partition("\n\n")
        try:
            command = arguments.read(cls, own, program, f"{description}\n\n{forwarding}")
        except InputError as error:
            if "Unrecognized options" not in error.problem:
                raise
            stages = ", ".join(f"--{stage}.NAME" for stage in STAGES)
            raise InputError(error.problem, f"options of its stages are given as {stages}") from error
        command.forwarded = forwarded
        return command

    def run(self) -> None:
        """Do the stages that are left, and write the report.

        Raises:
            SSAError: an option or a photo cannot be used, or the training cannot continue.
        """
        from rich.console import Console

        from ssa_nerfstudio._system.file_lock import locked_folder
        from ssa_nerfstudio.data.writing import write_text

        console = Console(highlight=False, soft_wrap=True)
        console.print("Loading nerfstudio ...")
        with termination.ended_at_once("ssa run"):
            from ssa_nerfstudio.data.panorama_entry import read_panorama
            from ssa_nerfstudio.data.transforms import Transforms
            from ssa_nerfstudio.workflow.finished_training import Evaluation
            from ssa_nerfstudio.workflow.photos_to_splats import EVALUATION, RECORD, stages
            from ssa_nerfstudio.workflow.resumable_training import config_file
            from ssa_nerfstudio.workflow.run_report import REPORT, report_page
            from ssa_nerfstudio.workflow.stage_display import terminal_display
            from ssa_nerfstudio.workflow.stages import RunRecord, check_run_folder, run_stages

        check_run_folder(self.output / RECORD)
        choices, plan = self._plan(console)
        with locked_folder(self.output, "ssa run"):
            record = RunRecord(self.output / RECORD)
            todo = stages(plan)
            try:
                with ctrl_c.unwrapped(), terminal_display([stage.name for stage in todo], console) as display:
                    run_stages(todo, record, display)
            except KeyboardInterrupt as interrupt:
                raise KeyboardInterrupt(f"stopped; the same command continues in {self.output}") from interrupt
            evaluation = Evaluation.read(self.output / EVALUATION)
            commands = choices.commands(self.output, config_file(plan.training), evaluation)
            done = [record.stages[stage.name] for stage in todo]
            name = self.photos.resolve().stem
            on_sphere = read_panorama(Transforms.read(plan.data)) is not None
            write_text(self.output / REPORT, report_page(self.output, name, done, commands, on_sphere))
        console.print(f"Look at it: {self.output / REPORT}", markup=False, emoji=False)
        config = self.output / config_file(plan.training).relative_to(self.output.resolve())
        console.print(f"ns-viewer --load-config {shlex.quote(str(config))}", markup=False, emoji=False)

    def _plan(self, console: Console) -> tuple[Choices, Plan]:
        """Check the options of all stages and find the photos, before any work is done."""
        from ssa_nerfstudio.cli import detect, process
        from ssa_nerfstudio.data.equirectangular import cut_into_faces
        from ssa_nerfstudio.data.transforms import Transforms
        from ssa_nerfstudio.evidence.capture_detection import read_cameras
        from ssa_nerfstudio.plugin.methods import METHODS
        from ssa_nerfstudio.plugin.trainer import SSATrainerConfig
        from ssa_nerfstudio.workflow.choices import Choices, choose_length_and_scale, is_dataset
        from ssa_nerfstudio.workflow.photos_to_splats import DATASET, Plan, detect_with_progress
        from ssa_nerfstudio.workflow.typed_options import errors_for_run, typed_for_run

        detecting, processing, _ = self.forwarded
        with errors_for_run("detect"):
            detection = arguments.read(detect.Command, ["--data", str(self.photos), *detecting], "ssa detect", "")
            detection.check()
        cameras = read_cameras(self.photos, detection.frames)
        work = None
        if is_dataset(self.photos):
            if processing:
                raise InputError(
                    f"--process.{processing[0].removeprefix('--')}: {self.photos} is a dataset, whose photos have "
                    "poses already",
                    "leave it out, or give the folder of photos",
                )
            frames = Transforms.read(self.photos)
            sizes = [frames.intrinsics(frame) for frame in frames.frames]
            longest = max(max(size.width, size.height) for size in sizes)
        else:
            words = ["--train", str(self.photos), "--output", str(self.output / DATASET), "--detect", *processing]
            with errors_for_run("process"):
                sources, work = arguments.read(process.Command, words, "ssa process", "").prepared()
            longest = max(source.longest_side for source in sources)
            for source in sources:
                if source.faces:
                    console.print(typed_for_run(cut_into_faces(source), "process"), markup=False)
        steps, scale, warnings = choose_length_and_scale(longest, self.steps, METHODS[self.method].max_num_iterations)
        choices = Choices(self.photos, self.method, steps, scale, *self.forwarded)
        with errors_for_run("train"):
            config = arguments.read(
                tyro.conf.FlagConversionOff[SSATrainerConfig],
                choices.training_options(self.output),
                f"ns-train {self.method}",
                "",
                default=METHODS[self.method],
            )
            config.check()
        config.pipeline.datamanager.data = config.data
        tests = partial(detect_with_progress, cameras, detection.threads, detection.draws)
        return choices, Plan(self.output, tests, work, choices.data(self.output), config, choices.record(), warnings)
