"""report.html of a run: what was found and decided, the pictures, the figures, and the commands that repeat it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from importlib.metadata import version
from pathlib import Path

from PIL import Image
from rich.filesize import decimal

from ssa_nerfstudio.export.exposure_file import FILE as EXPOSURE
from ssa_nerfstudio.workflow.finished_training import Evaluation
from ssa_nerfstudio.workflow.html_page import render_page
from ssa_nerfstudio.workflow.photos_to_splats import COMPRESSED, EVALUATION, SPLATS, artifact_files
from ssa_nerfstudio.workflow.stages import FinishedStage

REPORT = "report.html"


@dataclass(frozen=True)
class CameraPictures:
    """Of one camera, or of one interval of it."""

    title: str
    photo: Path
    clean: Path
    ratio: float
    """Of width to height."""
    artifact: Path | None
    """None where it has no overlay."""
    matte: Path | None


def report_page(
    output: Path, name: str, stages: Sequence[FinishedStage], commands: dict[str, str], on_sphere: bool = False
) -> str:
    """The page as HTML; it names files beside it and no absolute path.

    Args:
        output: folder of a run whose stages are all done.
        name: of the capture.
        stages: in order.
        commands: title and text, to be called in the output folder.
        on_sphere: whether the cameras are faces of 360 degree photos, with one artifact for all of them
            unless it changes.
    """
    evaluation = Evaluation.read(output / EVALUATION)
    whole = [output / name for name in artifact_files([""])[0]]
    sphere = whole if on_sphere and whole[0].exists() else []
    cameras = _cameras(output, evaluation, bool(sphere))
    exposed = (output / EXPOSURE).exists()
    files = [output / name for name in (SPLATS, COMPRESSED, *[EXPOSURE] * exposed)]
    packages = ", ".join(f"{package} {version(package)}" for package in ("ssa-nerfstudio", "nerfstudio", "gsplat"))
    return render_page(
        Path(__file__).parent / "templates" / "run.html",
        f"{name}: splats without the artifact"
        if sphere or any(camera.artifact for camera in cameras)
        else f"{name}: splats",
        cameras=cameras,
        sphere=sphere,
        figures=_figures(evaluation, exposed),
        carried=evaluation.carried,
        overlay=evaluation.has_overlay,
        found={stage.name: stage.text for stage in stages},
        decisions=[decision for stage in stages for decision in stage.decisions],
        stages=[(stage.name, str(timedelta(seconds=round(stage.seconds))), stage.text) for stage in stages],
        warnings=[warning for stage in stages for warning in stage.warnings],
        files=[(file.name, decimal(file.stat().st_size)) for file in files],
        commands=commands,
        packages=packages,
    )


def _cameras(output: Path, evaluation: Evaluation, on_sphere: bool) -> list[CameraPictures]:
    """The pictures of every camera, with those of its own artifact where it has one."""
    folder, groups = output / EVALUATION, evaluation.pictured
    names = [] if on_sphere else [group.overlay for group in groups if group.overlay is not None]
    files = dict(zip(names, artifact_files(names), strict=True))
    cameras = []
    for number, group in enumerate(groups, 1):
        own = [output / file for file in files.get(group.overlay or "", ())]
        artifact, matte = own if own and own[0].exists() else (None, None)
        photo = folder / f"photo-{number}.jpg"
        cameras.append(
            CameraPictures(group.title, photo, folder / f"clean-{number}.jpg", _ratio(photo), artifact, matte)
        )
    return cameras


def _ratio(picture: Path) -> float:
    with Image.open(picture) as image:
        return image.width / image.height


def _figures(evaluation: Evaluation, exposed: bool) -> list[tuple[str, str, str]]:
    """Name, value and meaning of what was measured on the test views; `exposed`: whether exposures were learned."""
    metrics = evaluation.metrics
    if not metrics:
        return []
    rows, corrected = [], []
    best = [f"splats alone; {best}" for best in ("higher is better", "1 is best", "0 is best")]
    if evaluation.carried:
        best = ["splats alone, against photos with the artifact"] * 3
    if evaluation.carried and evaluation.has_overlay:
        value = f"{metrics['composite_psnr']:.2f} dB"
        rows.append(("PSNR with the artifact", value, "splats and artifact, as the photos are; higher is better"))
    if exposed and "cc_psnr" in metrics:
        meaning = "splats alone, brought to the exposure of each photo, which is not known"
        corrected.append(("Color-corrected PSNR", f"{metrics['cc_psnr']:.2f} dB", meaning))
    return [
        *rows,
        ("PSNR", f"{metrics['psnr']:.2f} dB", best[0]),
        *corrected,
        ("SSIM", f"{metrics['ssim']:.3f}", best[1]),
        ("FLIP", f"{metrics['flip']:.3f}", best[2]),
    ]
