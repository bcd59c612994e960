"""The process of one run, started by `ssa bench` as `python -m ...execution.run_process FOLDER`.

Imports first, and then reads from standard input which run to do: meanwhile another may be at work.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import json
import shutil
import sys
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssa_nerfstudio._system.process_lifetime import end_with_parent
from ssa_nerfstudio._system.text_files import read_text
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.data.writing import staged_file
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.execution.datasets import mask_path
from ssa_nerfstudio.experiments.benchmark.execution.results_folder import ResultsFolder
from ssa_nerfstudio.experiments.benchmark.results import Result, write
from ssa_nerfstudio.experiments.benchmark.specification.plan import Run
from ssa_nerfstudio.experiments.configuration import build

if TYPE_CHECKING:
    from ssa_nerfstudio.metrics.artifact_region import ArtifactRegion
    from ssa_nerfstudio.plugin.pipeline import SSAPipeline
    from ssa_nerfstudio.plugin.trainer import SSATrainerConfig

OVERLAY_SETTINGS = ("overlay", "sparsity", "ignore_background")
"""Settings of the model whose names begin so are the overlay's."""


@dataclass(frozen=True)
class Request:
    """What a process is asked to do."""

    run: Run
    folder: str
    """The workplace."""
    runs_per_device: int
    """How many runs share the device by the user's will."""
    command: str
    """What repeats the run."""
    keep_models: bool = False
    """Keep nerfstudio's folder with config.yml and checkpoint in `models/`."""
    flip_processes: int = 1
    """Processes that compare views by FLIP."""
    device: str | None = None
    """CUDA device of the process; None: the CPU, or whatever torch takes."""
    asked: float | None = None
    """When the process was asked, in seconds since the epoch: what is waited for before the first step begins here.
    None: as it starts work."""

    def store(self, path: Path) -> None:
        """Write for the process to read."""
        with staged_file(path) as part:
            part.write_text(json.dumps(dataclasses.asdict(self)), encoding="utf-8")

    @classmethod
    def load(cls, path: Path) -> Request:
        """Read in the process.

        Raises:
            InputError: it is not there, or not complete.
        """
        try:
            return build(cls, json.loads(read_text(path)), str(path))
        except (OSError, ValueError) as error:
            raise InputError(f"{path} holds no request ({error})") from error

    def state(self) -> tuple[str, int]:
        """What the process does, and how many training steps are done."""
        with contextlib.suppress(OSError, ValueError):
            stage, steps = ResultsFolder(Path(self.folder)).progress(self.run.id).read_text().split()
            return stage, int(steps)
        return "starting", 0


def work(request: Request, revision: str) -> Result:
    """Train, evaluate, score the artifact, take pictures; whatever goes wrong becomes the result's status.

    Args:
        request: what to do.
        revision: of the code that does it.
    """
    from ssa_nerfstudio.experiments.runs.machine import DeviceSharing

    company = DeviceSharing()
    run, place = request.run, ResultsFolder(Path(request.folder))
    note = _Progress(place.progress(run.id))
    note.stage("loading")
    result = Result(run, "failed", command=request.command, revision=revision)
    try:
        from ssa_nerfstudio.experiments.benchmark.baselines.baseline import find
        from ssa_nerfstudio.experiments.runs import training_run as training
        from ssa_nerfstudio.experiments.runs.machine import versions

        result.versions = versions()
        config = configuration(run, place)
        result.schedules = _schedules(config)
        note.stage("photos")
        find(run.baseline).make_dataset(run, place.scenes / run.dataset, mask_path(run, place.artifacts))
        waited = 0.0 if request.asked is None else time.time() - request.asked
        try:
            outcome, pipeline, _ = training.train_and_evaluate(
                config,
                note.step,
                run.marks,
                test_scale=1.0,
                flip_processes=request.flip_processes,
                region=(region := _region(run, place)),
            )
        except training.Diverged as error:
            status, result.reason = "diverged", str(error)
        else:
            result.metrics = {**outcome.metrics}
            result.views = {name: {**view} for name, view in outcome.views.items()}
            result.curve = [{**point} for point in outcome.curve]
            result.seconds = {**outcome.seconds, "startup": waited + outcome.seconds["startup"]}
            result.gaussians, result.peak_memory_mb = outcome.gaussians, outcome.peak_memory_mb
            note.stage("pictures")
            result.artifact = _artifact(run, pipeline, place, region)
            from ssa_nerfstudio.experiments.runs.view_pictures import write_view_pictures

            write_view_pictures(pipeline, place.pictures(run.id))
            status = "finished"
        if request.keep_models:
            _keep_model(config, place.model(run.id))
        result.status = status
    except Exception as error:
        traceback.print_exc()
        result.reason = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
    result.alone = request.runs_per_device == 1 and company.alone()
    result.company = {"runs_per_device": request.runs_per_device, "others_share_of_cores": company.share_of_cores()}
    result.ended = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
    return result


def _keep_model(config: SSATrainerConfig, folder: Path) -> None:
    """Move what a training wrote to an absolute path, where nerfstudio finds its checkpoint by the configuration."""
    shutil.rmtree(folder, ignore_errors=True)  # of an earlier try
    with contextlib.suppress(FileExistsError):  # without a parent the move is a copy; a file in the way ends it
        folder.parent.mkdir()
    shutil.move(config.output_dir, folder)
    config.output_dir = folder
    config.save_config()


def configuration(run: Run, place: ResultsFolder) -> SSATrainerConfig:
    """nerfstudio's configuration of a run."""
    from ssa_nerfstudio.experiments.benchmark.baselines.baseline import find
    from ssa_nerfstudio.experiments.runs import run_configuration

    baseline = find(run.baseline)
    data = baseline.trained_on(run, place.scenes / run.dataset)
    model: dict[str, Any] = {}
    if run.shipped_overlay:
        shipped = run_configuration.METHODS["ssa-splatfacto"].pipeline.model
        model = {name: value for name, value in vars(shipped).items() if name.startswith(OVERLAY_SETTINGS)}
    model |= run.model
    if model.get("overlay") == "given":
        model["overlay_given"] = data / "layers" / "undistorted.npz"
    config = run_configuration.configure(
        run.nerfstudio_method,
        data,
        place.running(run.id) / "nerfstudio",
        run.steps,
        model,
        run.image_scale,
        run.seed,
        baseline.adapt,
    )
    config.pipeline.datamanager.dataparser.downscale_factor = 1  # pyright: ignore[reportAttributeAccessIssue]
    return config


def _schedules(config: SSATrainerConfig) -> dict[str, Any]:
    """The schedules that a run really follows, in steps, and the overlay's learning rate."""
    from ssa_nerfstudio.plugin.training.schedules import FULL_LENGTH, MODEL_STEPS, scaled

    final = scaled(config) if config.scale_schedules else config
    names = (*MODEL_STEPS, *final.pipeline.model.own_steps, "refine_every", "reset_alpha_every")
    values = {name: getattr(final.pipeline.model, name) for name in names}
    for name, entry in final.optimizers.items():
        if entry["scheduler"] is not None:
            values[f"learning_rate_{name}"] = entry["scheduler"].max_steps
    values["overlay_learning_rate"] = final.optimizers["overlay"]["optimizer"].lr
    return {"factor": config.max_num_iterations / FULL_LENGTH, **values}


def _region(run: Run, place: ResultsFolder) -> ArtifactRegion | None:
    """Where the photos' own artifact is, in the undistorted frame of the first camera; None where no mask is stated."""
    if not run.mask:
        return None
    from ssa_nerfstudio.metrics.artifact_region import ArtifactRegion

    lens = Dataset.read(place.scenes / run.dataset, run.eval_interval).views[0].lens
    return ArtifactRegion.read(mask_path(run, place.artifacts), lens)


def _artifact(run: Run, pipeline: SSAPipeline, place: ResultsFolder, region: ArtifactRegion | None) -> dict[str, float]:
    """Scores of the learned overlays, mean over cameras; empty where none was learned or no truth is known."""
    truth = place.scenes / run.dataset / "layers" / "undistorted.npz"
    learned = pipeline.model.artifacts.learned()
    if region is not None and pipeline.model.config.overlay != "off":
        # What detection took for clean photos has no overlay, that is a matte of 0.
        return region.mattes(learned[0].matte().detach()[..., 0] if learned else None)
    if not learned or not truth.exists():
        return {}
    import numpy as np

    from ssa_nerfstudio.metrics.matte import layer_errors

    suffixes = range(len(learned)) if len(learned) > 1 else ("",)
    with np.load(truth) as true:
        truths = [(true[f"T{suffix}"], true[f"B{suffix}"]) for suffix in suffixes]
    layers = ([layer.detach().cpu().numpy() for layer in overlay.layers()] for overlay in learned)
    scores = [layer_errors(found[0], found[1], *exact) for found, exact in zip(layers, truths, strict=True)]
    return {name: sum(values[name] for values in scores) / len(scores) for name in scores[0]}


class _Progress:
    """Tells the parent, by a file, what is being done; at most five times a second."""

    def __init__(self, path: Path) -> None:
        self._path, self._written = path, 0.0

    def stage(self, name: str, done: int = 0) -> None:
        """A stage begins, or that many of its steps are done."""
        with contextlib.suppress(OSError):
            self._path.write_text(f"{name} {done}")

    def step(self, done: int) -> None:
        """That many training steps are done."""
        if time.monotonic() - self._written > 0.2:
            self._written = time.monotonic()
            self.stage("training", done)


def main(place: ResultsFolder) -> int:
    """Do the run that is asked for; 0 where a result was reached or nothing asked, 1 where the run failed."""
    end_with_parent()
    with contextlib.suppress(Exception):  # where it is needed, and the run's result can say so, it fails again
        import ssa_nerfstudio.experiments.runs.training_run  # noqa: F401
    from ssa_nerfstudio.experiments.runs.machine import revision

    imported = revision()
    run = sys.stdin.readline().strip()
    if not run:
        return 0
    result = work(Request.load(place.request(run)), imported)
    write(result, place.result(run))
    return 1 if result.status == "failed" else 0


if __name__ == "__main__":
    sys.exit(main(ResultsFolder(Path(sys.argv[1]))))
