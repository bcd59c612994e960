"""From folders of photos or videos to a nerfstudio dataset."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import PIL.Image
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ssa_nerfstudio.data.sources import Source
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.sfm.detected_mask import detected_mask
from ssa_nerfstudio.sfm.feature_mask import widened
from ssa_nerfstudio.sfm.flat_field import MIN_PHOTOS, static_factor, write_flattened
from ssa_nerfstudio.sfm.ingest import Photo, expected_count, ingest
from ssa_nerfstudio.sfm.nerfstudio_dataset import POINTS, split, transforms, write_points
from ssa_nerfstudio.sfm.reconstruction import Pass, Report, Settings, reconstruct
from ssa_nerfstudio.sfm.resumable_work import Work, resumable_work

if TYPE_CHECKING:
    import pycolmap

MASK = "mask_colmap.png"
"""The mask that was used, beside transforms.json: black is ignored, as COLMAP and nerfstudio both have it."""


@dataclass(frozen=True)
class Registered:
    """What structure from motion gave for one pass."""

    name: str
    photos: int
    """That there are."""
    missing: tuple[str, ...]
    """Sources of those that could not be registered."""

    @property
    def count(self) -> int:
        """How many were registered."""
        return self.photos - len(self.missing)

    @property
    def share(self) -> float:
        """Of the photos that were registered, in [0, 1]."""
        return self.count / self.photos


@dataclass(frozen=True)
class Outcome:
    """What was found."""

    passes: tuple[Registered, ...]
    """The training photos first."""
    points: int
    reprojection_error: float
    """Mean over the points' observations, pixels of the photos."""
    masked: float
    """Share of the first pass's frame in which no features were looked for, in [0, 1]."""


def process(
    sources: Sequence[Source],
    output: Path,
    mask: np.ndarray | None = None,
    detect: bool = False,
    frames: int = 200,
    min_registered: float = 0.5,
    settings: Settings | None = None,
    console: Console | None = None,
) -> Outcome:
    """Writes a nerfstudio dataset: images/, transforms.json, sparse_pc.ply and COLMAP's model in colmap/sparse/0.

    All passes are mapped together, each with one camera of its own. Where there are two, the photos of the first train
    and those of the second test. The output appears only when it is complete; until then work lies in `.NAME.work`
    beside it, from which the next run with the same arguments goes on.

    Args:
        sources: the passes, one or two, the one to train on first.
        output: folder to make.
        mask: bool [height, width] for the first pass, True where features may lie.
        detect: whether to look for an opaque artifact in the first pass, and to mask it, where no mask is given.
        frames: to take from a pass of videos, at least 1.
        min_registered: the least share of each pass's photos, in [0, 1].
        settings: of structure from motion.
        console: takes the progress bar; none is drawn where it is no terminal.

    Raises:
        InputError: a photo is broken, too few were registered, or the output cannot be written.
    """
    settings = settings or Settings()
    console = console or Console()
    mask = None if mask is None else widened(mask)
    with resumable_work(output) as work, _progress(console) as report:
        made_from = [(source.name, source.fingerprint(), frames) for source in sources]
        dataset = work.room("dataset", made_from)
        photos = _ingest(sources, dataset, frames, report)
        if detect and mask is None:
            files = [dataset / "images" / photo.name for photo in photos[0]]
            mask = detected_mask(files, lambda done: report("detection", done, len(files)))
            mask = None if mask is None else widened(mask)
        motion = work.room("motion", [made_from, _digest(mask), asdict(settings) | {"threads": None}])
        if mask is not None:
            PIL.Image.fromarray(mask).save(motion / MASK)
        names = [[photo.name for photo in each] for each in photos]
        passes = [Pass(each, str(dataset / "images")) for each in names]
        looked_at = _flatten(names[0], dataset / "images", motion / "flat", settings, report)
        passes[0] = Pass(names[0], str(looked_at), None if mask is None else str(motion / MASK))
        found = reconstruct(dataset / "images", passes, motion, settings, report)
        model = found and _load(found)
        outcome = _judge(work, sources, photos, model, min_registered, mask)
        assert model is not None
        _finish(dataset, sources, photos, model, mask)
        dataset.rename(output)
        work.discard()
    return outcome


@contextmanager
def _progress(console: Console) -> Iterator[Report]:
    """A bar a stage with the time that is left; where there is no terminal, a line when a stage is done."""
    columns = (TextColumn("{task.description:<10}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    bars = Progress(
        *columns, TextColumn("left:"), TimeRemainingColumn(), console=console, disable=not console.is_terminal
    )
    tasks = {}
    finished: set[str] = set()

    def report(stage: str, done: int, total: int) -> None:
        if stage not in tasks:
            tasks[stage] = bars.add_task(stage, total=total, completed=done)
        bars.update(tasks[stage], completed=done, total=total)
        if done == total and stage not in finished and not console.is_terminal:
            console.print(f"{stage}: {total}")
        finished.update({stage} if done == total else ())

    with bars:
        yield report


def _load(model: Path) -> pycolmap.Reconstruction:
    # Late, because COLMAP takes over the process's signals; after PIL, because saving a PNG would abort otherwise.
    import pycolmap

    return pycolmap.Reconstruction(model)


def _ingest(sources: Sequence[Source], dataset: Path, frames: int, report: Report) -> list[list[Photo]]:
    total = sum(expected_count(source, frames) for source in sources)
    done = 0

    def advance() -> None:
        nonlocal done
        done += 1
        report("photos", min(done, total), total)

    report("photos", 0, total)
    photos = [ingest(source, dataset, frames, advance) for source in sources]
    report("photos", total, total)
    return photos


def _flatten(names: list[str], images: Path, folder: Path, settings: Settings, report: Report) -> Path:
    """Folder of the photos without what is the same in all of them: their own where nothing is, or it is not asked."""
    if not settings.flatten or len(names) < MIN_PHOTOS:
        return images
    done = sum((folder / name).is_file() for name in names) if folder.is_dir() else 0
    if done < len(names):
        report("artifact", 0, len(names))
        factor = static_factor([images / name for name in names], settings.max_image_size)
        if factor is None:
            report("artifact", len(names), len(names))
            return images
        folder.mkdir(exist_ok=True)
        for number, name in enumerate(names, 1):
            write_flattened(images / name, folder / name, factor)
            report("artifact", number, len(names))
    return folder


def _judge(
    work: Work,
    sources: Sequence[Source],
    photos: Sequence[Sequence[Photo]],
    model: pycolmap.Reconstruction | None,
    min_registered: float,
    mask: np.ndarray | None,
) -> Outcome:
    images = [] if model is None else [image for image in model.images.values() if image.has_pose]
    registered = {image.name for image in images}
    passes = tuple(
        Registered(source.name, len(each), tuple(photo.source for photo in each if photo.name not in registered))
        for source, each in zip(sources, photos, strict=True)
    )
    for each in passes:
        if each.share < min_registered or each.count == 0:
            work.kept = True
            remedy = (
                "take photos that overlap more"
                if mask is not None
                else "give --mask if something covers part of every frame, or photos that overlap more"
            )
            raise InputError(
                f"only {each.count} of {each.photos} {each.name} photos could be registered, {min_registered:.0%} "
                f"are asked for: {remedy}",
                f"--min-registered takes less, and goes on from the work in {work.folder}",
            )
    assert model is not None
    masked = 0.0 if mask is None else float(1 - mask.mean())
    return Outcome(passes, model.num_points3D(), model.compute_mean_reprojection_error(), masked)


def _finish(
    dataset: Path,
    sources: Sequence[Source],
    photos: Sequence[Sequence[Photo]],
    model: pycolmap.Reconstruction,
    mask: np.ndarray | None,
) -> None:
    sparse = dataset / "colmap" / "sparse" / "0"
    sparse.mkdir(parents=True, exist_ok=True)
    model.write_binary(sparse)
    write_points(dataset / POINTS, model)
    if mask is not None:
        PIL.Image.fromarray(mask).save(dataset / MASK)
    meta = transforms(model, {photo.name: photo.source for each in photos for photo in each})
    if len(sources) > 1:
        meta = split(meta, *([photo.name for photo in each] for each in photos))
    for source in sources:
        (dataset / f".{source.name}.json").unlink(missing_ok=True)
    # Last, because it is what makes the folder a dataset.
    (dataset / "transforms.json").write_text(json.dumps(meta, indent=1), encoding="utf-8")


def _digest(mask: np.ndarray | None) -> str | None:
    return None if mask is None else hashlib.sha256(str(mask.shape).encode() + np.packbits(mask).tobytes()).hexdigest()
