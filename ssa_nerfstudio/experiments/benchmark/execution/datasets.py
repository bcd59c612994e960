"""The datasets that runs train on, made once and kept: reduced, corrupted, with the true layers beside them."""

from __future__ import annotations

import os
import re
import zlib
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from string import Template

import numpy as np
from PIL import Image
from rich.console import Console

from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.data.transforms import SPLITS
from ssa_nerfstudio.data.writing import staged_file, staged_folder
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import DEMO
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import CLEAN
from ssa_nerfstudio.experiments.benchmark.specification.plan import Run
from ssa_nerfstudio.experiments.effects.composition import Composition
from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.simulation.scene import Scene, read_effects
from ssa_nerfstudio.experiments.simulation.simulator import simulate

DEMO_SIZE = {"views": 24, "test_views": 4, "width": 96, "height": 72}
"""The built-in scene, small enough for minutes on a CPU."""


def source(data: str) -> Path:
    """The folder that a benchmark file means; $SSA_DATA is ./data where it is not set.

    Raises:
        InputError: it holds no dataset.
    """
    environment = {"SSA_DATA": "data", **os.environ}
    path = Path(Template(data).safe_substitute(environment)).expanduser()
    if data != DEMO and not (path / "transforms.json").is_file():
        variable = re.search(r"\$\{?(\w+)", data)
        hint = f" (set {variable[1]} to the folder of captures)" if variable else ""
        raise InputError(
            f"{path}/transforms.json does not exist{hint}", "put the capture there, or choose other scenes"
        )
    return path


def check_captures(runs: list[Run], folder: Path, artifacts: Path) -> None:
    """Check what `prepare` reads, without opening a photo.

    Raises:
        InputError: a capture or the mask of its artifact is missing, or a capture cannot be used.
    """
    for run in {run.dataset: run for run in runs}.values():
        if run.mask and not mask_path(run, artifacts).exists():
            _stated_mask(run)
        if run.data != DEMO and not (folder / run.dataset).exists():
            Dataset.read(source(run.data), run.eval_interval)


def prepare(runs: list[Run], folder: Path, artifacts: Path, threads: int, console: Console) -> None:
    """Makes the datasets of runs that are not there yet, each appearing when it is complete.

    Args:
        runs: what will be trained.
        folder: where datasets go, by `Run.dataset`.
        artifacts: where drawn effects are kept, so that a machine without albumentations can use them.
        threads: photos worked on at once.
        console: says which dataset is being made.

    Raises:
        InputError: a capture is missing or cannot be used.
    """
    for run in {run.dataset: run for run in runs}.values():
        if run.mask and not (mask := mask_path(run, artifacts)).exists():
            _keep_mask(_stated_mask(run), mask)
        if not (folder / run.dataset).exists():
            console.print(f"Making the dataset {run.dataset} ...")
            dataset = _clean(run, folder, threads)
            effects = () if run.real or run.effect == CLEAN else read_effects((run.effect,))
            scene = KeptScene(effects, run.effect_seed, run.exposure, run.effect, artifacts)
            simulate(dataset, scene, folder / run.dataset, threads)


def mask_path(run: Run, artifacts: Path) -> Path:
    """Where the mask of a scene's own artifact is kept, beside the drawn effects."""
    return artifacts / f"{run.scene}-mask{PurePosixPath(run.mask).suffix}"


@dataclass(frozen=True)
class KeptScene(Scene):
    """A scene whose drawn artifacts are kept as files; those that vary from view to view are drawn every time."""

    name: str = ""
    """Of the effect, for the file's."""
    folder: Path = Path()
    """Where the files are."""

    def draw(self, height: int, width: int) -> Composition:
        """The artifact at one frame size, from its file where there is one."""
        described = zlib.crc32(repr(self.describe()).encode())
        path = self.folder / f"{self.name}-e{self.seed}-{width}x{height}-{described:08x}.npz"
        if path.exists():
            with np.load(path) as arrays:
                return Composition([Layers(arrays["T"], arrays["B"])])
        drawn = super().draw(height, width)
        if drawn.box is None:
            layers = drawn.whole(None, height, width)
            self.folder.mkdir(parents=True, exist_ok=True)
            with staged_file(path) as part, part.open("wb") as file:
                np.savez_compressed(file, T=layers.transmittance, B=layers.addition)
        return drawn


def _clean(run: Run, folder: Path, threads: int) -> Dataset:
    """The capture without anything added, at the run's resolution."""
    if run.data == DEMO:
        from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene

        clean = folder / f"{run.scene}-source"
        if not clean.exists():
            DemoScene(**DEMO_SIZE).write(clean, None)
        return Dataset.read(clean, run.eval_interval)
    data = source(run.data)
    dataset = Dataset.read(data, run.eval_interval)
    if run.counterparts:
        dataset = _with_photos_of(dataset, run.counterparts)
    if run.downscale == 1:
        return dataset
    if run.counterparts or not (data / f"images_{run.downscale}").is_dir():
        of = f"-{run.counterparts.replace('/', '-')}" if run.counterparts else ""
        reduced = folder / f"{run.scene}{of}-source-div{run.downscale}"
        if not reduced.exists():
            _reduce(dataset, run.downscale, reduced)
        data = reduced
    return Dataset.read(data, run.eval_interval, run.downscale)


def _with_photos_of(dataset: Dataset, folder: str) -> Dataset:
    """The dataset with the photos of the same names in another folder."""

    def moved(path: str) -> str:
        return str(PurePosixPath(folder, PurePosixPath(path).name))

    splits = {f"{name}_filenames" for name in SPLITS} & dataset.meta.keys()
    meta = {
        **dataset.meta,
        "frames": [{**frame, "file_path": moved(frame["file_path"])} for frame in dataset.meta["frames"]],
        **{split: [moved(path) for path in dataset.meta[split]] for split in splits},
    }
    return replace(dataset, transforms=replace(dataset.transforms, meta=meta))


def _stated_mask(run: Run) -> Path:
    mask = source(run.data) / run.mask
    if not mask.is_file():
        raise InputError(f"{mask} does not exist", "put the mask of the artifact there, or state no mask")
    return mask


def _keep_mask(mask: Path, kept: Path) -> None:
    kept.parent.mkdir(parents=True, exist_ok=True)
    with staged_file(kept) as part:
        part.write_bytes(mask.read_bytes())


def _reduce(dataset: Dataset, factor: int, output: Path) -> None:
    """A copy with its photos box-filtered into images_N; masks and depth maps are left behind."""
    with staged_folder(output) as folder:
        for name in ("transforms.json", *dataset.points):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes((dataset.root / name).read_bytes())
        (folder / f"images_{factor}").mkdir()
        for view in dataset.views:
            photo = Image.fromarray(dataset.read_photo(view))
            size = photo.width // factor, photo.height // factor
            box = (0, 0, size[0] * factor, size[1] * factor)
            small = photo.resize(size, Image.Resampling.BOX, box=box)
            name = PurePosixPath(view.path).name
            # PNG's bytes under whatever name transforms.json gives: readers go by content.
            small.save(folder / f"images_{factor}" / name, format="PNG")
