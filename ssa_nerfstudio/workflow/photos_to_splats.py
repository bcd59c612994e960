"""From photos to splats: the stages of `ssa run`, each of which leaves files that the next one reads.

The stages run in one process, except for structure from motion, whose library does not share one with others.
"""

from __future__ import annotations

import gc
import json
import logging
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio._system.name_list import name_list
from ssa_nerfstudio._system.text_files import read_text
from ssa_nerfstudio.data.panorama_entry import Panorama, read_panorama
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.data.writing import staged_file, staged_folder, unwritable_as_input_error
from ssa_nerfstudio.evidence.capture_detection import Camera, detect_camera
from ssa_nerfstudio.evidence.detection import Detection
from ssa_nerfstudio.evidence.verdict_in_words import verdict_in_words
from ssa_nerfstudio.export.artifact_layers import ArtifactLayers, undistorted_layers
from ssa_nerfstudio.export.checkpoint import Checkpoint
from ssa_nerfstudio.export.exposure_file import write_exposure
from ssa_nerfstudio.export.panorama_artifact import face_changes, panorama_layers
from ssa_nerfstudio.export.splats import select, write_compressed_ply, write_ply
from ssa_nerfstudio.overlay.rgba import to_rgba8
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.trainer import SSATrainerConfig
from ssa_nerfstudio.sfm.detected_mask import FoundArtifact
from ssa_nerfstudio.sfm.photos_to_dataset import Summary
from ssa_nerfstudio.sfm.progress_display import ProgressCallback
from ssa_nerfstudio.workflow.detection_folder import VERDICTS, found_artifacts, write_found
from ssa_nerfstudio.workflow.finished_training import evaluate, write_view_pictures
from ssa_nerfstudio.workflow.learned_artifacts import clear_overlays, learned_in_words, learned_shares
from ssa_nerfstudio.workflow.resumable_training import config_file, load_trained, train
from ssa_nerfstudio.workflow.stages import Result, Stage

_LOG = logging.getLogger(__name__)

DETECTION, DATASET, TRAINING, EVALUATION = "detection", "dataset", "training", "evaluation"
"""Folders of a run, one for each of the first four stages."""
RECORD = "run.json"
"""File of the finished stages."""
SPLATS, COMPRESSED = "splats.ply", "splats-compressed.ply"


@dataclass(frozen=True)
class Plan:
    """A run: where it writes, and what the first stages do."""

    output: Path
    detect: Callable[[ProgressCallback], dict[str, Detection]]
    """Tests the photos of each camera for an artifact."""
    process: Callable[[Sequence[FoundArtifact], ProgressCallback], Summary] | None
    """Makes the dataset, given what was found in the photos of each camera; None where they have poses already."""
    data: Path
    """The dataset, existing or to be made."""
    training: SSATrainerConfig
    """Of a training on that dataset, in the output folder."""
    choices: dict[str, dict[str, Any]]
    """What each of the first three stages was asked for, for the record."""
    training_warnings: tuple[str, ...] = ()
    """What the user should know about that training before it starts."""


def stages(plan: Plan) -> list[Stage]:
    """The stages up to the exported files; the report is written from what they leave.

    Detection starts anew, and structure from motion knows by itself what it can keep; a training goes on as it began.
    """
    asked = plan.choices
    made = []
    if plan.process is not None:
        process = partial(_process, plan, plan.process)
        made = [Stage("process", process, asked["process"], leaves=(plan.data,), repeatable=False)]
    splats = plan.output / SPLATS, plan.output / COMPRESSED
    config = config_file(plan.training)
    return [
        Stage("detect", partial(_detect, plan), asked["detect"], leaves=(plan.output / DETECTION / VERDICTS,)),
        *made,
        Stage("train", partial(_train, plan), asked["train"], bound=True, leaves=(config,), repeatable=False),
        Stage("evaluate", partial(_evaluate, plan), leaves=(plan.output / EVALUATION,)),
        Stage("export", partial(_export, plan), leaves=splats),
    ]


def detect_with_progress(
    cameras: Sequence[Camera], threads: int, draws: int, on_progress: ProgressCallback
) -> dict[str, Detection]:
    """`evidence.capture_detection.detect_camera` of each camera, by its name."""
    total, done = sum(camera.count for camera in cameras), count(1)

    def shown(camera: Camera, threads: int) -> Iterator[np.ndarray]:
        for photo in camera.photos(threads):
            yield photo
            on_progress("photo", min(next(done), total), total)

    streams = [replace(camera, photos=partial(shown, camera)) for camera in cameras]
    return {camera.name: detect_camera(camera, threads, draws=draws) for camera in streams}


def artifact_files(overlays: Sequence[str]) -> list[tuple[str, str]]:
    """Files of each overlay's artifact and matte, given the overlays' names."""
    ends = [""] if len(overlays) == 1 else [f"-{name}" for name in overlays]
    return [(f"artifact{end}.png", f"matte{end}.png") for end in ends]


def _detect(plan: Plan, on_progress: ProgressCallback) -> Result:
    found = plan.detect(on_progress)
    with _emptied(plan.output / DETECTION) as staged:
        write_found(staged, found)
    sentences = [f"{name}: {verdict_in_words(detection)}" for name, detection in found.items()]
    warnings = []
    if weak := [name for name, detection in found.items() if detection.too_few_edges]:
        of = f" of {name_list(weak)}" if len(found) > 1 else ""
        warnings.append(
            f"a small or faint artifact in the photos{of} may have been missed; if you see one there, add "
            "--train.pipeline.model.overlay on"
        )
    looked_at_again = plan.training.pipeline.model.overlay == "auto"
    if looked_at_again and any(detection.verdict == "none" for detection in found.values()):
        _LOG.info("A soft artifact has no edges; training looks again, with the scene's points, and tells.")
    return Result("; ".join(sentences) if len(found) > 1 else verdict_in_words(*found.values()), tuple(warnings))


def _process(
    plan: Plan, process: Callable[[Sequence[FoundArtifact], ProgressCallback], Summary], on_progress: ProgressCallback
) -> Result:
    if plan.data.exists():  # complete: a run was killed before it recorded the stage
        try:
            summary = Summary.read(plan.data)
        except (OSError, ValueError, TypeError, LookupError):  # made by an earlier version
            return Result(f"{len(Transforms.read(plan.data).frames)} photos have poses")
    else:
        summary = process(found_artifacts(plan.output / DETECTION), on_progress)
    registered, photos = sum(each.count for each in summary.passes), sum(each.photos for each in summary.passes)
    several = len(summary.passes) > 1
    missing = [f"{each.name}: {name}" if several else name for each in summary.passes for name in each.missing]
    warning = f"no pose was found for {name_list(missing)}; where parts of the "
    warning += "scene are missing, add photos between them and their neighbors"
    repaired = "" if summary.repair is None else f"; of the model, {summary.repair.in_words()}"
    masked = "; found without the artifact's pixels" if summary.masked else ""
    masked = "; more photos have poses without a mask of the artifact" if summary.unmasked else masked
    return Result(
        f"{registered} of {photos} photos have poses, {summary.points:,} points, mean reprojection error "
        f"{summary.reprojection_error:.2f} pixels{masked}{repaired}",
        (warning,) if missing else (),
    )


def _train(plan: Plan, on_progress: ProgressCallback) -> Result:
    for warning in plan.training_warnings:
        _LOG.warning(warning)
    began = train(plan.training, on_progress, partial(warn_of_missed_artifacts, plan))
    _free_memory()
    checkpoint = Checkpoint.read(config_file(plan.training))
    layers, panorama = _layers(checkpoint), read_panorama(Transforms.read(plan.data))
    text = learned_in_words(layers, panorama is not None)
    shares = learned_shares(_pictured(layers, panorama))
    resumed = f" (continued at step {began:,}; the time is since then)" if began else ""
    return Result(
        f"{text}{shares}, in {counted(checkpoint.step + 1, 'step')}{resumed}",
        tuple(clear_overlays(layers)),
    )


def warn_of_missed_artifacts(plan: Plan, artifacts: Artifacts) -> None:
    """Warn, before the first step, of what detection found and the training has no overlay for.

    Training tests undistorted photos, of a 360 degree camera the faces. Names of cameras may differ, so they are
    counted, each once however many intervals it has.

    Args:
        plan: the run.
        artifacts: the overlays that are trained.
    """
    trained = list(dict.fromkeys(artifacts.cameras[: len(artifacts)]))
    verdicts = _verdicts(plan)
    found = [name for name, verdict in verdicts.items() if verdict != "none"]
    # 360 degree photos are one camera for detection and up to six for training.
    if len(found) <= len(trained) or plan.training.pipeline.model.overlay == "off":
        return
    of = f" of {name_list(found)}" if len(verdicts) > 1 else ""
    learned = f"those of {name_list(trained)}" if trained else "none"
    _LOG.warning(
        f"detection found an artifact in the photos{of}, the training in {learned}; if one is left in the splats, run "
        "with --train.pipeline.model.overlay on and another --output"
    )


def _verdicts(plan: Plan) -> dict[str, str]:
    groups = json.loads(read_text(plan.output / DETECTION / VERDICTS))["groups"]
    return {group["name"]: group["verdict"] for group in groups}


def _evaluate(plan: Plan, on_progress: ProgressCallback) -> Result:
    pipeline = load_trained(plan.training)
    found = any(verdict != "none" for verdict in _verdicts(plan).values())
    evaluation = evaluate(pipeline, plan.data, found, on_progress)
    with _emptied(plan.output / EVALUATION) as staged:
        evaluation.write(staged)
        write_view_pictures(pipeline, staged)
    metrics, trained = evaluation.metrics, len(pipeline.datamanager.train_dataset)
    del pipeline
    _free_memory()
    number = len(evaluation.views)
    if not number:
        return Result(
            f"nothing to measure on: all {trained} photos were trained on; of ten or more, one in ten is left to test"
        )
    views = f"PSNR of {counted(number, 'photo')} that the training did not see:"
    if not evaluation.carried:
        return Result(f"{views} {metrics['psnr']:.1f} dB")
    if evaluation.has_overlay:
        return Result(f"{views} {metrics['composite_psnr']:.1f} dB, with the artifact that they have")
    return Result(f"{views} {metrics['psnr']:.1f} dB; they have the artifact that was found, which was not learned")


def _export(plan: Plan, on_progress: ProgressCallback) -> Result:
    checkpoint = Checkpoint.read(config_file(plan.training))
    gaussians, panorama = checkpoint.gaussians(), read_panorama(Transforms.read(plan.data))
    layers = _pictured(_layers(checkpoint), panorama)
    kept = select(gaussians).kept
    with unwritable_as_input_error(plan.output):
        write_ply(plan.output / SPLATS, gaussians, kept)
        on_progress("file", 1, 2 + 2 * len(layers))
        write_compressed_ply(plan.output / COMPRESSED, gaussians, kept)
        write_exposure(checkpoint, plan.output)
        files = artifact_files([layer.name for layer in layers])
        for number, (names, layer) in enumerate(zip(files, layers, strict=True)):
            rgba = to_rgba8(torch.from_numpy(layer.transmittance), torch.from_numpy(layer.addition))
            for name, pixels in zip(names, (rgba, rgba[..., 3]), strict=True):
                with staged_file(plan.output / name) as part:
                    Image.fromarray(pixels).save(part, format="PNG")
            on_progress("file", 2 + 2 * (number + 1), 2 + 2 * len(layers))
    return Result(f"{int(kept.sum()):,} Gaussians", files=tuple(name for names in files for name in names))


def _layers(checkpoint: Checkpoint) -> list[ArtifactLayers]:
    """The artifact of every camera; empty where the training had no overlay."""
    return undistorted_layers(checkpoint) if checkpoint.has_overlay else []


def _pictured(layers: list[ArtifactLayers], panorama: Panorama | None) -> list[ArtifactLayers]:
    """What the artifact's pictures show: every camera's, or one on the sphere where the cameras are faces of it.

    Where a face's artifact changes, every overlay of every face.
    """
    if panorama is None or not layers or face_changes(layers):
        return layers
    return [panorama_layers(layers, panorama)]


def _emptied(folder: Path) -> AbstractContextManager[Path]:
    """`staged_folder` without what a run left there that was killed before it recorded the stage."""
    for left in [folder, *folder.parent.glob(f".{folder.name}.*")]:
        shutil.rmtree(left, ignore_errors=True)
    return staged_folder(folder)


def _free_memory() -> None:
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
