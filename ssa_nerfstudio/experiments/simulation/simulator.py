"""The simulator: a nerfstudio dataset in, the same with an artifact in front of its training photos out."""

from __future__ import annotations

import json
import shutil
from pathlib import Path, PurePosixPath

from rich.console import Console
from rich.progress import Progress

from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.data.training_requirements import check_seed_points
from ssa_nerfstudio.data.writing import staged_folder
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.simulation.corruption import corrupt
from ssa_nerfstudio.experiments.simulation.provenance import scene_record, transforms
from ssa_nerfstudio.experiments.simulation.scene import Scene


def simulate(dataset: Dataset, scene: Scene, output: Path, threads: int, name: str | None = None) -> None:
    """Write the dataset with the scene's artifact in front of every training photo.

    Training photos become PNG: I = clip(T C + B, 0, 1) in the raw frame, rounded to 8 bits, each under its exposure
    where that varies. Everything else is copied byte for byte; without effects and exposure that is every file but
    transforms.json, which gains the split alone.

    Args:
        dataset: the input.
        scene: effects to put in front, and how much exposure varies.
        output: folder to make; it appears when complete.
        threads: photos in flight at once, at least 1; memory is proportional to it and to the photos' size, not to
            their number.
        name: of the input in scene.yaml; None: its folder.

    Raises:
        InputError: the folder exists or cannot be written, or a file of the dataset is missing or cannot be used.
    """
    changed = bool(scene.effects or scene.exposure)
    corrupted = [view.path for view in dataset.views if view.role == "train"] if changed else []
    renamed = {path: str(PurePosixPath(path).with_suffix(".png")) for path in corrupted}
    names = {view.path: view.path for view in dataset.views} | renamed
    _check_names(names)
    check_seed_points(dataset.transforms)
    console = Console()
    # Without a terminal, a finished bar leaves an empty line.
    progress = Progress(console=console, transient=True, disable=not console.is_terminal)
    with staged_folder(output) as folder, progress:
        task = progress.add_task("Simulating", total=len(dataset.views))
        for view in dataset.views:
            if view.path not in renamed:
                _copy(dataset.source(view.path), folder / view.path)
                progress.advance(task)
            for kind, path in view.companions:
                _copy(dataset.source(path, kind), folder / path)
        for path in dataset.points:
            _copy(dataset.root / path, folder / path)
        if changed:
            for _ in corrupt(dataset, scene, names, folder, threads):
                progress.advance(task)
        (folder / "scene.yaml").write_text(scene_record(dataset, scene, name or str(dataset.root)), encoding="utf-8")
        # Last, because it makes the folder a dataset.
        (folder / "transforms.json").write_text(json.dumps(transforms(dataset, names), indent=4), encoding="utf-8")


def _check_names(names: dict[str, str]) -> None:
    owners: dict[PurePosixPath, str] = {}
    for path, name in names.items():
        if (other := owners.setdefault(PurePosixPath(name), path)) != path:
            raise InputError(f"{other} and {path} would both be written to {name}", "rename one of them and its frame")


def _copy(source: Path, target: Path) -> None:
    try:
        content = source.open("rb")
    except OSError as error:
        what = "does not exist" if isinstance(error, FileNotFoundError) else f"cannot be read ({error.strerror})"
        raise InputError(f"{source} {what}; put it there or remove it from transforms.json") from error
    target.parent.mkdir(parents=True, exist_ok=True)
    with content, target.open("wb") as file:
        shutil.copyfileobj(content, file)
