"""Error of the start against the artifact that was simulated: `python benchmarks/start_accuracy.py --data DIR`

Of clean datasets it is the error where nothing is in front. `light`: how much of what the scene leaves unexplained a
light for each photo explains, over the share `hidden` of the frame (`evidence.artifact_light`); `left`: what a second
estimate leaves of the squares that the first leaves there (`evidence.mean_light`); `held_out`: how far samples lie from
layers and colors that were estimated without their photos, as the mean of Cauchy's log(1 + r^2 / s^2): no truth needed.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch

from ssa_nerfstudio import evidence
from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import file_to_write
from ssa_nerfstudio.data.sparse_points import check_points
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.artifact_light import ArtifactLight, artifact_light
from ssa_nerfstudio.evidence.detection import Detection, detect
from ssa_nerfstudio.evidence.initialization import estimate, guide_of, initialize_from
from ssa_nerfstudio.evidence.layer_estimate import OUTLIER_SCALE, LayerEstimate
from ssa_nerfstudio.evidence.mean_light import refine_in_mean_light, second_estimate
from ssa_nerfstudio.evidence.point_samples import PointSamples, View, sample_points
from ssa_nerfstudio.evidence.present_area import present_area
from ssa_nerfstudio.evidence.scene_photos import scene_photos
from ssa_nerfstudio.evidence.statistics import accumulate
from ssa_nerfstudio.experiments.configuration import read
from ssa_nerfstudio.experiments.runs.result_lines import read_lines
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.overlay.shading import basis_of

FIRST = "first estimate"
"""In place of a constant: the start without a second estimate in the artifact's mean light (`evidence.mean_light`)."""
LAYERS = "layers/undistorted.npz"
"""Of a dataset in which an artifact was drawn: the truth."""
DETECTION = {
    "edge_evidence": (
        "EVIDENCE_THRESHOLDS",
        "MIN_GRADIENT",
        "MIN_EDGE_SHARES",
        "DISPLACEMENT_WINDOWS",
        "MAX_DISPLACED_SHARES",
        "MIN_STILL_SHARE",
    ),
    "null_distribution": ("SIGNIFICANCE", "MAX_SHIFT"),
    "static_area": ("MAX_OPAQUE_DEVIATION",),
    "detection": ("MIN_OPAQUE_COVERAGE",),
}
"""Constants of the modules in `evidence` that detect, which comes first."""
ESTIMATE = {
    "point_samples": ("WORKING_SIZE", "OCCLUSION_TOLERANCE", "OCCLUSION_RADIUS"),
    "expected_layers": ("DETAIL_RADIUS",),
    "first_colors": ("COLOR_ROUNDS", "MOST_SHOWN"),
    "layer_estimate": (
        "ROUNDS",
        "CONJUGATE_GRADIENT_STEPS",
        "PRIOR_SCALE",
        "SMOOTHNESS_FLOOR",
        "MEAN_CONTRAST",
        "OUTLIER_SCALE",
        "CLEAR_SHARE",
        "LIGHT_SHARE",
    ),
    "present_area": ("CERTAIN_SHARE",),
    "guided_upsampling": ("RADIUS",),
}
"""Those of the modules that estimate the layers."""
HELD_OUT = "", "first_colors", "expected_layers", "layer_estimate"
"""Modules whose constants leave the samples as they are, so that held-out ones can be compared."""
FOLDS = 5
"""A photo in so many is held out."""
SEEDS = {
    "distant_points": ("SPACING", "DISTANCE", "NOISE", "PATCH", "SIGNIFICANCE", "MIN_SIGHTS"),
    "gap_points": ("SPACING", "NEIGHBORS", "FLATNESS", "CLEAR_BY", "MAX_VIEWS"),
    "scene_photos": ("MIN_SHOWN",),
}
"""Those of the modules that find more seeds, behind the layers that were estimated."""


@dataclass
class Command:
    """Print the errors of T and B where the artifact is and elsewhere; with --vary, for other constants, too."""

    data: list[Path] = field(default_factory=list)
    """Datasets that `ssa simulate` has written, or clean ones."""
    vary: bool = False
    """Also halve and double each constant, of more seeds, too, of which their number is told."""
    held_out: bool = False
    """Also predict samples of photos that are held out, for constants of the estimate alone."""
    first: bool = False
    """Also measure the first estimate alone, named so as a constant. A second one is made where the light changes."""
    output: Annotated[Path, file_to_write()] | None = None
    """File to which every result is added, as a line of JSON. What it has is not measured again."""

    def run(self) -> None:
        """Measure dataset by dataset, and print a table.

        Raises:
            InputError: no dataset is given, or one of them is none, has no points, or lacks the layers of the artifact
                that was drawn; or `output` holds something else.
        """
        if not self.data:
            raise InputError("no dataset is given", "add --data DIR, as ssa simulate writes it")
        for path in self.data:
            _check(path)
        keys = "data", "constant", "factor"
        lines = [] if self.output is None else read_lines(self.output, keys, since="verdict")
        known = {(line["data"], line["constant"], line["factor"]): line for line in lines}
        groups = [*DETECTION.items(), *ESTIMATE.items(), *SEEDS.items()] if self.vary else []
        constants = [f"{module}.{name}" for module, names in groups for name in names]
        variants = [("", 1.0), *((name, factor) for name in constants for factor in (0.5, 2.0))]
        variants += [(FIRST, 1.0)] * self.first
        for path in self.data:
            missing = [variant for variant in variants if (path.name, *variant) not in known]
            for result in _measure(path, missing, self.held_out):
                known[path.name, result["constant"], result["factor"]] = result
                print("  ".join(f"{key} {value}" for key, value in result.items()), flush=True)
                if self.output is not None:
                    with self.output.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(result) + "\n")
        if self.vary:
            names = [path.name for path in self.data]
            of_seeds = [constant for constant in constants if constant.split(".")[0] in SEEDS]
            _print_sensitivity(known, names, [constant for constant in constants if constant not in of_seeds])
            _print_seeds(known, names, of_seeds)


def _check(path: Path) -> None:
    """Refuse what cannot be measured, and what would be taken for a clean dataset and is none."""
    if path.is_file():
        raise InputError(f"{path} is a file", "name the dataset's folder, where its layers are looked for")
    if not (points := Transforms.read(path).meta.get("ply_file_path")):
        raise InputError(f"{path} states no points (ply_file_path)", "choose a dataset that has some")
    check_points(path / points)
    drawn = read(path / "scene.yaml").get("effects") if (path / "scene.yaml").is_file() else None
    if drawn and not (path / LAYERS).is_file():
        raise InputError(f"{path} has no {LAYERS}, though its scene.yaml names effects", "make it with ssa simulate")


def _views(path: Path) -> tuple[torch.Tensor, list[View]]:
    """Points [N, 3] and training photos of a dataset, as a training reads them."""
    from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager

    from ssa_nerfstudio.experiments.runs.run_configuration import configure
    from ssa_nerfstudio.plugin.view_geometry import view_matrix

    config = configure("ssa-splatfacto", path, Path("outputs"), 1)
    manager = config.pipeline.datamanager.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
    assert isinstance(manager, FullImageDatamanager)
    photos, cameras = manager.cached_train, manager.train_dataset.cameras
    points = manager.train_dataparser_outputs.metadata["points3D_xyz"]
    poses, lenses = view_matrix(cameras.camera_to_worlds), cameras.get_intrinsics_matrices()
    return points, [View(photo["image"], photo.get("mask"), poses[i], lenses[i]) for i, photo in enumerate(photos)]


def _measure(path: Path, variants: list[tuple[str, float]], held_out: bool) -> Iterator[dict[str, Any]]:
    """Errors of the start with each variant of the constants."""
    if not variants:
        return
    from ssa_nerfstudio.plugin.extra_seeds import seeds_between

    points, views = _views(path)
    statistics = accumulate((view.image, view.mask) for view in views)
    plain, guide = detect(statistics), guide_of(statistics)
    truth = torch.cat([torch.ones(*statistics.size, 1), torch.zeros(*statistics.size, 3)], dim=-1)
    if (path / LAYERS).is_file():
        with np.load(path / LAYERS) as layers:
            parts = layers["T"].mean(axis=-1, keepdims=True), layers["B"]
        truth = torch.from_numpy(np.concatenate(parts, axis=-1))
    covered = (truth[..., 0] < 0.95) | (truth[..., 1:].amax(dim=-1) > 0.05)

    whole = sample_points(points, views, guide, plain.opaque) if held_out else None
    distance = None if whole is None else _distance_of_others(whole, guide, plain)
    second: dict[str, float] = {}  # what a second estimate would leave, beside the first

    def start(detection: Detection, refine: bool = True) -> tuple[Detection, LayerEstimate, ScreenSpaceOverlay]:
        samples = sample_points(points, views, guide, detection.opaque)
        found = estimate(samples, guide, detection.opaque, detection.mask)
        light = found.adds_light(present_area(found.opacity(), detection.mask))
        overlay = ScreenSpaceOverlay(*statistics.size, adds_light=light)
        initialize_from(overlay, found, guide, detection.mask)
        again = second_estimate(overlay, found, samples, guide, views, detection)
        if refine:
            found = refine_in_mean_light(overlay, found, again, detection.mask).layers
        elif again is not None:
            second["left"] = round(again.left, 3)
        return detection, found, overlay

    own = None
    for constant, factor in variants:
        started, module, seeds = time.monotonic(), constant.split(".")[0], {}
        others = {}
        if distance is not None and module in HELD_OUT:
            with _scaled(constant, factor):
                others = {"held_out": round(distance(), 5)}
        if constant == FIRST:
            detection, found, overlay = start(plain, refine=False)
        elif module in SEEDS or not constant:
            detection, found, overlay = own = own or start(plain)
            with _scaled(constant, factor):
                photos = scene_photos(views, [overlay.layers()] * len(views), [0] * len(views))
                found_seeds = seeds_between(points, photos)
            counted = found_seeds.distant, found_seeds.gaps, found_seeds.backdrop
            seeds = {name: len(each) for name, each in zip(("seeds", "gaps", "backdrop"), counted, strict=True)}
        else:
            with _scaled(constant, factor):
                detected = detect(statistics) if module in DETECTION else plain
                detection, found, overlay = start(detected)
        shading = _light_of(views, overlay)
        error = torch.cat(overlay.layers(), dim=-1).detach() - truth
        size = error.abs()
        yield {
            "data": path.name,
            "constant": constant,
            "factor": factor,
            "T_on": _mean(size[covered][:, 0]),
            "T_bias_on": _mean(error[covered][:, 0]),
            "B_on": _mean(size[covered][:, 1:]),
            "T_off": _mean(size[~covered][:, 0]),
            "B_off": _mean(size[~covered][:, 1:]),
            "adds_light": bool(overlay.adds_light),
            "light": round(shading.explained, 3),
            "hidden": round(shading.hidden, 3),
            "noise": round(float(found.noise), 4),
            "verdict": detection.verdict,
            "share": round(found.share(), 4),
            "seconds": round(time.monotonic() - started, 1),
            **(second if constant == FIRST else {}),
            **others,
            **seeds,
        }


def _distance_of_others(samples: PointSamples, guide: torch.Tensor, detection: Detection) -> Callable[[], float]:
    """What measures held-out samples by the estimate's constants at the time, in units of the noise by the present.

    They are those of whole photos, of points that others show, too. The first estimate predicts them. What all photos
    say together is of these, too: mean and deviation, the detected area, the falloff.
    """
    falloff = estimate(samples, guide, detection.opaque, detection.mask).falloff
    away = samples.view % FOLDS == 0
    parts = {name: getattr(samples, name)[~away] for name in ("point", "pixel", "color", "view")}
    kept = replace(samples, **parts, patch=None)
    those = (away & torch.isin(samples.point, kept.point)).nonzero()[:, 0]

    def found() -> LayerEstimate:
        return estimate(kept, guide, detection.opaque, detection.mask, falloff)

    scale = OUTLIER_SCALE * found().noise
    return lambda: float(torch.log1p(found().left_of(samples, those).square().mean(dim=-1) / scale**2).mean())


def _light_of(views: list[View], overlay: ScreenSpaceOverlay) -> ArtifactLight:
    images, masks = [view.image for view in views], [view.mask for view in views]
    return artifact_light(images, masks, basis_of(overlay), overlay.layers())


def _mean(values: torch.Tensor) -> float:
    return round(float(values.mean()), 4) if values.numel() else 0.0


@contextmanager
def _scaled(constant: str, factor: float) -> Iterator[None]:
    """A constant of `evidence`, as MODULE.NAME, times a factor, in all modules that import it."""
    if not constant:
        yield
        return
    module, name = constant.split(".")
    value = getattr(importlib.import_module(f"{evidence.__name__}.{module}"), name)
    users = [each for key, each in sys.modules.items() if key.startswith(f"{evidence.__name__}.")]
    users = [each for each in users if getattr(each, name, None) is value]
    changed = tuple(_times(each, factor) for each in value) if isinstance(value, tuple) else _times(value, factor)
    for each in users:
        setattr(each, name, changed)
    try:
        yield
    finally:
        for each in users:
            setattr(each, name, value)


def _times(value: float, factor: float) -> float:
    """Times the factor; an odd number, as of a window, stays one."""
    if not isinstance(value, int):
        return value * factor
    return 2 * round((value * factor - 1) / 2) + 1 if value % 2 else max(1, round(value * factor))


def _print_sensitivity(
    known: dict[tuple[str, str, float], dict[str, Any]], names: list[str], constants: list[str]
) -> None:
    """A row for each constant at half and at twice its value: mean errors where artifacts are, and elsewhere; verdicts.

    A changed verdict is one of detection, or whether the artifact adds light.
    """

    def errors(constant: str, factor: float) -> str:
        rows = [known[name, constant, factor] for name in names]
        drawn = [row["T_on"] + row["B_on"] for row in rows if row["T_on"] + row["B_on"] > 0]
        on = np.mean(drawn) if drawn else 0.0
        off = np.mean([row["T_off"] + row["B_off"] for row in rows])
        plain = [known[name, "", 1.0] for name in names]
        changed = sum(
            any(row[key] != before[key] for key in ("verdict", "adds_light"))
            for row, before in zip(rows, plain, strict=True)
        )
        cells = [f"{on:.3f}", f"{off:.3f}", str(changed)]
        if predicted:  # a mean over fewer datasets would not compare
            others = [row["held_out"] for row in rows if "held_out" in row]
            cells.append(f"{np.mean(others):.4f}" if len(others) == len(rows) else "")
        return " | ".join(cells)

    predicted = any("held_out" in row for row in known.values())
    columns = "there | elsewhere | verdicts changed" + " | held out" * predicted
    print(f"\n| constant | half: {columns} | twice: {columns} |\n|{'---|' * (9 if predicted else 7)}")
    print(f"| all as they are | {errors('', 1.0)} | {errors('', 1.0)} |")
    for constant in constants:
        print(f"| {constant} | {errors(constant, 0.5)} | {errors(constant, 2.0)} |")


def _print_seeds(known: dict[tuple[str, str, float], dict[str, Any]], names: list[str], constants: list[str]) -> None:
    """A row for each constant at half and at twice its value: numbers of distant and gap seeds of each dataset."""

    def counts(constant: str, factor: float) -> str:
        rows = (known[name, constant, factor] for name in names)
        return " | ".join(f"{row['seeds']}, {row['gaps']}" if "gaps" in row else "" for row in rows)

    columns = " | ".join(names)
    print(f"\n| distant and gap seeds | half: {columns} | twice: {columns} |\n|{'---|' * (1 + 2 * len(names))}")
    for constant in ("", *constants):
        print(f"| {constant or 'all as they are'} | {counts(constant, 0.5 if constant else 1.0)} | ", end="")
        print(f"{counts(constant, 2.0 if constant else 1.0)} |")


if __name__ == "__main__":
    run_script(Command)
